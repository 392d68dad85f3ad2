"""Structured Streaming carries the same step: rows wait in state for the watermark, then are sorted and followed.

Rows of an asset may come in several Arrow batches, in any order, from any partition. They are put away as they come,
and nothing else happens until the watermark has passed them: then they are followed in the order of time. So results
depend on the rows alone where all of them are on time; a row behind what has been followed already is late and counted.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servoscope.baseline import Baseline
from servoscope.errors import LoopError, RecordingError, ServoscopeError
from servoscope.fleet.baselines import Baselines
from servoscope.fleet.following import WINDOW, Evaluated, State
from servoscope.fleet.passing import DAY_US, day_name
from servoscope.fleet.rows import Rows, names_of, signals_of
from servoscope.fleet.tasks import examined
from servoscope.loop import Columns
from servoscope.readers.tables import UNITS, Table

if TYPE_CHECKING:
    from pyspark.sql import DataFrame
    from pyspark.sql.streaming import StatefulProcessorHandle

__all__ = ["SCHEMA", "follow"]

SCHEMA = (
    "kind string, asset string, day string, time_us long, theta array<double>, statistic double, threshold double, "
    "level double, late long, result string"
)
ROCKSDB = "org.apache.spark.sql.execution.streaming.state.RocksDBStateStoreProvider"
FAR_PAST = -(2**62)
CHUNK = 65_536  # rows of one entry of the state, about


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
    """Follow and diagnose a stream of rows; on rows that are on time, bit for bit what the local engine finds.

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
        Where the signals stand; None: where the baseline's loop says.
    delay_s
        How long rows may be late [s].
    by
        Column whose value names the baseline.
    window_s
        Seconds of raw rows that a diagnosis sees.

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
    known = Baselines.of(baselines, assets, window_s)
    mapping = columns if columns is not None else known.any().loop.columns
    time, *signals = names_of(mapping, frame.columns, "the stream")
    if time in signals:
        raise RecordingError(f"the stream: column {time!r} cannot be time and signal")
    kind = frame.schema[time].dataType.typeName()
    stamp = frame[time].cast("timestamp")
    if not kind.startswith("timestamp"):
        micros = F.rint(frame[time] * UNITS[mapping.time_unit] * 1e6).cast("long")
        stamp = F.timestamp_micros(micros)
    named = [frame[name] for name in signals]
    keyed = frame.select(
        frame["asset"].cast("string"), frame[by].cast("string").alias("baseline_of"), stamp.alias("_at"), *named
    )
    marked = keyed.where("_at is not null").withWatermark("_at", f"{round(delay_s * 1e3)} milliseconds")
    # without the column that bears the watermark Spark drops no late row unseen: they are counted here, by asset
    rows = marked.select("asset", "baseline_of", F.unix_micros("_at").alias("at_us"), *signals)
    processor = _processor(known, mapping)
    return rows.groupBy("asset").transformWithStateInPandas(processor, SCHEMA, "append", "eventtime")


@dataclass
class Head:
    """What is kept of an asset beside its raw rows: a line of numbers and the state of the day that is open.

    Parameters
    ----------
    by
        Name of its baseline.
    until_us
        All rows up to here have been followed [us].
    number
        Of the next block of raw rows.
    blocks
        Number -> smallest and largest time [us] of the blocks that are kept.
    day
        The day that is open; None: none is.
    error
        Why the open day cannot be followed; empty: it can.
    """

    by: str = ""
    until_us: int = FAR_PAST
    number: int = 0
    blocks: dict[int, tuple[int, int]] = field(default_factory=dict)
    day: int | None = None
    error: str = ""
    state: State | None = None

    def pack(self) -> bytes:
        """Return it as bytes."""
        numbers = {key: value for key, value in vars(self).items() if key != "state"}
        return json.dumps(numbers).encode() + b"\n" + (self.state.pack() if self.state is not None else b"")

    @classmethod
    def unpack(cls, content: bytes) -> Head:
        """Return what `pack` packed."""
        line, _, state = content.partition(b"\n")
        numbers = json.loads(line)
        numbers["blocks"] = {int(number): tuple(span) for number, span in numbers["blocks"].items()}
        return cls(**numbers, state=State.unpack(state) if state else None)

    @property
    def pending_us(self) -> int | None:
        """The first row that waits for the watermark, or a time before it [us]; None: none does."""
        return min(
            (max(low, self.until_us + 1) for low, high in self.blocks.values() if high > self.until_us), default=None
        )


def _processor(known: Baselines, columns: Columns) -> Any:
    """Return the stateful processor; its class needs PySpark, which is imported late."""
    from pyspark.sql.streaming import StatefulProcessor

    class Processor(StatefulProcessor):  # type: ignore[misc]  # PySpark is typed where it is installed
        def init(self, handle: StatefulProcessorHandle) -> None:
            self.handle = handle
            self.head = handle.getValueState("head", "content binary")
            self.blocks = handle.getMapState("blocks", "number long", "content binary")

        def handleInputRows(self, key: Any, rows: Iterator[Any], timerValues: Any) -> Iterator[Any]:
            asset = _Asset(key[0], self, known, columns)
            late: dict[int, int] = {}
            for frame in _chunks(rows):
                for day, count in asset.put_away(frame):
                    late[day] = late.get(day, 0) + count
            asset.wait()
            for day, count in sorted(late.items()):
                yield _output(asset.name, kind=["late"], day=[day_name(day)], late=[count])

        def handleExpiredTimer(self, key: Any, timerValues: Any, expiredTimerInfo: Any) -> Iterator[Any]:
            asset = _Asset(key[0], self, known, columns)
            yield from asset.follow(timerValues.getCurrentWatermarkInMs() * 1000)
            asset.wait()

        def close(self) -> None:
            pass

    return Processor()


