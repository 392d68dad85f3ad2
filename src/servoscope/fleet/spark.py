"""The fleet on Spark: tasks on executors that read the lake themselves, and DataFrames of rows, keyed by asset."""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoscope.baseline.baseline import Baseline
from servoscope.core.errors import ServoscopeError
from servoscope.fleet.baselines import Baselines
from servoscope.fleet.day_monitor import WINDOW
from servoscope.fleet.partition import examine_days
from servoscope.fleet.rows import required_columns
from servoscope.fleet.tasks import RESULT_COLUMNS, Engine, Task, TaskResult, crash_result, result_table
from servoscope.models.loop import Columns

if TYPE_CHECKING:
    from pyspark.sql import DataFrame, SparkSession


WAVE = 8  # tasks per core that are handed out at once; their results are on disk before the next ones begin


def session(master: str | None = None, **settings: str) -> SparkSession:
    """Return the running session, or start one.

    Parameters
    ----------
    master
        Such as ``local[2]`` or ``spark://host:7077``; None: that of the environment.
    settings
        Spark's own, with ``__`` for dots.

    Raises
    ------
    ServoscopeError
        If PySpark is not installed, or there is no Java.
    """
    os.environ.setdefault("PYSPARK_PYTHON", sys.executable)  # or workers run another Python than this
    try:
        from pyspark.errors import PySparkException
        from pyspark.sql import SparkSession
    except ImportError:
        raise ServoscopeError("Spark needs the extra: pip install 'servoscope[spark]', and Java 17") from None
    builder = SparkSession.builder.appName("servoscope")
    if master is not None:
        builder = builder.master(master)
    # times of day are UTC everywhere; one thread of linear algebra per worker, as on one machine
    fixed = {"spark__sql__session__timeZone": "UTC", "spark__executorEnv__OPENBLAS_NUM_THREADS": "1"}
    # of glibc: blocks of rows are freed and wanted again all the time, and new memory has to be cleared first
    fixed |= {f"spark__executorEnv__MALLOC_{name}_THRESHOLD_": str(1 << 25) for name in ("MMAP", "TRIM")}
    # what PySpark thinks of the pandas beside it is nothing that its user can change
    warnings.filterwarnings("ignore", "PySpark does not yet fully support pandas", FutureWarning)
    fixed |= {"spark__executorEnv__PYTHONWARNINGS": "ignore::FutureWarning", "spark__ui__showConsoleProgress": "false"}
    for key, value in (fixed | settings).items():
        builder = builder.config(key.replace("__", "."), value)
    if "SPARK_CONF_DIR" not in os.environ:  # else its log4j2.properties says what Spark writes to the terminal
        log = Path(__file__).parent / "templates" / "log4j2.properties"
        os.environ.setdefault("SPARK_SUBMIT_OPTS", f"-Dlog4j2.configurationFile={log.as_uri()}")
    try:
        return builder.getOrCreate()
    except (PySparkException, FileNotFoundError) as error:
        raise ServoscopeError(
            f"Spark does not start, is there a Java 17? ({' '.join(str(error).split())[:120]})"
        ) from None


def spark(session: SparkSession) -> Engine:
    """Return the engine whose tasks run on a cluster; each is one task of Spark, which tries it again elsewhere.

    The lake and the output folder must be where all executors see them; rows do not pass through Spark.
    """

    def run(tasks: Sequence[Task]) -> Iterator[TaskResult]:
        step = max(1, WAVE * session.sparkContext.defaultParallelism)
        for i in range(0, len(tasks), step):
            yield from zip(tasks[i : i + step], _run_wave(session, tasks[i : i + step]), strict=True)

    return run


def _run_wave(session: SparkSession, wave: Sequence[Task]) -> Iterator[dict[str, Any]]:
    try:
        yield from _run_tasks(session, wave)
    except Exception as error:
        if "stage failure" not in str(error):  # Spark itself failed, and not a task as often as it may
            raise
        if len(wave) == 1:
            yield crash_result(wave[0])
            return
        for task in wave:  # one of them kills its executor: alone, it takes no other with it
            yield from _run_wave(session, [task])


def _run_tasks(session: SparkSession, wave: Sequence[Task]) -> list[dict[str, Any]]:
    import pyarrow as pa

    def work(batches: Iterator[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
        for batch in batches:
            for i in batch.column(0).to_pylist():
                yield pa.RecordBatch.from_pydict({"i": [i], "result": [json.dumps(wave[i].run())]})

    done = session.range(0, len(wave), 1, len(wave)).mapInArrow(work, "i long, result string").collect()
    return [json.loads(task.result) for task in sorted(done, key=lambda task: task.i)]


def diagnose(
    frame: DataFrame,
    baselines: Baseline | Mapping[str, Baseline] | str | Path,
    *,
    columns: Columns | None = None,
    by: str = "asset",
    assets: int | None = None,
    window_s: float = WINDOW,
) -> DataFrame:
    """Follow and diagnose every asset's day in a DataFrame of rows, bit for bit as the local engine.

    Rows are shuffled by asset, sorted by time, and pass through the workers in Arrow batches of any size, with a window
    of them in memory.

    Parameters
    ----------
    frame
        With the columns ``asset``, those of the signals, and, if wanted, ``day``; without it a day is that of UTC.
    baselines
        One for all, one by asset, or a folder with NAME.json that all workers see.
    columns
        Where the signals are; None: where the baseline's loop says.
    by
        Column whose value names the baseline.
    assets
        How many assets share the budget of false alarms; None: as many as there are in the frame.
    window_s
        Seconds of raw rows that a diagnosis covers.

    Returns
    -------
    pyspark.sql.DataFrame
        One row per asset and day: the columns of diagnoses.parquet, with ``result`` as JSON.

    Raises
    ------
    RecordingError, LoopError
        If a column is missing.
    BaselineError
        If there is no baseline.
    """
    import pyarrow as pa

    count = assets if assets is not None else frame.select("asset").distinct().count()
    known = Baselines.from_source(baselines, max(count, 1), window_s)
    mapping = columns if columns is not None else known.first().loop.columns
    signals = required_columns(mapping, frame.columns, "the DataFrame")
    keys = list(dict.fromkeys(["asset", by, *(["day"] if "day" in frame.columns else [])]))
    rows = frame.select(*(frame[key].cast("string") for key in keys), *(name for name in signals if name not in keys))
    rows = rows.where(rows[signals[0]].isNotNull())
    order = [*keys, signals[0]]

    def work(batches: Iterator[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
        for entry in examine_days(batches, keys, by, mapping, known.day_monitor):
            yield result_table([entry])

    sorted_rows = rows.repartition("asset").sortWithinPartitions(*order)
    return sorted_rows.mapInArrow(work, ", ".join(f"{name} {kind}" for name, kind in RESULT_COLUMNS.items()))
