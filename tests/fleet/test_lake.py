"""A fleet from a lake on one machine: items, blocks, one day followed, resuming, faults that stay where they are."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import halls
import lakes
import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest
from commands import one_line, run

from servoscope import fleet
from servoscope.baseline.baseline import Baseline
from servoscope.core.errors import BaselineError, OutputError, RecordingError
from servoscope.diagnosis.diagnose import diagnose
from servoscope.fleet import Plan, day_monitor, read
from servoscope.fleet.baselines import load_day_monitor
from servoscope.fleet.day_monitor import DayMonitor, DayState, RowHistory
from servoscope.fleet.lake import Lake
from servoscope.fleet.rows import Rows
from servoscope.fleet.tasks import ExamineTask, local
from servoscope.learning.learn import learn_baseline
from servoscope.models.loop import Columns
from servoscope.signals import Recording


@pytest.fixture(scope="module")
def lake(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return lakes.make(tmp_path_factory.mktemp("lake"))


@pytest.fixture(scope="module")
def done(lake: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Plan, fleet.Fleet]:
    plan = Plan(Lake.open(str(lake)), tmp_path_factory.mktemp("results"), lakes.loop(), by="supply")
    return plan, fleet.run(plan, local(1))


def test_a_day_is_followed_at_the_operating_point_of_its_folder(tmp_path: Path) -> None:
    one, path = halls.baseline().model_copy(update={"point": "cold"}), str(tmp_path / "baseline.json")
    one.model_copy(update={"others": (one.model_copy(update={"point": "warm"}),)}).save(path)
    assert load_day_monitor(path, 1, 120.0, "warm").baseline.point == "warm"
    with pytest.raises(BaselineError, match="has cold, warm: name the folders of the lake point=NAME"):
        load_day_monitor(path, 1, 120.0)
    with pytest.raises(BaselineError, match="no operating point 'hot'"):
        load_day_monitor(path, 1, 120.0, "hot")


def entries(output: Path) -> list[dict[str, Any]]:
    """Return the last result of each item; those that were examined must not stand there twice."""
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for line in (output / "journal.jsonl").read_text().splitlines()[1:]:
        entry = json.loads(line)
        assert entry["status"] == "failed" or (entry["asset"], entry["day"]) not in found
        found[entry["asset"], entry["day"]] = entry
    return [found[key] for key in sorted(found)]


def rows_of(x: Recording) -> Rows:
    return Rows(np.round(1e6 * x.t).astype(np.int64), x.r, x.u, x.y)


def followed(one: DayMonitor, rows: Rows, lengths: list[int]) -> tuple[dict[str, Any], np.ndarray[Any, Any]]:
    """Return state and statistics of a day cut into blocks, the state packed and unpacked between them."""
    state, history, statistics = one.start(), RowHistory(), []
    for i, block in enumerate(np.split(np.arange(len(rows)), np.cumsum(lengths))):
        part = rows[block]
        history.blocks.append(part)
        state, found = one.advance(DayState.unpack(state.pack()), part, history)
        statistics.append(found.statistic)
        if i % 3 == 0:
            history.drop_until(one.needed_since(state))
    state = one.finish(state, history)
    return {**vars(state), "monitor": state.monitor.tobytes()}, np.concatenate(statistics)


def test_a_day_is_the_same_however_it_is_cut_and_its_window_lies_around_the_alarm() -> None:
    healthy, ill = lakes.recorded(1, 0, 15.0), lakes.recorded(1, 1, 30.0, leak=1.5)
    one = DayMonitor(learn_baseline(lakes.loop(), [healthy]), window_s=8.0)
    rows = rows_of(ill)
    rows = Rows.concatenate([rows[:700], rows[720:1000], rows[999:]])  # a gap, and a row twice
    whole, statistics = followed(one, rows, [])
    for seed in (1, 2):
        lengths = np.random.default_rng(seed).integers(0, 300, 20).tolist()
        again, other = followed(one, rows, lengths)
        assert again == whole and np.array_equal(statistics, other)
    assert whole["gaps"] == 1 and whole["repeats"] == 1 and whole["samples"] == 2980
    said = whole["result"]["diagnosis"]
    assert 15.0 < whole["alarm_us"] * 1e-6 < 17.0 and said["duration_s"] == pytest.approx(8.0)
    assert said["faults"][0]["name"] == "leakage" and said["onset_s"][1] == pytest.approx(15.0, abs=0.1)


def test_a_day_shorter_than_the_window_is_diagnosed_as_the_recording_that_it_is() -> None:
    baseline, day = learn_baseline(lakes.loop(), [lakes.recorded(1, 0, 15.0)]), lakes.recorded(1, 1, 15.0)
    state, _ = followed(DayMonitor(baseline), rows_of(day), [])
    alone = json.loads(diagnose(baseline, day).model_dump_json(exclude={"recording"}))
    assert state["result"]["diagnosis"] == alone


def test_rows_come_in_the_order_of_time_from_files_and_row_groups_in_any_order(lake: Path, tmp_path: Path) -> None:
    table = lakes.table_of(lakes.recorded(0, 0, 5.0), 0)
    late = table.take(np.random.default_rng(0).permutation(100))
    lakes.write(tmp_path / "b.parquet", table.slice(300), 50)
    lakes.write(tmp_path / "a.parquet", table.slice(100, 200), 70)
    lakes.write(tmp_path / "c.parquet", late, 30)
    files = [str(tmp_path / f"{name}.parquet") for name in "abc"]
    blocks = list(read.read_blocks(files, Columns()))
    found = Rows.concatenate(blocks)
    assert len(blocks) > 5 and np.array_equal(found.y, table.column("y").to_numpy())
    assert np.array_equal(found.t_us, table.column("t").cast("int64").to_numpy())
    assert np.array_equal(Rows.unpack(found.pack()).u, found.u)


def test_a_lake_is_found_by_its_folders_or_in_a_table(lake: Path, tmp_path: Path) -> None:
    found = Lake.open(str(lake))
    assert found.assets == ("P0", "P1", "P2", "P3") and len(found.items) == 8
    assert found.items[0].key == ("P0", lakes.DAYS[0]) and found.items[0].groups == (("supply", "A"),)
    assert Lake.open(f"file://{lake}").items[0].files[0] == f"file://{found.items[0].files[0]}"
    values = lakes.table_of(lakes.recorded(0, 0, 1.0), 0).set_column(0, "t", pa.array(np.arange(100) / 100.0))
    pacsv.write_csv(values, tmp_path / "one.csv")
    (rows,) = read.read_blocks([str(tmp_path / "one.csv")], Columns())
    assert rows.t_us.tolist() == list(range(0, 1_000_000, 10_000))
    table = tmp_path / "files.csv"
    table.write_text(f"asset,file,site\nP0,{found.items[0].files[0]},north\nP9,gone.csv,\n")
    listed = Lake.open(str(table)).items
    assert [item.key for item in listed] == [("P0", "part-0"), ("P9", "gone")]
    assert listed[0].groups == (("site", "north"),) and listed[1].files == (str(tmp_path / "gone.csv"),)
    with pytest.raises(RecordingError, match=r"no folder machine=\.\.\."):
        Lake.open(str(lake), ("machine", "day"))


def test_a_fleet_says_who_is_ill_and_what_could_not_be_examined(done: tuple[Plan, fleet.Fleet]) -> None:
    plan, known = done
    states = {one.asset: one.state for one in known.assets}
    assert states == {"P0": "healthy", "P1": "fault", "P2": "failed", "P3": "failed"}
    ill = known.assets[0]
    assert ill.asset == lakes.ILL and ill.fault == "leakage" and ill.before == "healthy" and ill.probability > 0.99
    assert [(asset, day) for asset, day, _ in known.failed] == [(x, lakes.DAYS[1]) for x in ("P2", "P3")]
    assert "damaged Parquet" in known.failed[0][2] and "y is constant" in known.failed[1][2]
    page = (plan.output / "report.html").read_text()
    assert "1 asset ill by itself" in page and "y is constant" in page
    table = pq.read_table(plan.output / "diagnoses.parquet")
    assert table.num_rows == 8 and table.column("verdict").to_pylist()[3] == "fault"
    trace = pq.read_table(
        plan.output / "traces" / "asset=P1" / f"day={lakes.DAYS[1]}" / "trace.parquet", partitioning=None
    )
    assert trace.num_rows == 150 and {"time_us", "theta_0", "statistic", "threshold", "level"} <= set(
        trace.column_names
    )


def test_the_budget_of_false_alarms_is_shared(done: tuple[Plan, fleet.Fleet]) -> None:
    from servoscope.baseline.baseline import Baseline

    plan, _ = done
    own = Baseline.load(plan.output / "baselines" / "A.json")
    trace = pq.read_table(
        plan.output / "traces" / "asset=P0" / f"day={lakes.DAYS[0]}" / "trace.parquet", partitioning=None
    )
    assert trace.column("threshold")[0].as_py() == own.shared(4).thresholds.statistic > own.thresholds.statistic


def test_a_run_goes_on_where_it_was_and_does_nothing_twice(
    done: tuple[Plan, fleet.Fleet], monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, known = done
    before = entries(plan.output)
    with (plan.output / "journal.jsonl").open("ab") as file:
        file.write(b'{"asset": "P0", "day": "torn')  # a kill in the middle of a line
    asked: list[Any] = []
    again = fleet.run(plan, lambda tasks: iter(asked.extend(tasks) or [(task, task.run()) for task in tasks]))
    assert [task.key for task in asked] == [("P2", lakes.DAYS[1]), ("P3", lakes.DAYS[1])]  # what failed, once more
    assert again == known and entries(plan.output) == before
    with pytest.raises(OutputError, match="another window_s: give another folder"):
        fleet.run(Plan(plan.lake, plan.output, plan.loop, by="supply", window_s=60.0), local(1))


def killed(plan: Plan) -> None:
    fleet.run(plan, local(1))


def test_after_a_kill_nothing_is_lost_and_nothing_counted_twice(done: tuple[Plan, fleet.Fleet], tmp_path: Path) -> None:
    plan, known = done
    (tmp_path / "baselines").mkdir()
    for path in (plan.output / "baselines").iterdir():
        (tmp_path / "baselines" / path.name).write_bytes(path.read_bytes())
    other = Plan(plan.lake, tmp_path, plan.loop, by="supply")
    process = multiprocessing.get_context("spawn").Process(target=killed, args=(other,))
    process.start()
    journal = tmp_path / "journal.jsonl"
    until = time.monotonic() + 120.0
    while time.monotonic() < until and (not journal.exists() or journal.read_bytes().count(b"\n") < 3):
        time.sleep(0.01)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert 2 <= journal.read_bytes().count(b"\n") - 1 < 8
    assert fleet.run(other, local(1)) == known
    assert entries(tmp_path) == entries(plan.output)


class Killer(ExamineTask):
    """An item whose reading takes its process with it, as a want of memory does."""

    def run(self) -> dict[str, Any]:
        if self.item.asset == lakes.ILL:
            os._exit(1)
        return {"asset": self.item.asset, "day": self.item.day, "stamp": "", "status": "examined", "error": None}


def test_a_task_that_kills_its_process_costs_itself_only(lake: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # where a worker finds `Killer`
    tasks = [Killer(item, None, "", 1, None, 1.0, None) for item in Lake.open(str(lake)).items[2:5]]
    found = {task.key: result["status"] for task, result in local(2)(tasks)}
    assert found == {task.key: "failed" if task.item.asset == lakes.ILL else "examined" for task in tasks}


def test_the_command_runs_a_fleet(done: tuple[Plan, fleet.Fleet], lake: Path) -> None:
    plan, _ = done
    words = ("fleet", lake, "-o", plan.output, "--loop", lakes.LOOP, "--baseline-by", "supply", "--jobs", 1)
    result = run(*words, "--fail-on-fault")
    assert result.code == 3 and "1 asset ill by itself" in result.out and "P3 2026-11-02: " in result.out
    assert json.loads(run(*words, "--json").out)["assets"][0]["asset"] == lakes.ILL
    assert run("fleet", lake, "-o", plan.output).code == 2
    one_line(run(*words[:3], plan.output, "--baselines", plan.output), "belongs to a run with another baselines")


def test_new_machines_start_from_like_ones_and_not_from_themselves(lake: Path, tmp_path: Path) -> None:
    """Six machines are known, one of them by the name of an asset of the lake: it has five like ones, others six."""
    known = tmp_path / "known"
    known.mkdir()
    for asset, name in enumerate(("P0", *(f"old-{i}" for i in range(5))), 10):
        learn_baseline(lakes.loop(), [lakes.recorded(asset, 0, 15.0)]).save(known / f"{name}.json")
    words = ("fleet", lake, "-o", tmp_path / "out", "--jobs", 1, "--population", known)
    assert run(*words, "--loop", lakes.LOOP).code == 0
    notes = {name: str(Baseline.load(tmp_path / f"out/baselines/{name}.json").notes) for name in ("P0", "P1")}
    assert "5 like machines" in notes["P0"] and "6 like machines" in notes["P1"]
    assert "--population goes with --loop" in run(*words, "--baselines", known).err
    one_line(run(*words[:-2], "--loop", lakes.LOOP), "belongs to a run with another population")


def test_following_knows_its_default_window_everywhere() -> None:
    from servoscope.cli.fleet import WINDOW

    assert WINDOW == day_monitor.WINDOW
