"""What a stream moves and stores instead of rows, and how a shard follows its assets, without Spark around it."""

from __future__ import annotations

import json
from typing import Any

import lakes
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servoscope.core.errors import RecordingError
from servoscope.fleet.baselines import Baselines
from servoscope.fleet.partition import DAY_US
from servoscope.fleet.rows import Rows, rows_from_table
from servoscope.fleet.stream_blocks import AssetRows, check_lists, from_text, pack_blocks, to_text
from servoscope.fleet.stream_shard import StreamShard
from servoscope.fleet.tasks import examine_day
from servoscope.learning.learn import learn_baseline
from servoscope.models.loop import Columns
from servoscope.signals.readers.table import Table

COLUMNS = Columns()


@given(st.binary(max_size=300))
def test_bytes_travel_as_text_of_seven_bits(content: bytes) -> None:
    text = to_text(content)
    assert text.isascii() and from_text(text) == content
    assert len(text) <= 64 * (len(content) // 56 + 1) + 3  # an eighth more, and the length


@given(
    st.one_of(
        st.lists(st.integers(-(2**60), 2**60), max_size=20),
        st.builds(lambda step, n: list(range(-step, n * step, step)) * 2, st.integers(1, 10**6), st.integers(1, 40)),
    ),
    st.sampled_from([(), ("load",), ("load", "oil temperature")]),
)
def test_rows_travel_as_bytes_with_times_that_keep_step_as_their_steps(
    times: list[int], names: tuple[str, ...]
) -> None:
    x = np.arange(float(len(times)))
    rows = Rows(np.array(times, dtype=np.int64), x, x + 0.1, -x, {name: x + len(name) for name in names})
    packed = rows.pack(b"8 bytes:")
    found = Rows.unpack(packed, 8)
    assert_same(found, rows)
    assert {name: x.tolist() for name, x in found.channels.items()} == {k: x.tolist() for k, x in rows.channels.items()}
    if len(times) > 20 and not names:
        assert len(packed) == 8 + 16 + 4 * 16 + 24 * len(times)  # two starts and two runs of steps


def day(asset: int, which: int = 0, leak: float = 1.0, samples: slice = slice(None)) -> pa.Table:
    """A day of an asset, one row per sample, with its name."""
    table = lakes.table_of(lakes.recorded(asset, which, 15.0, leak), which)
    numbers = range(table.num_rows)[samples]
    table = table.slice(numbers.start, len(numbers))
    names = pa.array([f"P{asset}"] * table.num_rows)
    return table.append_column("asset", names).append_column("baseline_of", names)


def messages(table: pa.Table, size: int, times: bool) -> pa.Table:
    """The rows of one asset as messages of some samples each, with all times or with the first and the sample time."""
    starts = np.arange(0, table.num_rows, size)
    offsets = pa.array([*starts.tolist(), table.num_rows], pa.int32())
    made = {name: table[name].take(pa.array(starts)) for name in ("asset", "baseline_of", "t")}
    made |= {"dt": pa.array(np.full(len(starts), 0.01))}
    for name in ("r", "u", "y", *(["t"] if times else [])):
        made[name] = pa.chunked_array([pa.ListArray.from_arrays(offsets, table[name].combine_chunks())])
    return pa.table(made)


def unpacked(tables: list[pa.Table], shards: int = 3) -> dict[str, Rows]:
    """What arrives of tables: the rows of each asset."""
    found: dict[str, list[Rows]] = {}
    for batch in pack_blocks((batch for table in tables for batch in table.to_batches()), "t", COLUMNS, shards):
        for packed in batch["rows"].to_pylist():
            for asset, baseline, rows in AssetRows.unpack(packed).split():
                assert asset == baseline
                found.setdefault(asset, []).append(rows)
    return {asset: Rows.concatenate(parts) for asset, parts in found.items()}


def assert_same(found: Rows, wanted: Rows) -> None:
    assert found.t_us.tolist() == wanted.t_us.tolist()
    for name in ("r", "u", "y"):
        assert np.array_equal(getattr(found, name), getattr(wanted, name), equal_nan=True)


@pytest.mark.parametrize("form", ["rows", "first time", "all times"])
def test_rows_and_messages_arrive_as_the_same_blocks(form: str) -> None:
    tables = [day(asset) for asset in (0, 1, 2)]
    wanted = {
        f"P{i}": rows_from_table(
            Table("day", dict(zip("truy", (t["t"], t["r"], t["u"], t["y"]), strict=True))), COLUMNS
        )
        for i, t in enumerate(tables)
    }
    sent = tables if form == "rows" else [messages(table, 64, form == "all times") for table in tables]
    mixed = pa.concat_tables(sent).combine_chunks()
    order = np.random.default_rng(1).permutation(mixed.num_rows)
    found = unpacked([mixed.take(pa.array(order))])
    assert set(found) == set(wanted)
    for asset, rows in found.items():
        assert_same(rows.sort_by_time(), wanted[asset])


def test_a_list_of_another_length_than_its_block_is_missing_and_a_row_without_time_is_left_out() -> None:
    sent = messages(day(0), 10, times=False).slice(0, 4)
    short = pa.array([[1.0] * 10, [1.0] * 9, None, [1.0] * 10])
    times = pa.chunked_array([[*sent["t"].combine_chunks()[:3].tolist(), None]], pa.timestamp("us"))
    rows = unpacked([sent.set_column(sent.schema.get_field_index("u"), "u", short).set_column(2, "t", times)])["P0"]
    assert len(rows) == 30
    assert np.isnan(rows.u).tolist() == [False] * 10 + [True] * 20
    assert not np.isnan(rows.y).any()


def test_a_message_whose_sample_time_is_missing_or_absurd_is_left_out() -> None:
    sent = messages(day(0), 10, times=False).slice(0, 5)
    steps = pa.array([0.01, None, np.nan, 1e30, -1e30])
    rows = unpacked([sent.set_column(sent.schema.get_field_index("dt"), "dt", steps)])["P0"]
    assert_same(rows, unpacked([sent.slice(0, 1)])["P0"])


def test_columns_are_those_of_rows_or_of_messages() -> None:
    names = ["t", "r", "u", "y"]
    check_lists([], names, "t")
    check_lists(names, names, "t")
    check_lists(["r", "u", "y"], [*names, "dt"], "t")
    with pytest.raises(RecordingError, match="column 'y' holds single numbers, and 'r' arrays"):
        check_lists(["r", "u"], [*names, "dt"], "t")
    with pytest.raises(RecordingError, match="the column 'dt' must say how many seconds"):
        check_lists(["r", "u", "y"], names, "t")


class Memory(dict[Any, Any]):
    """State as Spark keeps it, in memory; `timers` are those that were set [ms]."""

    def __init__(self) -> None:
        super().__init__()
        self.timers: list[int] = []
        self.updateValue, self.getValue, self.removeKey = self.__setitem__, self.__getitem__, self.__delitem__
        self.registerTimer = self.timers.append

    def get(self, *_: Any) -> Any:
        return super().get("head")

    def update(self, value: Any) -> None:  # type: ignore[override]  # Spark's name
        self["head"] = value


def test_what_the_next_watermark_will_have_passed_is_stored_apart_from_the_rest() -> None:
    head, entries = Memory(), Memory()
    rows = {
        asset: Rows(np.arange(5000) * 1000 + begin, *np.zeros((3, 5000))) for asset, begin in (("P0", 0), ("P1", 7))
    }
    blocks = [AssetRows([(asset, "A")], [1000], each[i : i + 1000]) for asset, each in rows.items() for i in (0, 3000)]
    assert not list(StreamShard(head, entries, head, Baselines({}, 1, 8.0), 500_000).store_rows(blocks))
    stored = [AssetRows.unpack(from_text(text)).rows.t_us for (text,) in entries.values()]
    assert sum(map(len, stored)) == 4000
    cut = rows["P1"].t_us[3999] - 500_000
    assert sorted((each > cut).all() for each in stored) == [False, True]
    assert not any((each > cut).any() and (each <= cut).any() for each in stored)


def test_a_shard_follows_assets_together_as_each_alone_to_the_last_bit() -> None:
    loop = lakes.loop()
    baselines = {f"P{i}": learn_baseline(loop, [lakes.recorded(i, 0, 15.0)]) for i in (0, 1)}
    baselines |= {"P2": baselines["P0"], "P3": baselines["P1"]}
    # P1 breaks; P2 begins 7 samples later, so that its evaluations are at other samples than those of the others
    days = {"P0": day(0, 1), "P1": day(1, 1, leak=1.5), "P2": day(2, 1, samples=slice(7, None)), "P3": day(3, 1)}
    known = Baselines.from_source(baselines, 4, 8.0)
    head, entries = Memory(), Memory()
    frames: list[pd.DataFrame] = []
    first = int(np.datetime64(f"{lakes.DAYS[1]}T06:00:00", "us").astype(np.int64))
    for second in range(0, 15, 3):
        now = [
            table.filter(
                pa.compute.equal(pa.array((table["t"].to_numpy().astype(np.int64) - first) // 3_000_000), second // 3)
            )
            for table in days.values()
        ]
        (batch,) = pack_blocks(pa.concat_tables(now).combine_chunks().to_batches(), "t", COLUMNS, 1)
        shard = StreamShard(head, entries, head, known, 500_000)
        frames += shard.store_rows([AssetRows.unpack(packed) for packed in batch["rows"].to_pylist()])
        shard.save()
        shard = StreamShard(head, entries, head, known, 500_000)  # a worker knows what is in the state, and no more
        frames += shard.process_until(first + second * 1_000_000 + 2_500_000)
        shard.save()
    late = AssetRows([("P0", "P0")], [5], unpacked([days["P0"]])["P0"][:5])
    shard = StreamShard(head, entries, head, known, 500_000)
    frames += shard.store_rows([late])
    shard.save()
    shard = StreamShard(head, entries, head, known, 500_000)
    midnight = (first // DAY_US + 1) * DAY_US
    assert head.timers[-1] * 1000 > first and min(head.timers[-1:]) * 1000 < midnight
    frames += shard.process_until(midnight)
    assert not entries
    found = pd.concat(frames)
    assert found[found.kind == "late"][["asset", "day", "late"]].values.tolist() == [["P0", lakes.DAYS[1], 5]]
    for asset, table in days.items():
        rows = unpacked([table])[asset]
        result, trace = examine_day(known.day_monitor(asset), [rows])
        mine = found[found.asset == asset]
        (item,) = mine[mine.kind == "item"].result
        assert json.loads(item) == {"asset": asset, "day": lakes.DAYS[1], **json.loads(json.dumps(result))}
        for name in ("statistic", "level", "threshold"):
            assert mine[mine.kind == "trace"][name].tolist() == getattr(trace[0], name).tolist()
        assert np.array_equal(np.array(mine[mine.kind == "trace"].theta.tolist()), trace[0].theta)
    verdicts = {json.loads(text)["asset"]: json.loads(text)["diagnosis"]["verdict"] for text in found.result.dropna()}
    assert verdicts["P1"] == "fault" and verdicts["P0"] == "healthy"


def test_a_day_whose_baseline_is_learned_again_under_way_fails_alone() -> None:
    old, new = (learn_baseline(lakes.loop(), [lakes.recorded(i, 0, 15.0)]) for i in (0, 1))
    head, entries, frames = Memory(), Memory(), []
    days = {"P0": day(0, 1), "P1": day(1, 1)}
    first = int(np.datetime64(f"{lakes.DAYS[1]}T06:00:00", "us").astype(np.int64))
    midnight = (first // DAY_US + 1) * DAY_US
    for part, own in ((slice(0, 700), old), (slice(700, None), new)):
        sent = pa.concat_tables([table.take(list(range(table.num_rows))[part]) for table in days.values()])
        (batch,) = pack_blocks(sent.combine_chunks().to_batches(), "t", COLUMNS, 1)
        shard = StreamShard(head, entries, head, Baselines.from_source({"P0": own, "P1": new}, 2, 8.0), 0)
        frames += shard.store_rows([AssetRows.unpack(packed) for packed in batch["rows"].to_pylist()])
        frames += shard.process_until(midnight if own is new else first + 6_900_000)
        shard.save()
    items = {item["asset"]: item for item in map(json.loads, pd.concat(frames).result.dropna())}
    assert items["P0"]["status"] == "failed" and "its baseline changed during the day" in items["P0"]["error"]
    assert items["P1"]["status"] == "examined"
