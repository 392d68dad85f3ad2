"""Recent samples in bundles: each asset finds what it needs, bit for bit; nobody's silence keeps what others sent."""

from __future__ import annotations

import random
from collections import defaultdict

import numpy as np
import pytest
import sqlalchemy as sa
from hypothesis import given
from hypothesis import strategies as st

from servoscope.service.sources.block import Block
from servoscope.service.store import Batch, Store, bundles, tables
from servoscope.service.store.bundles import BundleIndex, pack_samples, restore_times

BEGAN = 1767225600.25  # [UTC s]


def signals(t: np.ndarray, covariates: int = 0, seed: int = 0) -> np.ndarray:
    return np.concatenate([t[None], np.random.default_rng(seed).standard_normal((3 + covariates, t.size))])


def packed(rows: np.ndarray) -> bytes:
    return Block.from_signals("press", 0, rows).pack()


@pytest.mark.parametrize("rate", [0.5, 12.5, 50.0, 100.0, 1000.0, 8192.0])
@pytest.mark.parametrize("covariates", [0, 2])
def test_regular_time_stamps_are_not_stored_and_come_back_to_the_last_bit(rate: float, covariates: int) -> None:
    rows = [signals(BEGAN + k + np.arange(64) / rate, covariates, k) for k in range(3)]
    found, blocks = pack_samples(np.stack(rows)), list(map(packed, rows))
    assert [restore_times(short) for short, _ in found] == blocks
    assert all(
        regular and len(short) == len(block) - 62 * 8 for (short, regular), block in zip(found, blocks, strict=True)
    )


def test_time_stamps_that_are_not_regular_to_the_last_bit_are_kept() -> None:
    t = BEGAN + np.arange(100) / 100.0
    for k, value in ((50, np.nextafter(t[50], np.inf)), (3, np.nan), (99, np.inf), (0, -0.0)):
        changed = t.copy()
        changed[k] = value
        found = pack_samples(np.stack([signals(changed), signals(t)]))  # one beside one that is regular
        assert found[0] == (packed(signals(changed)), False) and found[1][1]
    zero = np.arange(100) / 100.0
    zero[0] = -0.0  # equals t_0, in other bits
    for one in map(signals, (zero, t[:1])):
        assert pack_samples(one[None]) == [(packed(one), False)]


@given(st.integers(0, 3), st.integers(1, 6), st.data())
def test_any_samples_come_back(covariates: int, size: int, data: st.DataObject) -> None:
    lists = st.lists(st.floats(width=64), min_size=(4 + covariates) * size, max_size=(4 + covariates) * size)
    blocks = np.array(data.draw(st.lists(lists, min_size=1, max_size=3))).reshape(-1, 4 + covariates, size)
    found = pack_samples(blocks)
    assert [restore_times(stored) if regular else stored for stored, regular in found] == list(map(packed, blocks))


class Feed:
    """Writes blocks of assets as a service does, beside a plain account of what has to be there."""

    def __init__(self, store: Store, owner: str = "hall") -> None:
        self.store, self.owner, self.commit, self.index = (
            store,
            owner,
            store.last_commit(owner),
            store.bundle_index(owner),
        )
        self.counts: defaultdict[str, int] = defaultdict(int)
        self.needed: defaultdict[str, dict[int, bytes]] = defaultdict(dict)

    def write(self, assets: list[str], first_needed: dict[str, int]) -> None:
        blocks = []
        for asset in assets:
            sequence = self.counts[asset]
            self.counts[asset] += 1
            samples = signals(BEGAN + sequence + np.arange(4) / 4.0, seed=sequence)
            blocks.append((asset, sequence, *pack_samples(samples[None])[0]))
            self.needed[asset][sequence] = packed(samples)
        for asset, first in first_needed.items():
            self.needed[asset] = {k: one for k, one in self.needed[asset].items() if k >= first}
        batch = Batch(first_needed=dict(first_needed), bundles=self.index.advance(blocks, first_needed))
        self.commit += 1
        self.store.write(batch, self.owner, self.commit)

    def check(self) -> None:
        stored = dict(self.store.recent_samples_of(self.needed))
        assert {name: dict(blocks) for name, blocks in stored.items()} == dict(self.needed)
        assert all(blocks == sorted(blocks) for blocks in stored.values())


def rows(store: Store, table: sa.Table) -> int:
    return int(store.fetch_tuples(sa.select(sa.func.count()).select_from(table))[0][0])


