"""One log to a verdict: causes that are plain, what cannot be judged, exports of many tags, and the command."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import servoscope as ss
from servoscope.assessment.assess import VERDICTS, Assessment
from servoscope.assessment.plant_loops import group_by_period, rank
from servoscope.assessment.tags import find_loops
from servoscope.cli import app
from servoscope.cli.assess import MIN_FILES_PER_START
from servoscope.core.messages import speak
from servoscope.learning.learn import doubt_healthy
from servoscope.signals import clean

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


def test_constant_signals_are_a_frozen_sensor_and_manual_mode() -> None:
    good = loop(1)
    frozen = ss.assess({**good, "y": np.full(N, 50.0)})
    assert (frozen.verdict, frozen.probability) == ("frozen sensor", 1.0)
    manual = ss.assess({**good, "u": np.full(N, 40.0)})
    assert (manual.verdict, manual.probability) == ("manual", 1.0)


def test_a_sticking_valve_is_found_and_a_good_loop_is_not_called_so() -> None:
    sticks = ss.assess(loop(2, stick=4.0))
    assert sticks.probabilities["stiction"] + sticks.probabilities["backlash"] > 0.5
    assert sticks.period_s is not None
    good = ss.assess(loop(3))
    assert good.probabilities["stiction"] < 0.5
    assert sum(good.probabilities.values()) == pytest.approx(1.0)
    assert good.verdict in VERDICTS


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
    assert result.verdict in VERDICTS
    assert result.signals is not None
    assert result.signals.r is None
    assert result.signals.t.size == 900  # the gap of two rows is filled, the one of a hundred cuts


def test_an_error_that_oscillates_with_its_reference_is_no_disturbance_from_outside() -> None:
    """A servo axis with friction under PD control with feed-forward, which follows two sinusoids well."""
    rng, dt, n = np.random.default_rng(0), 0.01, 4000
    t = np.arange(n) * dt
    r = np.sin(np.pi * t) + 0.5 * np.sin(8.5 * t + 1.0)
    speed = np.gradient(r, dt)
    y, u, x, v = np.zeros(n), np.zeros(n), 0.0, 0.0
    for k in range(n):
        y[k] = x + 1e-5 * rng.standard_normal()
        u[k] = 8.0 * (r[k] - y[k]) + 0.6 * (speed[k] - v)
        for _ in range(10):
            v += 0.1 * dt * (u[k] - 0.1 * v - 0.05 * np.tanh(v / 0.01)) / 0.02
            x += 0.1 * dt * v
    result = ss.assess({"t": t, "r": r, "u": u, "y": y})
    assert result.probabilities["oscillation from outside"] == result.probabilities["too tight"] == 0.0
    assert result.probabilities["stiction"] < 0.5


def test_rows_in_manual_mode_are_cut_out() -> None:
    log = loop(5)
    mode = np.where((np.arange(N) > 700) & (np.arange(N) < 900), 0.0, 1.0)
    u = np.where(mode > 0.0, log["u"], 40.0)
    result = ss.assess({**log, "u": u, "MODE": mode})
    assert result.signals is not None
    assert result.signals.t.size == 701
    assert "mode" in find_loops(["Date", "FIC101.PV", "FIC101.OP", "FIC101.mode"])["FIC101"].segment[0]
    words = {**log, "mode": np.where(mode > 0.0, "AUTO", "MAN")}
    assert ss.assess(words).signals is not None


def test_a_million_rows_are_thinned() -> None:
    rng = np.random.default_rng(6)
    u = np.cumsum(rng.standard_normal(1_000_000)) * 0.01
    result = ss.assess({"t": np.arange(1e6), "u": u, "y": u + rng.standard_normal(1_000_000)})
    assert result.samples == 1_000_000
    assert result.signals is not None
    assert result.signals.t.size <= 200_000


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


def made(name: str, period: float, share: float, **probabilities: float) -> Assessment:
    return Assessment(
        recording=name,
        verdict="good",
        probability=0.5,
        probabilities=probabilities,
        reason="",
        advice="",
        samples=100,
        sample_rate_hz=1.0,
        period_s=period,
        regularity=2.0,
        oscillation_share=share,
    )


def test_loops_with_one_period_are_grouped_with_the_likeliest_source_first() -> None:
    source, victim = made("a", 100.0, 0.5, stiction=0.8, good=0.2), made("b", 103.0, 0.9, good=0.4)
    other = made("c", 250.0, 0.5, good=0.1)
    assert group_by_period([victim, other, source]) == [(source, victim)]
    assert rank([victim, source, other]) == [other, source, victim]


def test_the_command_ranks_an_export_and_writes_pages_and_a_work_list(tmp_path: Path) -> None:
    sticks, good = loop(13, stick=4.0), loop(5)
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
    assert "export.csv" in shown.output and "probability" in shown.output


def test_errors_are_one_line(tmp_path: Path) -> None:
    log = tmp_path / "x.csv"
    log.write_text("t,a,b\n" + "\n".join(f"{i},1,2" for i in range(200)))
    run = CliRunner().invoke(app, ["assess", str(log)])
    assert run.exit_code == 1
    assert "say where the signals stand" in run.stderr and len(run.stderr.strip().splitlines()) == 1
    assert CliRunner().invoke(app, ["assess", str(log), "--travel", "5,1"]).exit_code == 2


def test_process_loops_are_judged(shared_data: Path) -> None:
    """Two logs of one flow loop whose valve is known to stick: the valve is found."""
    folder = shared_data / "real" / "process_loops"
    with (folder / "index.csv").open(encoding="utf-8") as index:
        files = [row["file"] for row in csv.DictReader(index) if row["loop"] == "2111FIC46005"]
    for name in files[:2]:
        result = ss.assess(folder / name)
        assert result.verdict == "stiction", name


def test_a_sticking_valve_is_no_healthy_recording_to_learn_from() -> None:
    log, good = loop(13, stick=2.0), loop(3)
    doubt = doubt_healthy(recorded(log, "monday.csv"))
    assert doubt is not None
    assert "monday.csv" in str(doubt)
    with speak("de"):
        assert "Haftreibung" in str(doubt)
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
