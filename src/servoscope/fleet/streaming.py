"""The fleet as a stream of Spark: rows wait in the state for the watermark, then are sorted and followed.

Before they are shuffled by asset, each Arrow batch becomes one block of bytes per asset: what Spark does to a row costs
more than all that follows.

Rows of an asset may come in several Arrow batches, in any order, from any partition. They are only stored until the
watermark has passed them, and then followed in the order of time: where all rows are on time, results depend on them
alone. A row from before what has been followed already is late, and counted.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servoscope.core.errors import LoopError, RecordingError, ServoscopeError
from servoscope.detection.baseline import Baseline
from servoscope.fleet.baselines import Baselines
from servoscope.fleet.day_monitor import WINDOW, DayState, EvaluationBlock
from servoscope.fleet.partition import BLOCKS, DAY_US, day_name, join_blocks, pack_blocks
from servoscope.fleet.rows import Rows, required_columns
from servoscope.fleet.tasks import day_result, error_text, failed_result
from servoscope.models.loop import Columns
from servoscope.signals.readers.table import TIME_UNITS

if TYPE_CHECKING:
    from pyspark.sql import DataFrame, SparkSession
    from pyspark.sql.streaming import StatefulProcessorHandle


SCHEMA = (
    "kind string, asset string, day string, time_us long, theta array<double>, statistic double, threshold double, "
    "level double, late long, result string"
)
ROCKSDB = "org.apache.spark.sql.execution.streaming.state.RocksDBStateStoreProvider"
PARTITIONS = "spark.sql.shuffle.partitions"
DEFAULT_PARTITIONS = "200"  # Spark's own: of a small stream, most would be empty, and each costs a task per batch
PARTITIONS_PER_CORE = 3
FAR_PAST = -(2**62)


def follow(
    frame: DataFrame,
    baselines: Baseline | Mapping[str, Baseline] | str | Path,
    *,
    assets: int,
    columns: Columns | None = None,
    delay_s: float = 10.0,
    by: str = "asset",
    window_s: float = WINDOW,
) -> DataFrame:
    """Follow and diagnose a stream of rows; for rows that are on time, bit for bit as the local engine.

    Parameters
    ----------
    frame
        A streaming DataFrame with the columns ``asset`` and those of the signals; time is a timestamp, or a number
        since 1970. Days are those of UTC.
    baselines
        One for all, one by asset, or a folder with NAME.json that all workers see.
    assets
        How many assets share the budget of false alarms.
    columns
        Where the signals are; None: where the baseline's loop says.
    delay_s
        How late rows may be [s].
    by
        Column whose value names the baseline.
    window_s
        Seconds of raw rows that a diagnosis covers.

    Returns
    -------
    pyspark.sql.DataFrame
        Rows of kind ``trace``, one per evaluation; ``item``, one per asset and day that is over, with ``result`` as
        JSON; ``late``, how many rows of an asset came too late. For a sink in append mode.

    Raises
    ------
    RecordingError, LoopError
        If a column is missing, or the session's time zone is not UTC.
    """
    from pyspark.sql import functions as F

    session = frame.sparkSession
    if session.conf.get("spark.sql.session.timeZone") not in ("UTC", "Etc/UTC", "GMT", "Z"):
        raise LoopError("a stream's days are those of UTC: set spark.sql.session.timeZone to UTC")
    session.conf.set("spark.sql.streaming.stateStore.providerClass", ROCKSDB)
    _set_partitions(session, assets)
    known = Baselines.from_source(baselines, assets, window_s)
    mapping = columns if columns is not None else known.first().loop.columns
    time, *signals = required_columns(mapping, frame.columns, "the stream")
    if time in signals:
        raise RecordingError(f"the stream: column {time!r} cannot be time and signal")
    kind = frame.schema[time].dataType.typeName()
    stamp = frame[time].cast("timestamp")
    if not kind.startswith("timestamp"):
        micros = F.rint(frame[time] * TIME_UNITS[mapping.time_unit] * 1e6).cast("long")
        stamp = F.timestamp_micros(micros)
    named = [frame[name] for name in signals]
    asset, baseline = frame["asset"].cast("string"), frame[by].cast("string").alias("baseline_of")
    keyed = frame.select(asset, baseline, F.unix_micros(stamp).alias("at_us"), *named).where("at_us is not null")
    blocks = keyed.mapInArrow(lambda batches: pack_blocks(batches, mapping), BLOCKS)
    last = F.timestamp_micros("last_us").alias("_at")
    marked = blocks.select("*", last).withWatermark("_at", f"{round(delay_s * 1e3)} milliseconds")
    # without the column that bears the watermark Spark drops no late row unseen: they are counted here, by asset
    rows = marked.select("asset", "baseline_of", "rows")
    processor = _create_processor(known)
    return rows.groupBy("asset").transformWithStateInPandas(processor, SCHEMA, "append", "eventtime")


@dataclass
class StreamState:
    """What is kept of an asset beside its raw rows: a line of numbers and the state of the day that is open."""

    baseline: str = ""  # its name
    processed_until_us: int = FAR_PAST  # all rows up to here have been followed [us]
    next_block: int = 0  # number of the next block of raw rows
    blocks: dict[int, tuple[int, int]] = field(default_factory=dict)  # number -> first and last time [us] of its rows
    day: int | None = None  # the day that is open
    error: str = ""  # why the open day cannot be followed
    state: DayState | None = None

    def pack(self) -> bytes:
        """Return it as bytes."""
        numbers = {
            "by": self.baseline,
            "until_us": self.processed_until_us,
            "number": self.next_block,
            "blocks": self.blocks,
            "day": self.day,
            "error": self.error,
        }
        return json.dumps(numbers).encode() + b"\n" + (self.state.pack() if self.state is not None else b"")

    @classmethod
    def unpack(cls, content: bytes) -> StreamState:
        """Return what `pack` packed."""
        line, _, packed = content.partition(b"\n")
        numbers = json.loads(line)
        blocks = {int(number): (low, high) for number, (low, high) in numbers["blocks"].items()}
        state = DayState.unpack(packed) if packed else None
        return cls(
            numbers["by"], numbers["until_us"], numbers["number"], blocks, numbers["day"], numbers["error"], state
        )

    @property
    def pending_us(self) -> int | None:
        """The first row that waits for the watermark, or a time before it [us]; None: none does."""
        done = self.processed_until_us
        return min((max(low, done + 1) for low, high in self.blocks.values() if high > done), default=None)


def _set_partitions(session: SparkSession, assets: int) -> None:
    """Take as many partitions as assets and cores have use for, unless somebody has chosen a number."""
    context = session.sparkContext
    if session.conf.get(PARTITIONS) == DEFAULT_PARTITIONS and not context.getConf().contains(PARTITIONS):
        session.conf.set(PARTITIONS, str(min(max(assets, 1), PARTITIONS_PER_CORE * context.defaultParallelism)))


def _create_processor(baselines: Baselines) -> Any:
    """Return the stateful processor; its class needs PySpark, which is imported late."""
    from pyspark.sql.streaming import StatefulProcessor

    class Processor(StatefulProcessor):  # type: ignore[misc]  # PySpark is typed where it is installed
        def init(self, handle: StatefulProcessorHandle) -> None:
            self.handle = handle
            self.head = handle.getValueState("head", "content binary")
            self.blocks = handle.getMapState("blocks", "number long", "content binary")

        def handleInputRows(self, key: Any, rows: Iterator[Any], timerValues: Any) -> Iterator[Any]:
            asset = _StreamAsset(key[0], self, baselines)
            late: Counter[int] = Counter()
            for baseline, chunk in join_blocks(rows):
                late += asset.store_rows(baseline, chunk)
            asset.save()
            for day, count in sorted(late.items()):
                yield _output(asset.name, kind=["late"], day=[day_name(day)], late=[count])

        def handleExpiredTimer(self, key: Any, timerValues: Any, expiredTimerInfo: Any) -> Iterator[Any]:
            asset = _StreamAsset(key[0], self, baselines)
            yield from asset.process_until(timerValues.getCurrentWatermarkInMs() * 1000)
            asset.save()

        def close(self) -> None:
            pass

    return Processor()


class _StreamAsset:
    """One asset of a stream, for as long as a worker processes it."""

    def __init__(self, name: str, store: Any, baselines: Baselines) -> None:
        self.name, self.store, self.baselines = name, store, baselines
        packed = store.head.get()
        self.head = StreamState.unpack(bytes(packed[0])) if packed is not None else StreamState()
        self._cache: dict[int, Rows] = {}

    def store_rows(self, baseline: str, rows: Rows) -> Counter[int]:
        """Store the rows that are on time; return how many are late, by day."""
        head, t_us = self.head, rows.t_us
        head.baseline = baseline
        late = t_us <= head.processed_until_us
        rows = rows[~late]
        if len(rows):
            self.store.blocks.updateValue((head.next_block,), (rows.pack(),))
            head.blocks[head.next_block] = (int(rows.t_us.min()), int(rows.t_us.max()))
            head.next_block += 1
        return Counter((t_us[late] // DAY_US).tolist())

    def save(self) -> None:
        """Save the state, and set the timer: for the first row that waits, or the end of the day that is open."""
        times = [] if self.head.pending_us is None else [self.head.pending_us]
        times += [] if self.head.day is None else [(self.head.day + 1) * DAY_US]
        if times:
            self.store.handle.registerTimer(min(times) // 1000 + 1)
        self.store.head.update((self.head.pack(),))

    def process_until(self, until_us: int) -> Iterator[Any]:
        """Follow all rows up to a time, and close the days that are over by then; yield the results."""
        head = self.head
        if until_us <= head.processed_until_us:
            return
        pending = self._rows(head.processed_until_us, until_us)
        head.processed_until_us = until_us
        for day in np.unique(pending.t_us // DAY_US):
            if head.day is not None and head.day != int(day):
                yield self._close_day()
            head.day = int(day)
            evaluations = self._advance(pending[pending.t_us // DAY_US == day])
            if evaluations is not None and len(evaluations.t_us):
                yield _trace_frame(self.name, day_name(int(day)), evaluations)
        if head.day is not None and until_us >= (head.day + 1) * DAY_US:
            yield self._close_day()
        keep = until_us
        if head.state is not None and head.day is not None and not head.error:
            keep = min(keep, self.baselines.day_monitor(head.baseline).needed_since(head.state))
        for number in [number for number, (_, high) in head.blocks.items() if high <= keep]:
            self.store.blocks.removeKey((number,))
            del head.blocks[number]

    def _advance(self, rows: Rows) -> EvaluationBlock | None:
        head = self.head
        if head.error:
            return None
        try:
            monitor = self.baselines.day_monitor(head.baseline)
            state = head.state if head.state is not None else monitor.start()
            head.state, evaluations = monitor.advance(state, rows, self._rows)
        except Exception as error:  # garbage of one asset must not end the stream
            head.error = error_text(error)
            return None
        return evaluations

    def _close_day(self) -> Any:
        head = self.head
        assert head.day is not None, "a day is open"
        try:
            if head.error or head.state is None:
                raise ServoscopeError(head.error)
            monitor = self.baselines.day_monitor(head.baseline)
            result = day_result(monitor, monitor.finish(head.state, self._rows))
        except Exception as error:
            result = failed_result(error)
        day = day_name(head.day)
        head.day, head.state, head.error = None, None, ""
        text = json.dumps({"asset": self.name, "day": day, **result}, allow_nan=False)
        return _output(self.name, kind=["item"], day=[day], result=[text])

    def _rows(self, after_us: int, to_us: int) -> Rows:
        """Return the stored rows with after_us < t <= to_us, in the order of time."""
        parts = []
        for number, (low, high) in sorted(self.head.blocks.items()):
            if high > after_us and low <= to_us:
                if number not in self._cache:
                    self._cache[number] = Rows.unpack(bytes(self.store.blocks.getValue((number,))[0]))
                parts.append(self._cache[number].between(after_us, to_us))
        return Rows.concatenate(parts).sort_by_time()


def _trace_frame(asset: str, day: str, block: EvaluationBlock) -> Any:
    n = len(block.t_us)
    columns = {name: getattr(block, name) for name in ("statistic", "threshold", "level")}
    return _output(asset, kind=["trace"] * n, day=[day] * n, time_us=block.t_us, theta=list(block.theta), **columns)


def _output(asset: str, *, kind: list[str], **columns: Any) -> Any:
    """Return rows of `SCHEMA`; columns that are not named are empty."""
    import pandas as pd

    known = {"kind": kind, "asset": [asset] * len(kind), **columns}
    names = [column.split()[0] for column in SCHEMA.split(", ")]
    return pd.DataFrame({name: known.get(name, [None] * len(kind)) for name in names})