class _Asset:
    """One asset in the hands of a worker."""

    def __init__(self, name: str, store: Any, known: Baselines, columns: Columns) -> None:
        self.name, self.store, self.known, self.columns = name, store, known, columns
        found = store.head.get()
        self.head = Head.unpack(bytes(found[0])) if found is not None else Head()
        self._read: dict[int, Rows] = {}

    def put_away(self, frame: Any) -> Iterator[tuple[int, int]]:
        """Keep rows that are on time; yield how many are late, by day."""
        import pyarrow as pa

        t_us = frame["at_us"].to_numpy().astype(np.int64)
        self.head.by = str(frame["baseline_of"].iloc[-1])
        names = [name for name in frame.columns if name not in ("asset", "baseline_of", "at_us")]
        table = Table(self.name, {name: pa.chunked_array([pa.Array.from_pandas(frame[name])]) for name in names})
        rows = Rows(t_us, *signals_of(table, self.columns))
        late = t_us <= self.head.until_us
        for day, count in zip(*np.unique(t_us[late] // DAY_US, return_counts=True), strict=True):
            yield int(day), int(count)
        rows = rows[~late]
        if len(rows):
            self.store.blocks.updateValue((self.head.number,), (rows.pack(),))
            self.head.blocks[self.head.number] = (int(rows.t_us.min()), int(rows.t_us.max()))
            self.head.number += 1

    def wait(self) -> None:
        """Set the timer: for the first row that waits, or the end of the day that is open; put the head away."""
        times = [] if self.head.pending_us is None else [self.head.pending_us]
        times += [] if self.head.day is None else [(self.head.day + 1) * DAY_US]
        if times:
            self.store.handle.registerTimer(min(times) // 1000 + 1)
        self.store.head.update((self.head.pack(),))

    def follow(self, until_us: int) -> Iterator[Any]:
        """Follow all rows up to a time, close the days that are over by then; yield what is found."""
        head = self.head
        if until_us <= head.until_us:
            return
        pending = self._rows(head.until_us, until_us)
        head.until_us = until_us
        for day in np.unique(pending.t_us // DAY_US):
            if head.day is not None and head.day != int(day):
                yield self._closed()
            head.day = int(day)
            part = pending[pending.t_us // DAY_US == day]
            found = self._advance(part)
            if found is not None and len(found.t_us):
                yield _traced(self.name, day_name(int(day)), found)
        if head.day is not None and until_us >= (head.day + 1) * DAY_US:
            yield self._closed()
        keep = until_us
        if head.state is not None and head.day is not None and not head.error:
            keep = min(keep, self.known.follower(head.by).needed(head.state))
        for number in [number for number, (_, high) in head.blocks.items() if high <= keep]:
            self.store.blocks.removeKey((number,))
            del head.blocks[number]

    def _advance(self, rows: Rows) -> Evaluated | None:
        head = self.head
        if head.error:
            return None
        try:
            follower = self.known.follower(head.by)
            state = head.state if head.state is not None else follower.start()
            head.state, found = follower.advance(state, rows, self._rows)
        except Exception as error:  # garbage of one asset must not end the stream
            head.error = _told(error)
            return None
        return found

    def _closed(self) -> Any:
        head = self.head
        assert head.day is not None
        try:
            if head.error or head.state is None:
                raise ServoscopeError(head.error)
            follower = self.known.follower(head.by)
            found = examined(follower, follower.finish(head.state, self._rows))
        except Exception as error:
            found = {"status": "failed", "error": _told(error)}
        day = day_name(head.day)
        head.day, head.state, head.error = None, None, ""
        text = json.dumps({"asset": self.name, "day": day, **found}, allow_nan=False)
        return _output(self.name, kind=["item"], day=[day], result=[text])

    def _rows(self, after_us: int, to_us: int) -> Rows:
        """Return the kept rows with after_us < t <= to_us, in order."""
        parts = []
        for number, (low, high) in sorted(self.head.blocks.items()):
            if high > after_us and low <= to_us:
                if number not in self._read:
                    self._read[number] = Rows.unpack(bytes(self.store.blocks.getValue((number,))[0]))
                parts.append(self._read[number].between(after_us, to_us))
        return Rows.joined(parts).sorted()


def _chunks(frames: Iterator[Any]) -> Iterator[Any]:
    """Yield the rows in larger pieces: Arrow batches may be tiny, and each piece is one entry of the state."""
    import pandas as pd

    parts: list[Any] = []
    rows = 0
    for frame in frames:
        parts.append(frame)
        rows += len(frame)
        if rows >= CHUNK:
            yield pd.concat(parts, ignore_index=True)
            parts, rows = [], 0
    if parts:
        yield pd.concat(parts, ignore_index=True)


def _traced(asset: str, day: str, found: Evaluated) -> Any:
    n = len(found.t_us)
    columns = {name: getattr(found, name) for name in ("statistic", "threshold", "level")}
    return _output(asset, kind=["trace"] * n, day=[day] * n, time_us=found.t_us, theta=list(found.theta), **columns)


def _output(asset: str, *, kind: list[str], **columns: Any) -> Any:
    """Return rows of `SCHEMA`; columns that are not named are empty."""
    import pandas as pd

    names = [column.split()[0] for column in SCHEMA.split(", ")]
    told = {"kind": kind, "asset": [asset] * len(kind), **columns}
    return pd.DataFrame({name: told.get(name, [None] * len(kind)) for name in names})


def _told(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if isinstance(error, ServoscopeError) else f"{type(error).__name__}: {text[:200]}"
