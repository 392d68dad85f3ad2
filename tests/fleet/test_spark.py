"""Spark carries the fleet: the same results as on one machine, by DataFrame, task and stream, and after crashes.

One session for all, with one core and little memory, bound to this machine.
"""

from __future__ import annotations

import datetime
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lakes
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import sqlalchemy as sa

from servoscope import fleet
from servoscope.core.errors import ServoscopeError
from servoscope.fleet import Plan, sinks, streaming
from servoscope.fleet import spark as engines
from servoscope.fleet.baselines import Baselines
from servoscope.fleet.lake import Lake
from servoscope.fleet.tasks import ExamineTask, local
from servoscope.service.store import Store
from servoscope.service.store.tables import diagnoses

pytestmark = pytest.mark.slow

SOURCES = str(Path(fleet.__file__).parents[2])
MASTER = "local[1,2]"  # one core; a task may fail once
SMALL = {
    "spark.driver.memory": "1g",
    "spark.driver.bindAddress": "127.0.0.1",
    "spark.driver.host": "127.0.0.1",
    "spark.driver.extraJavaOptions": "-XX:TieredStopAtLevel=1 -XX:+UseSerialGC",  # starts sooner
    "spark.ui.enabled": "false",
    "spark.ui.showConsoleProgress": "false",
    "spark.log.level": "OFF",
    "spark.sql.shuffle.partitions": "2",
    "spark.sql.adaptive.enabled": "false",
    "spark.sql.codegen.wholeStage": "false",
    "spark.sql.codegen.factoryMode": "NO_CODEGEN",
}
BATCH = ("spark.sql.execution.arrow.maxRecordsPerBatch",)
BATCH += ("spark.sql.execution.arrow.transformWithStateInPandas.maxRecordsPerBatch",)


@pytest.fixture(scope="module")
def session() -> Iterator[Any]:
    pytest.importorskip("pyspark", reason="PySpark is not installed: pip install 'servoscope[spark]'")
    if shutil.which("java") is None:
        pytest.skip("there is no Java: scripts/install-test-servers installs it")
    os.environ["PYTHONPATH"] = os.pathsep.join(
        [
            SOURCES,
            str(Path(__file__).parent),
            str(Path(__file__).parents[1] / "support"),
            os.environ.get("PYTHONPATH", ""),
        ]
    )
    found = engines.session(MASTER, **{key.replace(".", "__"): value for key, value in SMALL.items()})
    yield found
    found.stop()


