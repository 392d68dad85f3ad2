"""The last minutes of samples: a commit writes the blocks of many assets as one row, in a fraction of the time.

A row is deleted when nobody needs a block of it. Where few of its blocks are still needed after a while, of an asset
that has fallen silent for example, these go on as rows of their own: one asset does not hold the blocks of all others.
"""

from __future__ import annotations

import math
import zlib
from collections import defaultdict, deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import chain
from typing import Any, NamedTuple

import msgspec
import numpy as np
import sqlalchemy as sa

from servoscope.core.arrays import FloatArray
from servoscope.service.sources.block import covariate_tail, split_covariate_tail
from servoscope.service.store import tables
from servoscope.service.store.rows import Row

BUNDLES = 64  # that all assets are shared out among: whoever reads one asset reads the rows of its bundle
# commits: two rounds of checkpoints, after which a row that is needed in part is no longer waited for
MAX_COMMITS_WAITED = 80
ROW_BYTES = 2**24  # about, at which another row begins: after an outage a commit may have more than a database takes
RATE_DIGITS = 2  # of the rate of time stamps [Hz]


# an asset, a sequence, its samples, and whether they are without time stamps (`pack_samples`)
SampleBlock = tuple[str, int, bytes, bool]
# what a bundle's row tells of one of its blocks: asset, sequence, bytes in the row, and whether it is without its time
# stamps, which follow from the first one and the rate
BundlePart = tuple[str, int, int, bool]
BundleKey = tuple[int, int]  # which row of an owner: bundle and number; plain, as the garbage collector skips these


class BundleChanges(NamedTuple):
    """What a commit does to the rows of its owner."""

    new: list[Row]
    unneeded: list[BundleKey]
    sparse: list[BundleKey]  # few of their blocks are still needed, and these go on as rows of their own


def bundle_number(asset: str) -> int:
    """Return the bundle that an asset is in, always and in every store."""
    return zlib.crc32(asset.encode()) % BUNDLES