def test_whatever_comes_and_goes_each_asset_finds_what_it_needs(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bundles, "BUNDLES", 2)
    monkeypatch.setattr(bundles, "MAX_COMMITS_WAITED", 3)
    chance, names, feed = random.Random(1), [f"axis{i}" for i in range(7)], Feed(store)
    first = dict.fromkeys(names, 0)
    for turn in range(60):
        awake = names if turn < 20 else names[:4]  # three are never heard again
        sent = [name for name in awake for _ in range(chance.randrange(3))]
        moved = {
            name: max(first[name], feed.counts[name] - chance.randrange(2, 12))
            for name in awake
            if chance.random() < 0.4
        }
        first |= moved
        feed.write(sent, moved)
        if turn % 10 == 9:
            feed.index = store.bundle_index("hall")  # as after a restart
        feed.check()
    newest = store.recent_samples("axis0", 3)
    assert newest == store.recent_samples("axis0")[-3:] and len(newest) == 3
    assert 0 < rows(store, tables.recent) <= sum(len(feed.needed[name]) for name in names)


def test_an_asset_that_falls_silent_for_ever_holds_its_own_blocks_and_no_rows(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bundles, "BUNDLES", 1)
    monkeypatch.setattr(bundles, "MAX_COMMITS_WAITED", 5)
    names, feed = [f"axis{i}" for i in range(8)], Feed(store)
    for turn in range(40):
        awake = names if turn < 10 else names[1:]
        feed.write(awake, {name: max(0, turn - 6) for name in awake})
        feed.check()
        assert rows(store, tables.bundles) <= 6 + 2 + bundles.MAX_COMMITS_WAITED
    assert rows(store, tables.recent) == len(feed.needed["axis0"]) == 7
    feed.write(["axis0"], {"axis0": 10})  # it is back
    feed.check()
    assert rows(store, tables.recent) == 0


def test_samples_go_on_with_the_service_that_follows_their_asset_now(store: Store) -> None:
    before, after = Feed(store, "hall-1"), Feed(store, "hall-2")
    for _ in range(5):
        before.write(["press", "lift"], {})
    store.take_over("hall-2", ["press"])
    after.index = store.bundle_index("hall-2")
    after.counts["press"], after.needed["press"] = 5, before.needed.pop("press")
    for turn in range(5):  # the other goes on, and does not know of it
        before.write(["lift"], {"lift": turn})
        after.write(["press"], {"press": turn + 3})
        before.check()
        after.check()
    assert [sequence for sequence, _ in store.recent_samples("press")] == [7, 8, 9]


def test_whoever_takes_over_reads_the_rows_that_may_concern_him(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """A service on a database of many, which reads its file again, must not look through the samples of all others."""
    other, read = Feed(store, "hall-1"), list[str]()
    for _ in range(3):
        other.write(["press"], {})
    plain = bundles._read_contents
    monkeypatch.setattr(bundles, "_read_contents", lambda text: read.append(text) or plain(text))
    neighbour = next(
        name for k in range(1000) if bundles.bundle_number(name := f"a{k}") == bundles.bundle_number("press")
    )
    for assets, rows_read in (([], 0), ([neighbour], 3)):
        store.take_over("hall-2", assets)
        assert len(read) == rows_read
    assert rows(store, tables.bundles) == 3


def test_no_row_is_larger_than_a_database_takes(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """After an outage a commit has thousands of blocks; SQLite takes no row beyond a gigabyte."""
    monkeypatch.setattr(bundles, "ROW_BYTES", 1000)
    feed = Feed(store)
    for _ in range(3):
        feed.write(["press", "lift"] * 40, {})
        feed.check()
    sizes = [len(samples) for (samples,) in store.fetch_tuples(sa.select(tables.bundles.c.samples))]
    assert len(sizes) > 20 and max(sizes) < 1200  # and the block that came last
    feed.write([], {"press": 119, "lift": 120})
    feed.check()
    assert rows(store, tables.bundles) == 1


def test_a_row_is_deleted_when_nobody_needs_a_block_of_it() -> None:
    index = BundleIndex([])
    (row,) = index.advance([("a", 0, b"x" * 8, False), ("a", 1, b"y" * 8, False)], {}).new
    assert row["samples"] == b"x" * 8 + b"y" * 8
    assert index.advance([], {"a": 1}).unneeded == []
    assert index.advance([], {"a": 2}).unneeded == [(row["bundle"], row["number"])]
    assert index.advance([("a", 2, b"", False)], {"a": 3}).new == []  # after an outage: it is too old by now
