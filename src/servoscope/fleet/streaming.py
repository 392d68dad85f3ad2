"""The fleet as a stream of Spark: rows wait in the state for the watermark, then are sorted and followed.

Before they are shuffled, each Arrow batch becomes one block of bytes per shard of the assets: what Spark does to a row
costs more than all that follows.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoscope.baseline.baseline import Baseline
from servoscope.core.errors import LoopError, RecordingError
from servoscope.fleet.baselines import Baselines
from servoscope.fleet.day_monitor import WINDOW
from servoscope.fleet.rows import MICRO, required_columns
from servoscope.fleet.stream_blocks import BLOCKS, SAMPLE_TIME, AssetRows, check_lists, pack_blocks
from servoscope.fleet.stream_shard import SCHEMA, StreamShard
from servoscope.models.loop import Columns

if TYPE_CHECKING:
    from pyspark.sql import DataFrame, SparkSession
    from pyspark.sql.streaming import StatefulProcessorHandle


ROCKSDB = "org.apache.spark.sql.execution.streaming.state.RocksDBStateStoreProvider"
PARTITIONS = "spark.sql.shuffle.partitions"
DEFAULT_PARTITIONS = "200"  # Spark's own: of a small stream, most would be empty, and each costs a task per batch
PARTITIONS_PER_CORE = 3
SHARDS = 64
LAYOUT = 2  # of keys and states in a checkpoint: raised when one of them changes its meaning


def follow(
    frame: DataFrame,
    baselines: Baseline | Mapping[str, Baseline] | str | Path,
    *,
    assets: int,
    columns: Columns | None = None,
    delay_s: float = 10.0,
    by: str = "asset",
    window_s: float = WINDOW,
    shards: int = SHARDS,
) -> DataFrame:
    """Follow and diagnose a stream; for rows that are on time, bit for bit as the local engine.

    A row of the DataFrame is one sample, or a message: a block of samples of one asset, whose columns hold arrays. The
    time of a message is an array too, or that of its first sample, with the sample time in the column ``dt`` [s].

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
    shards
        Among how many parts of the state the assets are shared out: fixed for as long as a checkpoint lives, and at
        least the number of partitions.

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
    from pyspark.sql.types import StructType

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
    names = list(dict.fromkeys([time, *signals, *({SAMPLE_TIME} & set(frame.columns))]))
    lists = [name for name in names if frame.schema[name].dataType.typeName() == "array"]
    check_lists(lists, names, time)
    asset, baseline = frame["asset"].cast("string").alias("asset"), frame[by].cast("string").alias("baseline_of")
    used = names if lists else [time, *signals]
    keyed = frame.select(asset, baseline, *(frame[name] for name in used)).where("asset is not null")
    blocks = keyed.mapInArrow(lambda batches: pack_blocks(batches, time, mapping, shards), BLOCKS)
    last = F.timestamp_micros("last_us").alias("_at")
    marked = blocks.select("*", last).withWatermark("_at", f"{round(delay_s * 1e3)} milliseconds")
    # without the column that bears the watermark Spark drops no late row unseen: they are counted here, by asset
    rows = marked.select("shard", "rows")
    schema = StructType.fromDDL(SCHEMA)
    schema["kind"].metadata = {"layout": LAYOUT, "shards": shards}  # for `sinks.start`, which knows the checkpoint
    processor = _create_processor(known, round(delay_s * MICRO))
    return rows.groupBy("shard").transformWithStateInPandas(processor, schema, "append", "eventtime")


def _set_partitions(session: SparkSession, assets: int) -> None:
    """Take as many partitions as assets and cores have use for, unless somebody has chosen a number."""
    context = session.sparkContext
    if session.conf.get(PARTITIONS) == DEFAULT_PARTITIONS and not context.getConf().contains(PARTITIONS):
        session.conf.set(PARTITIONS, str(min(max(assets, 1), PARTITIONS_PER_CORE * context.defaultParallelism)))


def _create_processor(baselines: Baselines, delay_us: int) -> Any:
    """Return the stateful processor; its class needs PySpark, which is imported late."""
    from pyspark.sql.streaming import StatefulProcessor

    class Processor(StatefulProcessor):  # type: ignore[misc]  # PySpark is typed where it is installed
        def init(self, handle: StatefulProcessorHandle) -> None:
            self.handle = handle
            self.head = handle.getValueState("head", "content string")
            self.entries = handle.getMapState("entries", "number long", "content string")

        def shard(self) -> StreamShard:
            return StreamShard(self.head, self.entries, self.handle, baselines, delay_us)

        def handleInputRows(self, key: Any, rows: Iterator[Any], timerValues: Any) -> Iterator[Any]:
            shard = self.shard()
            yield from shard.store_rows(AssetRows.unpack(bytes(packed)) for frame in rows for packed in frame["rows"])
            shard.save()

        def handleExpiredTimer(self, key: Any, timerValues: Any, expiredTimerInfo: Any) -> Iterator[Any]:
            shard = self.shard()
            yield from shard.process_until(timerValues.getCurrentWatermarkInMs() * 1000)
            shard.save()

        def close(self) -> None:
            pass

    return Processor()
