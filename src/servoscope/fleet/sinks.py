"""The two ends of a stream: sources by configuration; results, each micro-batch written once, and their report."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servoscope.core.errors import OutputError, RecordingError, ServoscopeError
from servoscope.fleet.common_cause import PRIOR, Prior
from servoscope.fleet.partition import DAY_US
from servoscope.fleet.report import write_fleet_report
from servoscope.fleet.rows import MICRO, required_columns
from servoscope.fleet.stream_blocks import SAMPLE_TIME
from servoscope.fleet.stream_shard import SCHEMA
from servoscope.fleet.summary import Fleet, summarise_fleet
from servoscope.models.loop import Columns

if TYPE_CHECKING:
    from pyspark.sql import DataFrame, SparkSession
    from pyspark.sql.streaming import StreamingQuery

    from servoscope.service.store import Row


OWNER = "fleet stream"  # in the store: whose transactions these are


def file_stream(
    session: SparkSession, folder: str, columns: Columns, options: Mapping[str, str] | None = None
) -> DataFrame:
    """Return a stream of the Parquet files that come into a folder.

    The first file decides which columns there are; ``asset=...`` in the names of folders is a column too.

    Raises RecordingError if there is no file yet, or it lacks a column.
    """
    from pyspark.errors import AnalysisException

    try:
        # names of assets such as 007 are no numbers
        session.conf.set("spark.sql.sources.partitionColumnTypeInference.enabled", "false")
        schema = session.read.parquet(folder).schema
    except AnalysisException as error:
        raise RecordingError(f"{folder}: holds no Parquet file yet ({str(error).splitlines()[0][:100]})") from None
    required_columns(columns, schema.names, folder)
    return session.readStream.schema(schema).options(**(options or {})).parquet(folder)


def kafka_stream(session: SparkSession, _: str, columns: Columns, options: Mapping[str, str]) -> DataFrame:
    """Return a stream of JSON objects from Kafka, with ``asset``, a time in seconds since 1970, and the signals.

    `session`: with Spark's package for Kafka; `columns`: each signal is one column, not a sum; `options`: of Spark's
    source, such as ``kafka.bootstrap.servers`` and ``subscribe``, and ``messages``: "true" where signals are arrays of
    a block whose first time and sample time ``dt`` stand beside them.
    """
    options = dict(options)
    in_messages = options.pop("messages", "false") == "true"
    return parse_json(session.readStream.format("kafka").options(**options).load(), columns, in_messages=in_messages)


def parse_json(raw: DataFrame, columns: Columns, *, in_messages: bool) -> DataFrame:
    """Return the JSON objects of the column ``value`` as rows of one sample, or as messages with arrays of signals."""
    from pyspark.sql import functions as F

    single = [columns.time or "t", *([SAMPLE_TIME] if in_messages else [])]
    types = dict.fromkeys(single, "double")
    kind = "array<double>" if in_messages else "double"
    types |= dict.fromkeys([columns.reference, columns.input, *columns.outputs], kind)
    schema = ", ".join(["asset string", *(f"`{name.strip('`')}` {of}" for name, of in types.items())])
    return raw.select(F.from_json(raw["value"].cast("string"), schema).alias("row")).select("row.*")


def start(
    followed: DataFrame,
    output: str | Path,
    *,
    checkpoint: str | Path | None = None,
    every_s: float | None = 60.0,
    store: str | None = None,
) -> StreamingQuery:
    """Start a stream whose results are Parquet, each micro-batch in a folder of its own, `read_results` / batch=N.

    A batch that is repeated after a crash replaces its folder with the same content: nothing is lost or doubled.

    Parameters
    ----------
    followed
        What `follow` returned.
    output
        Folder or URL for results.
    checkpoint
        Folder or URL for checkpoints; None: beside the results.
    every_s
        Seconds between micro-batches; None: the stream ends when all present rows are processed.
    store
        A SQLite file or URL of PostgreSQL that diagnoses are also written to, one per asset and day, each micro-batch
        once and in one transaction.

    Raises
    ------
    OutputError
        If the checkpoint belongs to another version of servoscope, or to another number of shards.
    StoreError
        If the store cannot be used.
    """
    folder = str(checkpoint or f"{output}/checkpoint")
    claim_checkpoint(followed.sparkSession, folder, followed.schema["kind"].metadata)
    if store is not None:
        from servoscope.service.store import Batch, Store  # late: it needs an extra of its own

        history = Store.open(store, write=True)

    def write(batch: DataFrame, number: int) -> None:
        results = f"{output}/results/batch={number:09d}"
        batch.write.mode("overwrite").option("parquet.enable.dictionary", "false").partitionBy("kind").parquet(results)
        if store is not None and history.last_commit(OWNER) <= number:
            items = batch.sparkSession.read.schema(SCHEMA).parquet(results).where("kind = 'item'").select("result")
            rows: list[Row] = [_diagnosis_row(json.loads(row.result)) for row in items.collect()]
            history.write(Batch(rows={"diagnoses": rows}), OWNER, number + 1)

    writer = followed.writeStream.foreachBatch(write).outputMode("append")
    writer = writer.option("checkpointLocation", folder)
    trigger: dict[str, Any] = {"availableNow": True} if every_s is None else {"processingTime": f"{every_s:g} seconds"}
    return writer.trigger(**trigger).start()


def claim_checkpoint(session: SparkSession, folder: str, layout: Mapping[str, int]) -> None:
    """Write into a new checkpoint how its state is laid out, or compare with what is written there.

    Spark would go on with whatever it finds: assets that another number of shards puts elsewhere would begin anew.

    Raises OutputError if it is laid out otherwise.
    """
    from pyspark.errors import AnalysisException
    from pyspark.sql import functions as F

    def lines(path: str) -> list[str]:
        try:
            return [row.value for row in session.read.text(path).collect()]
        except AnalysisException:  # there is none
            return []

    begun, otherwise = lines(f"{folder}/servoscope"), "begin in another folder after a day is over"
    if not begun and not lines(f"{folder}/offsets"):
        text = F.lit(json.dumps(dict(layout))).alias("value")
        session.range(1).select(text).write.mode("overwrite").text(f"{folder}/servoscope")
        return
    known = json.loads(begun[0]) if begun else {}
    if known.get("layout") != layout["layout"]:
        raise OutputError(f"{folder}: this checkpoint is of another version: go on with that one, or {otherwise}")
    if known != layout:
        raise OutputError(
            f"{folder}: this checkpoint has {known['shards']} shards, the stream {layout['shards']}: take as many, "
            f"or {otherwise}"
        )


def _diagnosis_row(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return an item as a row of the store's diagnoses, numbered by its day."""
    diagnosis = entry.get("diagnosis", {})
    onset = diagnosis.get("onset_s")
    begin = (entry.get("first_us") or 0) / MICRO
    day = int(np.datetime64(entry["day"], "D").astype(int))
    return {
        "asset": entry["asset"],
        "number": day,
        "t": (entry.get("last_us") or day * DAY_US) / MICRO,
        "grounds": "full",
        "verdict": diagnosis.get("verdict", "undetermined"),
        "summary": diagnosis.get("summary") or str(entry["error"]),
        "onset": begin + onset[1] if onset else None,
        "document": dict(entry),
    }


