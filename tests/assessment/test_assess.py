"""One log to facts and a verdict: what is plain, what cannot be judged, exports of many tags, and the command."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import servoscope as ss
from servoscope.assessment.assess import Assessment
from servoscope.assessment.log import LogForms
from servoscope.cli import app
from servoscope.cli.assess import MIN_FILES_PER_START
from servoscope.core.messages import speak
from servoscope.learning.learn import doubt_healthy
from servoscope.report.loop_ranking import group_by_period, rank
from servoscope.signals import clean
from servoscope.signals.readers.tags import find_loops
from servoscope.signals.samples import Samples

N = 1200
T = np.arange(N) * 10.0


def loop(seed: int, *, gain: float = 0.3, stick: float = 0.0) -> dict[str, np.ndarray]:
    """A flow loop under PI control, with noise and a valve that sticks by `stick`."""
    rng = np.random.default_rng(seed)
    u, y, x, level, total = np.zeros(N), np.zeros(N), 0.0, 0.0, 0.0
    load = 0.0
    for k in range(N):
        load = 0.95 * load + 0.05 * rng.standard_normal()
        y[k] = level + 0.03 * rng.standard_normal()
        total -= y[k] / 6.0
        u[k] = gain * (total - y[k])
        if abs(u[k] - x) > 0.75 * stick:
            x = u[k] - np.sign(u[k] - x) * 0.25 * stick
        level = 0.8 * level + 0.2 * (x + load)
    return {"t": T, "r": np.full(N, 50.0), "u": 50.0 + u, "y": 50.0 + y}


def names(assessment: Assessment) -> set[str]:
    return {fact.name for fact in assessment.facts}


def test_constant_signals_are_a_frozen_sensor_and_manual_mode() -> None:
    good = loop(1)
    assert ss.assess({**good, "y": np.full(N, 50.0)}).verdict == "frozen sensor"
    assert ss.assess({**good, "u": np.full(N, 40.0)}).verdict == "manual"


def test_a_sticking_valve_is_found_and_a_good_loop_is_not_called_so() -> None:
    sticks = ss.assess(loop(21, stick=4.0))
    assert sticks.verdict == "stiction"
    assert sticks.value("y rests while u moves on") > 22.0
    assert "32" in str(sticks.reason)
    assert "packing" in str(sticks.advice)
    assert "brake" in str(ss.assess(loop(21, stick=4.0), kind="axis").advice)
    good = ss.assess(loop(3))
    assert good.verdict == "nothing conspicuous"
    assert Assessment.model_validate(good.model_dump(mode="json")).facts == good.facts


def test_a_slow_loop_does_not_stick() -> None:
    """After a step of the load e decays over most of the log: y is far from r for long, but it does not rest."""
    t = np.arange(N)
    e = np.exp(-t / 300.0) + 0.003 * np.random.default_rng(0).standard_normal(N)
    assert ss.assess({"t": T, "r": np.zeros(N), "u": np.cumsum(e) / 300.0, "y": -e}).verdict == "nothing conspicuous"


def test_rest_is_left_out_of_all_other_facts() -> None:
    rng, t = np.random.default_rng(1), np.arange(0.0, 20.0, 0.02)
    r = np.sin(3.0 * t) + 0.4 * np.sin(7.0 * t)
    y = np.interp(t - 0.05, t, r) + 0.001 * rng.standard_normal(t.size)
    alone = ss.assess({"t": t, "r": r, "u": 0.2 * (r - y), "y": y})
    still = 0.001 * rng.standard_normal(2 * t.size)
    whole = {
        "r": np.r_[r, np.full(still.size, r[-1])],
        "y": np.r_[y, r[-1] + still],
        "u": np.r_[0.2 * (r - y), -0.2 * still],
    }
    rested = ss.assess({"t": np.arange(3 * t.size) * 0.02, **whole})
    assert rested.value("rest") == pytest.approx(66.7, abs=3.0)
    assert rested.verdict == alone.verdict == "nothing conspicuous"
    assert rested.value("tracking error") == pytest.approx(alone.value("tracking error"), rel=0.1)


def test_what_cannot_be_judged_says_why() -> None:
    log = loop(4)
    short = ss.assess({name: x[:50] for name, x in log.items()})
    assert short.verdict == "cannot tell"
    assert "at least 100" in str(short.reason)
    holes = log["y"].copy()
    holes[::2] = np.nan
    assert "50 %" in str(ss.assess({**log, "y": holes}).reason)
    with speak("de"):
        assert "mindestens 100" in str(short.reason)


def test_a_missing_reference_and_gaps_do_not_stop_it() -> None:
    log = loop(5)
    kept = np.r_[0:300, 302:900, 1000:N]
    result = ss.assess({name: x[kept] for name, x in log.items() if name != "r"})
    assert result.verdict == "nothing conspicuous"
    assert "tracking error" not in names(result)
    even = form(log, kept).even
    assert even.t.size == 900  # the gap of two rows is filled, the one of a hundred cuts


def form(log: dict[str, np.ndarray], rows: np.ndarray, restart: np.ndarray | None = None) -> LogForms:
    t, u, y = (log[name][rows] for name in ("t", "u", "y"))
    return LogForms.from_samples(Samples.from_columns(t, u, u, y, restart), "x")


def test_rows_of_another_mode_are_cut() -> None:
    log = loop(5)
    restart = np.isin(np.arange(N), (701, 900))
    assert form(log, np.arange(N), restart).even.t.size == 701
    assert "mode" in find_loops(["Date", "FIC101.PV", "FIC101.OP", "FIC101.mode"])["FIC101"].segment[0]
    words = {**log, "mode": np.where(np.arange(N) > 700, "AUTO", "MAN")}
    assert ss.assess(words).verdict == "nothing conspicuous"


def test_a_million_rows_are_thinned() -> None:
    rng = np.random.default_rng(6)
    u = np.cumsum(rng.standard_normal(1_000_000)) * 0.01
    log = LogForms.from_samples(Samples.from_columns(np.arange(1e6), u, u, u + rng.standard_normal(1_000_000)), "x")
    assert log.recorded.t.size == 1_000_000
    assert log.even.t.size <= 200_000


def test_tags_of_an_export_are_loops() -> None:
    names = ["Date", "FIC101.PV", "FIC101.OP", "FIC101.SP", "LIC7_MV", "LIC7_PV", "TI9.PV", "PC3SV", "PC3MV", "PC3PV"]
    found = find_loops(names)
    assert list(found) == ["FIC101", "LIC7", "PC3"]
    assert (found["FIC101"].time, found["FIC101"].reference, found["FIC101"].input) == (
        "Date",
        "FIC101.SP",
        "FIC101.OP",
    )
    assert found["PC3"].output == "PC3PV"
    assert list(find_loops(["t", "r", "u", "y"])) == [""]


def made(name: str, verdict: str, from_s: float = 0.0, **values: float) -> Assessment:
    facts = [{"name": name.replace("_", " "), "value": value, "unit": ""} for name, value in values.items()]
    words = dict.fromkeys(("reason", "advice"), "")
    return Assessment.model_validate(
        {
            "recording": name,
            "verdict": verdict,
            "kind": "valve",
            "from_s": from_s,
            "to_s": from_s + 1000.0,
            "samples": 9,
            "sample_rate_hz": 1.0,
            "facts": facts,
            **words,
        }
    )


def test_loops_with_one_period_are_grouped_with_the_likeliest_source_first() -> None:
    source = made("a", "stiction", oscillation=100.0, tracking_error=2.0)
    victim = made("b", "manual", oscillation=103.0, tracking_error=9.0)  # it does not answer, so it starts nothing
    other = made("c", "nothing conspicuous", oscillation=250.0, tracking_error=20.0)
    quiet = made("d", "nothing conspicuous", tracking_error=50.0)
    tomorrow = made("a", "stiction", from_s=86400.0, oscillation=100.0)
    assert group_by_period([victim, other, tomorrow, source]) == [(source, victim)]
    assert rank([quiet, victim, source, other]) == [source, victim, other, quiet]


def test_dates_place_a_log_in_time_and_stretches_count_from_its_start(tmp_path: Path) -> None:
    stamps = np.datetime64("2026-02-03T10:00:00") + np.arange(300) * np.timedelta64(10, "s")
    log = tmp_path / "dated.csv"
    rows = (f"{stamp},50,{u},{y}" for stamp, u, y in zip(stamps, loop(3)["u"], loop(3)["y"], strict=False))
    log.write_text("\n".join(["Date,FIC1.SP,FIC1.OP,FIC1.PV", *rows]))
    run = CliRunner().invoke(app, ["assess", str(log), "--json", "--from", "1000", "--to", "2500"])
    result = json.loads(run.stdout)
    begin = stamps[0].astype(float)
    assert (result["from_s"], result["to_s"], result["samples"]) == (begin + 1000.0, begin + 2490.0, 150)


def test_the_command_ranks_an_export_and_writes_pages_and_a_work_list(tmp_path: Path) -> None:
    sticks, good = loop(21, stick=4.0), loop(5)
    names = {"r": "SP", "u": "OP", "y": "PV"}
    columns = {"t": T}
    for tag, log in (("FIC1", sticks), ("FIC2", good)):
        columns |= {f"{tag}.{names[name]}": log[name] for name in "ruy"}
    lines = [",".join(columns), *(",".join(f"{x:.6g}" for x in row) for row in zip(*columns.values(), strict=True))]
    log = tmp_path / "export.csv"
    log.write_text("\n".join(lines))
    work, pages = tmp_path / "work.csv", tmp_path / "pages"
    pages.mkdir()
    run = CliRunner().invoke(app, ["assess", str(log), "--json", "--csv", str(work), "--report", str(pages)])
    assert run.exit_code == 0, run.output
    results = [json.loads(line) for line in run.stdout.splitlines()]
    assert {result["recording"] for result in results} == {"export.csv[FIC1]", "export.csv[FIC2]"}
    assert results[0]["recording"] == "export.csv[FIC1]"
    with work.open(newline="") as file:
        assert len(list(csv.reader(file))) == 3
    page = next(pages.glob("*FIC1*.html")).read_text(encoding="utf-8")
    assert "<svg" in page and "What to do" in page
    shown = CliRunner().invoke(app, ["assess", str(log)])
    assert "export.csv" in shown.output and "at limit" in shown.output
    assert max(map(len, shown.output.splitlines())) <= 80


def test_errors_are_one_line(tmp_path: Path) -> None:
    log = tmp_path / "x.csv"
    log.write_text("t,a,b\n" + "\n".join(f"{i},1,2" for i in range(200)))
    run = CliRunner().invoke(app, ["assess", str(log)])
    assert run.exit_code == 1
    assert "say where the signals stand" in run.stderr and len(run.stderr.strip().splitlines()) == 1
    assert CliRunner().invoke(app, ["assess", str(log), "--kind", "pump"]).exit_code == 2


def test_a_sticking_valve_is_no_healthy_recording_to_learn_from() -> None:
    log, good = loop(21, stick=4.0), loop(3)
    doubt = doubt_healthy(recorded(log, "monday.csv"))
    assert doubt is not None
    assert "monday.csv" in str(doubt)
    with speak("de"):
        assert "klemmt" in str(doubt)
    assert doubt_healthy(recorded(good, "friday.csv")) is None


def recorded(log: dict[str, np.ndarray], name: str) -> ss.Recording:
    t, r, u, y = (log[key] for key in ("t", "r", "u", "y"))
    return clean(t, r, u, y, name=name, sample_rate=0.1)


def test_many_files_are_assessed_in_processes_and_one_that_is_broken_costs_itself_only(tmp_path: Path) -> None:
    log = {name: x[:150] for name, x in loop(13, stick=4.0).items()}
    lines = [",".join(log), *(",".join(f"{x:.6g}" for x in row) for row in zip(*log.values(), strict=True))]
    for k in range(MIN_FILES_PER_START - 1):
        (tmp_path / f"FIC{k}.csv").write_text("\n".join(lines))
    (tmp_path / "broken.csv").write_text("t,u\n1,2\n")
    run = CliRunner().invoke(app, ["assess", str(tmp_path), "--json"])
    results = [json.loads(line) for line in run.stdout.splitlines()]
    assert sorted(result["recording"] for result in results) == sorted(p.name for p in tmp_path.glob("FIC*.csv"))
    alone = ss.assess(tmp_path / "FIC0.csv").model_dump(mode="json")
    assert all({**result, "recording": "FIC0.csv"} == alone for result in results)
    assert run.exit_code != 0
    assert "broken.csv" in run.stderr