@pytest.fixture(scope="module")
def lake(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return lakes.make(tmp_path_factory.mktemp("lake"), 12.0)


@pytest.fixture(scope="module")
def plan(lake: Path, tmp_path_factory: pytest.TempPathFactory) -> Plan:
    plan = Plan(Lake.open(str(lake)), tmp_path_factory.mktemp("local"), lakes.loop(), by="supply")
    fleet.run(plan, local(1))
    return plan


def journal(output: Path) -> dict[tuple[str, str], dict[str, Any]]:
    lines = (output / "journal.jsonl").read_text().splitlines()[1:]
    return {(entry["asset"], entry["day"]): entry for entry in map(json.loads, lines)}


def without_files(
    entries: dict[tuple[str, str], dict[str, Any]], *assets: str
) -> dict[tuple[str, str], dict[str, Any]]:
    """Return entries of some assets as engines know them that do not read files themselves."""
    told = {key: dict(entry) for key, entry in entries.items() if key[0] in assets}
    for entry in told.values():
        del entry["stamp"]
    return told


def set_batches(session: Any, rows: int) -> None:
    for key in BATCH:
        session.conf.set(key, str(rows))


class Fragile(ExamineTask):
    """An item that takes its worker with it: P1 always, P2 once, as a lost executor does."""

    def run(self) -> dict[str, Any]:
        marker = Path(self.baseline_error)
        if self.item.asset == lakes.ILL or (self.item.asset == lakes.CORRUPT and not marker.exists()):
            marker.touch()
            os._exit(1)
        return {"asset": self.item.asset, "day": self.item.day, "stamp": "", "status": "examined", "error": None}


def test_tasks_on_executors_find_what_one_machine_finds(session: Any, plan: Plan, tmp_path: Path) -> None:
    shutil.copytree(plan.output / "baselines", tmp_path / "baselines")
    known = fleet.run(Plan(plan.lake, tmp_path, plan.loop, by="supply"), engines.spark(session))
    assert journal(tmp_path) == journal(plan.output)
    assert {asset for asset, *_ in known.failed} == {lakes.CORRUPT, lakes.GARBAGE}
    for trace in plan.output.glob("traces/*/*/trace.parquet"):
        assert (tmp_path / trace.relative_to(plan.output)).read_bytes() == trace.read_bytes()


def test_a_lost_executor_costs_a_second_try_and_one_that_is_always_lost_costs_itself(
    session: Any, plan: Plan, tmp_path: Path
) -> None:
    items = [item for item in plan.lake.items if item.day == lakes.DAYS[1]][:3]
    tasks = [Fragile(item, None, str(tmp_path / item.asset), 1, None, 1.0, None) for item in items]
    found = {task.key[0]: result["status"] for task, result in engines.spark(session)(tasks)}
    assert found == {"P0": "examined", lakes.ILL: "failed", lakes.CORRUPT: "examined"}


@pytest.mark.parametrize("batch", [7, 10_000])
def test_a_data_frame_keyed_by_asset_finds_what_one_machine_finds(session: Any, plan: Plan, batch: int) -> None:
    set_batches(session, batch)
    some = [
        str(path)
        for asset in ("P0", "P1", "P3")
        for path in Path(plan.lake.location).rglob(f"asset={asset}/*/*.parquet")
    ]
    rows = session.read.option("basePath", plan.lake.location).parquet(*some).drop("day").repartition(3)
    found = engines.diagnose(rows, plan.output / "baselines", by="supply", assets=4).collect()
    entries = {(row.asset, row.day): json.loads(row.result) for row in found}
    assert entries == without_files(journal(plan.output), "P0", "P1", "P3")


def put(folder: Path, name: str, asset: str, table: pa.Table, number: int) -> None:
    """Let a file come into a stream's folder."""
    supply = "A" if asset in ("P0", "P1") else "B"
    path = folder / f"supply={supply}" / f"asset={asset}" / f"{name}.parquet"
    lakes.write(path, table)
    os.utime(path, (1e9 + number, 1e9 + number))


def messages_of(table: pa.Table, size: int) -> pa.Table:
    """Return rows as messages of some samples each."""
    offsets = pa.array([*range(0, table.num_rows, size), table.num_rows], pa.int32())
    return pa.table(
        {name: pa.ListArray.from_arrays(offsets, table[name].combine_chunks()) for name in table.column_names}
    )


def day_of(lake: Path, asset: str, day: int) -> pa.Table:
    (path,) = lake.rglob(f"asset={asset}/day={lakes.DAYS[day]}/*.parquet")
    return pq.read_table(path, partitioning=None)


def the_next_day(folder: Path, *, in_messages: bool = False) -> None:
    """Let one row come that ends all days before."""
    at = pa.array([datetime.datetime(2026, 11, 3, 0, 1)], pa.timestamp("us"))
    row = pa.table({"t": at, "r": [0.0], "u": [0.0], "y": [0.0]})
    put(folder, "next", "P0", messages_of(row, 1) if in_messages else row, 99)


def followed(session: Any, plan: Plan, folder: Path, output: Path, store: str | None = None) -> None:
    frame = sinks.file_stream(session, str(folder), lakes.loop().columns)
    stream = streaming.follow(frame, plan.output / "baselines", assets=4, by="supply")
    for left in (2, 1, 0):
        try:
            return sinks.wait_for_stream(sinks.start(stream, output, every_s=None, store=store))
        except ServoscopeError as error:
            # Spark gives a new Python ten seconds to start; on a busy machine that may take another try
            if "failed to connect back" not in str(error) or not left:
                raise


def test_a_checkpoint_is_continued_as_it_was_laid_out_or_not_at_all(session: Any, tmp_path: Path) -> None:
    from servoscope.core.errors import OutputError

    layout = {"layout": streaming.LAYOUT, "shards": 64}
    for _ in range(2):
        sinks.claim_checkpoint(session, str(tmp_path / "new"), layout)
    for changed, text in (({"shards": 32}, "has 64 shards, the stream 32"), ({"layout": 0}, "of another version")):
        with pytest.raises(OutputError, match=text):
            sinks.claim_checkpoint(session, str(tmp_path / "new"), layout | changed)
    (tmp_path / "old" / "offsets").mkdir(parents=True)
    (tmp_path / "old" / "offsets" / "0").write_text("v1\n{}\n")
    with pytest.raises(OutputError, match="of another version"):
        sinks.claim_checkpoint(session, str(tmp_path / "old"), layout)


def items_of(session: Any, output: Path) -> dict[tuple[str, str], dict[str, Any]]:
    rows = sinks.read_results(session, output).where("kind = 'item'").select("result").collect()
    entries = [json.loads(row.result) for row in rows]
    assert len(entries) == len({(entry["asset"], entry["day"]) for entry in entries})  # none twice
    return {(entry["asset"], entry["day"]): entry for entry in entries}


@pytest.mark.parametrize("in_messages", [False, True], ids=["rows", "messages"])
def test_a_stream_finds_what_one_machine_finds_and_writes_the_same_traces(
    session: Any, plan: Plan, tmp_path: Path, in_messages: bool
) -> None:
    set_batches(session, 10_000)
    for day in (0, 1):
        for asset in ("P0", "P1", "P3"):
            table = day_of(Path(plan.lake.location), asset, day)
            put(tmp_path / "in", str(day), asset, messages_of(table, 64) if in_messages else table, day)
    the_next_day(tmp_path / "in", in_messages=in_messages)
    store = str(tmp_path / "history.db")
    followed(session, plan, tmp_path / "in", tmp_path / "out", store)
    wanted = without_files(journal(plan.output), "P0", "P1", "P3")
    assert items_of(session, tmp_path / "out") == wanted
    stored = {
        (row["asset"], row["document"]["day"]): row["document"] for row in Store.open(store).fetch(sa.select(diagnoses))
    }
    assert stored == wanted
    rows = (
        sinks.read_results(session, tmp_path / "out")
        .where("kind = 'trace' and asset = 'P1'")
        .orderBy("time_us")
        .collect()
    )
    whole = [pq.read_table(path, partitioning=None) for path in sorted(plan.output.glob("traces/asset=P1/*/*.parquet"))]
    trace = pa.concat_tables(whole)
    for name in ("time_us", "statistic", "threshold", "level"):
        assert [row[name] for row in rows] == trace.column(name).to_pylist(), name
    assert [row.theta[2] for row in rows] == trace.column("theta_2").to_pylist()


def test_json_objects_are_rows_or_messages(session: Any) -> None:
    given = {"asset": "P0", "t": 1.5, "dt": 0.01, "r": [0.0, 1.0], "u": [2.0, 3.0], "y": [4.0, 5.0]}
    for known in (given, {"asset": "P1", "t": 1.5, "r": 0.0, "u": 2.0, "y": 4.0}):
        raw = session.createDataFrame([(json.dumps(known),)], "value string")
        (row,) = sinks.parse_json(raw, lakes.loop().columns, in_messages="dt" in known).collect()
        assert row.asDict() == known


def test_tiny_batches_of_one_row_in_any_order_change_nothing(session: Any, plan: Plan, tmp_path: Path) -> None:
    set_batches(session, 1)
    day = day_of(Path(plan.lake.location), "P0", 0).slice(0, 240)
    mixed = day.take(np.random.default_rng(3).permutation(day.num_rows))
    for i in range(2):
        put(tmp_path / "in", str(i), "P0", mixed.slice(120 * i, 120), 0)
    the_next_day(tmp_path / "in")
    followed(session, plan, tmp_path / "in", tmp_path / "out")
    lakes.write(tmp_path / "lake" / "asset=P0" / f"day={lakes.DAYS[0]}" / "a.parquet", day)
    alone = ExamineTask(
        Lake.open(str(tmp_path / "lake")).items[0], str(plan.output / "baselines" / "A.json"), "", 4, None, 120.0, None
    )
    wanted = {key: value for key, value in alone.run().items() if key != "stamp"}
    assert wanted["status"] == "examined"
    assert items_of(session, tmp_path / "out") == {("P0", lakes.DAYS[0]): wanted}


def test_a_killed_driver_goes_on_from_its_checkpoint_and_late_rows_are_counted(
    session: Any, plan: Plan, tmp_path: Path
) -> None:
    first = {asset: day_of(Path(plan.lake.location), asset, 0) for asset in ("P0", "P1")}
    for i, (asset, begin, end) in enumerate((("P0", 0, 700), ("P1", 0, 700), ("P0", 700, 1200), ("P1", 700, 1200))):
        put(tmp_path / "in", f"0-{i}", asset, first[asset].slice(begin, end - begin), i)
    words = [
        "fleet",
        str(tmp_path / "in"),
        "-o",
        str(tmp_path / "out"),
        "--stream",
        "--master",
        MASTER,
        "--assets",
        "4",
    ]
    words += [
        "--baselines",
        str(plan.output / "baselines"),
        "--baseline-by",
        "supply",
        "--source",
        "maxFilesPerTrigger=1",
    ]
    settings = SMALL | {key: "7" for key in BATCH}
    submit = " ".join(f"--conf '{key}={value}'" for key, value in settings.items()) + " pyspark-shell"
    for _ in range(3):  # as above: a busy machine may need another try
        driver = subprocess.Popen(
            [sys.executable, "-m", "servoscope", *words],
            env={**os.environ, "PYSPARK_SUBMIT_ARGS": submit},
            start_new_session=True,
            stderr=subprocess.DEVNULL,
        )
        half_way = tmp_path / "out" / "results" / "batch=000000001" / "_SUCCESS"
        while driver.poll() is None and not half_way.exists():
            time.sleep(0.02)
        if driver.poll() is None:
            break
    os.killpg(driver.pid, signal.SIGKILL)
    driver.wait()
    assert half_way.exists() and not items_of(session, tmp_path / "out")

    set_batches(session, 10_000)
    session.conf.set("spark.sql.shuffle.partitions", "3")  # the checkpoint's number stays
    for asset in ("P0", "P1"):
        put(tmp_path / "in", "1", asset, day_of(Path(plan.lake.location), asset, 1), 50)
    followed(session, plan, tmp_path / "in", tmp_path / "out")
    frame = sinks.file_stream(session, str(tmp_path / "in"), lakes.loop().columns)
    with pytest.raises(ServoscopeError, match="has 64 shards, the stream 3: take as many"):
        sinks.start(streaming.follow(frame, plan.output / "baselines", assets=4, shards=3), tmp_path / "out")
    put(tmp_path / "in", "late", "P1", first["P1"].slice(100, 30), 98)
    the_next_day(tmp_path / "in")
    followed(session, plan, tmp_path / "in", tmp_path / "out")
    assert items_of(session, tmp_path / "out") == without_files(journal(plan.output), "P0", "P1")
    known = sinks.write_stream_report(session, tmp_path / "out", {}, "in")
    assert (
        known.late == {"P1": 30}
        and "30 rows came after the watermark" in (tmp_path / "out" / "report.html").read_text()
    )
    assert {one.asset: one.state for one in known.assets} == {"P0": "healthy", "P1": "fault"}


def test_baselines_travel_as_text_or_stay_in_their_folder(plan: Plan) -> None:
    from servoscope.baseline.baseline import Baseline
    from servoscope.core.errors import BaselineError

    own = Baseline.load(plan.output / "baselines" / "A.json")
    limit = own.shared(4).thresholds.statistic
    for source in (own, {"A": own}, plan.output / "baselines", plan.output / "baselines" / "A.json"):
        assert Baselines.from_source(source, 4, 60.0).day_monitor("A").baseline.thresholds.statistic == limit
    with pytest.raises(BaselineError, match="none is called B"):
        Baselines.from_source({"A": own}, 4, 60.0).day_monitor("B")
