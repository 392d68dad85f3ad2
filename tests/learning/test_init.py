"""A loop file from a log: what is proposed fits the machine that made the log, and is written with its reasons."""

from __future__ import annotations

from pathlib import Path

import pytest
from commands import one_line, run
from logs import GERMAN_RATE, german_axis

import servoscope as ss
from servoscope.learning import proposal
from servoscope.models.loop import Loop
from servoscope.models.plants.axis import AxisPlant
from servoscope.signals.readers import csv


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return german_axis(tmp_path_factory.mktemp("init") / "achse.csv")


def test_the_proposal_is_the_machine_and_says_why(log: Path, tmp_path: Path) -> None:
    target = tmp_path / "loop.toml"
    told = run("init", log, "-o", target)
    assert told.code == 0 and "Usable" in told.out
    loop = Loop.load(target)
    assert isinstance(loop.plant, AxisPlant)
    assert loop.plant.terms == ("viscous", "coulomb", "offset")
    assert "axis: viscous, coulomb, offset" in told.out and told.out.count("\n") <= 25
    assert told.out.count("servoscope learn") == 1
    told = run("init", log, "-o", target, "--yes", "--details")
    assert "plants compared" in told.out and "coherence r, u" in told.out
    assert loop.sample_rate == pytest.approx(GERMAN_RATE)
    assert loop.columns.output == "0.001 * `Istposition [mm]`" and loop.columns.time_unit == "ms"
    assert 0.2 < (loop.monitor.cutoff or 0.0) <= GERMAN_RATE / 10.0 and 5.0 <= loop.monitor.memory <= 10.0
    text = target.read_text(encoding="utf-8")
    assert "#   axis: viscous, coulomb, offset: 99." in text and "plants compared" in text
    assert all("  # " in line for line in text.splitlines() if " = " in line)
    assert 'input = "Drehmoment [Nm]"' in text and "mm in the name, factor to SI units" in text
    assert run("inspect", log, "--loop", target).code == 0
    one_line(run("init", log, "-o", target), "exists", "--yes")


def test_a_log_whose_names_say_nothing_needs_columns(log: Path, tmp_path: Path) -> None:
    rows = [line for line in log.read_text(encoding="utf-8").splitlines() if line[0].isdigit()]
    path = tmp_path / "x.csv"
    path.write_text("\n".join(rows), encoding="utf-8")
    one_line(run("init", path, "-o", tmp_path / "a.toml", "--yes"), "no name suggests u and y", "--columns")
    mapping = "t=c0[ms], r=1e-3*c1, u=c2, y=1e-3*c3"
    assert run("init", path, "-o", tmp_path / "a.toml", "--columns", mapping).code == 0
    assert Loop.load(tmp_path / "a.toml").columns.output == "1e-3*c3"


def test_several_logs_and_folders_are_one_machine(log: Path, tmp_path: Path) -> None:
    folder, target = tmp_path / "logs", tmp_path / "loop.toml"
    folder.mkdir()
    text = log.read_text(encoding="utf-8")
    for name in ("monday", "tuesday"):
        (folder / f"{name}.csv").write_text(text, encoding="utf-8")
    (folder / "wednesday.csv").write_text("Zeit;Drehmoment\n1;2\n", encoding="utf-8")
    told = run("init", folder, "-o", target)
    assert told.code == 0 and "left out" in told.out and "wednesday.csv" in told.out
    assert told.out.count("Usable") == 2
    assert "monday.csv" in told.out and "tuesday.csv -o baseline.json" in " ".join(told.out.split())
    assert Loop.load(target).plant.kind == "axis"


def test_of_a_long_log_a_part_is_looked_at(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not [note for note in ss.init(log).notes if note.key == "init.part"]
    monkeypatch.setattr(proposal, "PART_ROWS", 2000)
    monkeypatch.setattr(csv, "CHUNK_BYTES", 1 << 14)
    proposed = ss.init(log)
    (note,) = [note for note in proposed.notes if note.key == "init.part"]
    assert 2000 <= note.values["rows"] < 4000 and proposed.loop.sample_rate == pytest.approx(GERMAN_RATE)


def test_what_may_be_a_covariate_is_mentioned(log: Path, tmp_path: Path) -> None:
    lines = log.read_text(encoding="utf-8").splitlines()
    added = ["Öltemperatur", "°C", *(f"{20.0 + 1e-3 * k:.3f}".replace(".", ",") for k in range(len(lines)))]
    rows = [lines[0], *(f"{line};{cell}" for line, cell in zip(lines[1:], added, strict=False))]
    path = tmp_path / "warm.csv"
    path.write_text("\n".join(rows), encoding="utf-8")
    told = run("init", path, "-o", tmp_path / "loop.toml")
    assert told.code == 0 and "Öltemperatur" in told.out and "a temperature, with which friction" in told.out
    text = (tmp_path / "loop.toml").read_text(encoding="utf-8")
    assert Loop.load(tmp_path / "loop.toml").columns.covariates == {}
    (tmp_path / "loop.toml").write_text(text.replace("# covariates =", "covariates ="), encoding="utf-8")
    assert Loop.load(tmp_path / "loop.toml").columns.covariates == {"öltemperatur": "`Öltemperatur [°C]`"}


def test_rest_that_the_plant_does_not_explain_is_left_out(shared_data: Path, tmp_path: Path) -> None:
    target = tmp_path / "loop.toml"
    told = run("init", shared_data / "real" / "xl330" / "sin_sin_kp100.parquet", "-o", target)
    out = " ".join(told.out.split())
    assert told.code == 0 and "temp, " in out and "a temperature, with which" in out
    monitor = Loop.load(target).monitor
    assert monitor.update_when == "moving" and 0.0 < monitor.rest_speed < 0.1


def test_explore_says_what_took_its_place(tmp_path: Path) -> None:
    one_line(run("explore", "loop.toml", "a.csv", "-o", tmp_path / "axis.toml"), "servoscope init", "part of")


def test_control_characters_in_names_leave_valid_toml(log: Path, tmp_path: Path) -> None:
    path, target = tmp_path / "a\nname = 1.csv", tmp_path / "loop.toml"
    path.write_text(log.read_text(encoding="utf-8").replace("Istposition", "Ist\x7fposition"), encoding="utf-8")
    assert run("init", path, "-o", target).code == 0
    assert Loop.load(target).columns.output == "0.001 * `Ist\x7fposition [mm]`"
    assert "\n" not in target.read_text(encoding="utf-8").splitlines()[0]