def read_results(session: SparkSession, output: str | Path) -> DataFrame:
    """Return all results that a stream has written."""
    return (
        session.read.schema(f"{SCHEMA}, batch long")
        .option("basePath", f"{output}/results")
        .parquet(f"{output}/results/batch=*")
    )


def wait_for_stream(query: StreamingQuery) -> None:
    """Wait for the end of a stream, or an interrupt.

    Raises ServoscopeError if it failed.
    """
    from pyspark.errors import StreamingQueryException

    try:
        query.awaitTermination()
    except KeyboardInterrupt:
        query.stop()
    except StreamingQueryException as error:
        raise ServoscopeError(f"the stream stopped: {' '.join(str(error).split())[:300]}") from None


def write_stream_report(
    session: SparkSession,
    output: Path,
    groups: Mapping[str, Mapping[str, str]],
    lake: str,
    prior: Prior = PRIOR,
) -> Fleet:
    """Write fleet.json and report.html from the results of a stream, and return the fleet.

    Raises OutputError if they cannot be written.
    """
    results = read_results(session, output)
    entries = [json.loads(row.result) for row in results.where("kind = 'item'").select("result").collect()]
    counts = results.where("kind = 'late'").groupBy("asset").sum("late").collect()
    late = {asset: int(count) for asset, count in counts}
    fleet = summarise_fleet(sorted(entries, key=lambda entry: (entry["asset"], entry["day"])), groups, {}, prior, late)
    write_fleet_report(output, fleet, lake)
    return fleet
