"""A loop file from a log: what is proposed fits the machine that made the log, and is written with its reasons."""

from __future__ import annotations

from pathlib import Path

import pytest
from commands import one_line, run
from logs import GERMAN_RATE, german_axis

from servoscope.models.loop import Loop
from servoscope.models.plants.polynomial import PolynomialPlant


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return german_axis(tmp_path_factory.mktemp("init") / "achse.csv")


def test_the_proposal_is_the_machine_and_says_why(log: Path, tmp_path: Path) -> None:
    target = tmp_path / "loop.toml"
    told = run("init", log, "-o", target)
    assert told.code == 0 and "Usable" in told.out
    loop = Loop.load(target)
    assert isinstance(loop.plant, PolynomialPlant)
    assert (loop.plant.order, loop.plant.friction, loop.plant.stiffness) == (2, "coulomb", False)
    assert loop.sample_rate == pytest.approx(GERMAN_RATE)
    assert loop.columns.output == "0.001 * `Istposition [mm]`" and loop.columns.time_unit == "ms"
    assert 0.2 < (loop.monitor.cutoff or 0.0) <= GERMAN_RATE / 10.0 and 5.0 <= loop.monitor.memory <= 10.0
    text = target.read_text(encoding="utf-8")
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


def test_control_characters_in_names_leave_valid_toml(log: Path, tmp_path: Path) -> None:
    path, target = tmp_path / "a\nname = 1.csv", tmp_path / "loop.toml"
    path.write_text(log.read_text(encoding="utf-8").replace("Istposition", "Ist\x7fposition"), encoding="utf-8")
    assert run("init", path, "-o", target).code == 0
    assert Loop.load(target).columns.output == "0.001 * `Ist\x7fposition [mm]`"
    assert "\n" not in target.read_text(encoding="utf-8").splitlines()[0]