class BundleIndex:
    """Which rows of an owner hold blocks that are still needed; `rows`: bundle, number and contents of those stored."""

    def __init__(self, rows: Iterable[tuple[int, int, str]]) -> None:
        self._number = 0  # of the newest row
        self._counts: dict[BundleKey, list[int]] = {}  # how many blocks of a row are needed, and how many there are
        self._bundle_number = cache(bundle_number)
        # of each asset, sequences and where they are
        self._held: defaultdict[str, deque[tuple[int, BundleKey]]] = defaultdict(deque)
        self._sparse: dict[BundleKey, int] = {}  # the newest row when at most half of a row was needed any more
        for bundle, number, contents in sorted(rows, key=lambda row: row[1]):
            self._hold((bundle, number), _read_contents(contents))
            self._number = max(self._number, number)

    def advance(self, blocks: Sequence[SampleBlock], first_needed: Mapping[str, int]) -> BundleChanges:
        """Return what changes with further blocks, and when assets need those from a sequence on only."""
        changes, counts = BundleChanges([], [], []), self._counts
        self._number += 1
        for asset, first in first_needed.items():
            held = self._held.get(asset)
            while held and held[0][0] < first:
                _, key = held.popleft()
                if (left := counts.get(key)) is None:
                    continue  # its blocks are rows of their own
                left[0] -= 1
                if not left[0]:
                    del counts[key]
                    self._sparse.pop(key, None)
                    changes.unneeded.append(key)
                elif 2 * left[0] <= left[1]:
                    self._sparse.setdefault(key, self._number)
        while self._sparse and next(iter(self._sparse.values())) <= self._number - MAX_COMMITS_WAITED:
            key = next(iter(self._sparse))
            del self._sparse[key], counts[key]
            changes.sparse.append(key)
        # after an outage most of them are old by now
        wanted = [block for block in blocks if block[1] >= first_needed.get(block[0], block[1])]
        bundles: defaultdict[BundleKey, tuple[list[BundlePart], list[bytes]]] = defaultdict(lambda: ([], []))
        sizes, newest = defaultdict[int, int](int), self._number  # of each bundle, bytes so far
        for asset, sequence, stored, regular in wanted:
            bundle = self._bundle_number(asset)
            sizes[bundle] += len(stored)
            parts, samples = bundles[bundle, newest + sizes[bundle] // ROW_BYTES]
            parts.append((asset, sequence, len(stored), regular))
            samples.append(stored)
        for (bundle, number), (parts, samples) in bundles.items():
            self._hold((bundle, number), parts)
            self._number = max(self._number, number)
            contents = msgspec.json.encode(parts).decode()
            changes.new.append({"bundle": bundle, "number": number, "contents": contents, "samples": b"".join(samples)})
        return changes

    def _hold(self, key: BundleKey, parts: Sequence[BundlePart]) -> None:
        self._counts[key] = [len(parts), len(parts)]
        for asset, sequence, *_ in parts:
            self._held[asset].append((sequence, key))


def pack_samples(signals: FloatArray) -> list[tuple[bytes, bool]]:
    """Return blocks of one shape as bytes, and of each whether it is without time stamps.

    `signals`: t, r, u, y and the covariates of each, shape (blocks, 4 + k, N). Time stamps are left out where they are
    t_0 + i / rate to the last bit: such a block begins with t_0 and the rate, and `restore_times` returns what
    `Block.pack` would have returned, as other blocks are.
    """
    numbers, (count, rows, n) = signals.astype("<f8", copy=False), signals.shape
    tail = covariate_tail(rows - 4)
    t, first = numbers[:, 0], numbers[:, 0, :1]
    if n < 2:
        return [(number.tobytes() + tail, False) for number in numbers]
    with np.errstate(all="ignore"):  # what is no time is kept as it is
        rate = np.round((n - 1) / (t[:, -1:] - first), RATE_DIGITS)
        regular = ((first + np.arange(n) / rate).view(np.int64) == t.view(np.int64)).all(axis=1)
    short = np.concatenate([first, rate, numbers[:, 1:].reshape(count, -1)], axis=1)
    stored = (short[i] if is_regular else numbers[i] for i, is_regular in enumerate(regular.tolist()))
    return [
        (samples_.tobytes() + tail, is_regular) for samples_, is_regular in zip(stored, regular.tolist(), strict=True)
    ]


def restore_times(stored: bytes) -> bytes:
    """Return the packed block that `pack_samples` made shorter."""
    numbers, k = split_covariate_tail(stored)
    (first, rate), signals = np.frombuffer(numbers[:16], dtype="<f8"), numbers[16:]
    n = len(signals) // 8 // (3 + k)
    t: FloatArray = first + np.arange(n) / rate
    return t.astype("<f8").tobytes() + signals + covariate_tail(k)


def _read_contents(contents: str) -> list[BundlePart]:
    return msgspec.json.decode(contents, type=list[BundlePart])


def read_index(connection: sa.Connection, owner: str) -> BundleIndex:
    """Return which rows an owner has."""
    rows = sa.select(*_columns("bundle", "number", "contents")).where(tables.bundles.c.owner == owner)
    return BundleIndex((bundle, number, contents) for bundle, number, contents in connection.execute(rows))


def read_samples(
    connection: sa.Connection, assets: Iterable[str], newest: int | None = None, *, in_bundles: bool = True
) -> Iterator[tuple[str, list[tuple[int, bytes]]]]:
    """Yield each asset, in any order, and its blocks that are needed, in theirs: sequence and packed samples.

    `newest`: only so many of them; `in_bundles`: False in stores of before version 3, where each has a row of its own.
    """
    of_bundle: defaultdict[int, list[str]] = defaultdict(list)
    for asset in assets:
        of_bundle[bundle_number(asset)].append(asset)
    for bundle, names in of_bundle.items():
        blocks_by_asset: dict[str, list[tuple[int, bytes]]] = {name: [] for name in names}
        alone = connection.execute(sa.select(tables.recent).where(tables.recent.c.asset.in_(names)))
        first = dict.fromkeys(names, 0)
        contents: dict[tuple[str, int], list[BundlePart]] = {}
        if in_bundles:
            first |= _first_needed(connection, names)
            rows = sa.select(*_columns("owner", "number", "contents")).where(tables.bundles.c.bundle == bundle)
            contents = {(of, number): _read_contents(text) for of, number, text in connection.execute(rows)}
        for asset, sequence, samples in alone:
            blocks_by_asset[asset].append((sequence, samples))
        if newest is not None:
            sequences = {name: [sequence for sequence, _ in blocks_by_asset[name]] for name in names}
            for asset, sequence, *_ in chain.from_iterable(contents.values()):
                if asset in sequences:
                    sequences[asset].append(sequence)
            first |= {name: max([first[name], *sorted(have)[-newest:][:1]]) for name, have in sequences.items()}
        for (owner, number), parts in contents.items():
            if any(sequence >= first.get(asset, math.inf) for asset, sequence, *_ in parts):
                for asset, sequence, samples in _read_row(connection, owner, (bundle, number)):
                    if asset in blocks_by_asset:
                        blocks_by_asset[asset].append((sequence, samples))
        for name, blocks in blocks_by_asset.items():
            yield name, sorted(block for block in blocks if block[0] >= first[name])


def _first_needed(connection: sa.Connection, assets: Iterable[str]) -> dict[str, int]:
    rows = connection.execute(sa.select(tables.needed).where(tables.needed.c.asset.in_(set(assets))))
    return {row.asset: row.sequence for row in rows}


def _columns(*names: str) -> list[sa.Column[Any]]:
    return [tables.bundles.c[name] for name in names]


def _is_row(owner: Any, bundle: Any, number: Any) -> sa.ColumnElement[bool]:
    columns = tables.bundles.c
    return sa.and_(columns.bundle == bundle, columns.owner == owner, columns.number == number)


# to make a statement takes longer than to execute it
NEW_ROW = tables.bundles.insert()
UNNEEDED_ROW = tables.bundles.delete().where(
    _is_row(*(sa.bindparam(name) for name in ("of", "of_bundle", "of_number")))
)


def _read_row(
    connection: sa.Connection, owner: str, key: BundleKey, *, lock: bool = False
) -> list[tuple[str, int, bytes]]:
    """Return the blocks of a row, each packed as `Block.pack` does, none if there is no such row any more."""
    query = sa.select(*_columns("contents", "samples")).where(_is_row(owner, *key))
    row = connection.execute(query.with_for_update() if lock else query).first()
    entries, at = list[tuple[str, int, bytes]](), 0
    contents, whole = ("[]", b"") if row is None else row
    for asset, sequence, size, regular in _read_contents(contents):
        stored = whole[at : at + size]
        entries.append((asset, sequence, restore_times(stored) if regular else stored))
        at += size
    return entries


def write_bundles(connection: sa.Connection, owner: str, changes: BundleChanges) -> None:
    """Write what a commit changes, in its transaction."""
    for key in changes.sparse:
        dissolve_row(connection, owner, key)
    if changes.unneeded:
        keys = [{"of": owner, "of_bundle": bundle, "of_number": number} for bundle, number in changes.unneeded]
        connection.execute(UNNEEDED_ROW, keys)
    if changes.new:
        connection.execute(NEW_ROW, [{"owner": owner, **row} for row in changes.new])


def dissolve_row(connection: sa.Connection, owner: str, key: BundleKey) -> None:
    """Replace a row by rows of their own for those of its blocks that are still needed."""
    blocks = _read_row(connection, owner, key, lock=True)
    first = _first_needed(connection, (asset for asset, *_ in blocks))
    kept = [
        {"asset": asset, "sequence": sequence, "samples": samples}
        for asset, sequence, samples in blocks
        if sequence >= first.get(asset, 0)
    ]
    connection.execute(tables.bundles.delete().where(_is_row(owner, *key)))
    if kept:
        connection.execute(tables.recent.insert(), kept)


def dissolve_rows_of_others(connection: sa.Connection, owner: str, assets: Collection[str]) -> None:
    """Dissolve the rows of other owners with blocks of these assets: `owner` follows them now."""
    theirs = sa.select(*_columns("bundle", "owner", "number", "contents")).where(tables.bundles.c.owner != owner)
    own = tables.bundles.c.bundle.in_({bundle_number(asset) for asset in assets})
    others = [
        (of, (bundle, number))
        for bundle, of, number, contents in connection.execute(theirs.where(own))
        if any(asset in assets for asset, *_ in _read_contents(contents))
    ]
    for of, key in others:
        dissolve_row(connection, of, key)
