"""A loop file from a log: what is proposed fits the machine that made the log, and is written with its reasons."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from commands import one_line, run
from servoscope.models.loop import Loop
from servoscope.models.plants.polynomial import PolynomialPlant

RATE = 200.0


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mass of 2 with viscous and dry friction, moved along four sines; names in German, ms and mm."""
    t = np.arange(0.0, 60.0, 1.0 / RATE)
    rng = np.random.default_rng(3)
    w = 2.0 * np.pi * np.array([0.2, 0.7, 1.9, 3.7])
    a = np.array([0.05, 0.02, 0.008, 0.003])
    y = (a[:, None] * np.sin(w[:, None] * t)).sum(axis=0)
    v = ((a * w)[:, None] * np.cos(w[:, None] * t)).sum(axis=0)
    acceleration = -((a * w**2)[:, None] * np.sin(w[:, None] * t)).sum(axis=0)
    u = 2.0 * acceleration + 3.0 * v + 0.4 * np.sign(v) + 0.1 + 0.01 * rng.standard_normal(t.size)
    r = y + 1e-3 * v
    path = tmp_path_factory.mktemp("init") / "achse.csv"
    rows = np.column_stack([1e3 * t, 1e3 * r, u, 1e3 * (y + 2e-6 * rng.standard_normal(t.size))])
    lines = ["Achse 7, nach der Wartung", "Zeit;Sollposition;Drehmoment;Istposition", "ms;mm;Nm;mm"]
    lines += [";".join(f"{cell:.6f}".replace(".", ",") for cell in row) for row in rows]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def test_the_proposal_is_the_machine_and_says_why(log: Path, tmp_path: Path) -> None:
    target = tmp_path / "loop.toml"
    told = run("init", log, "-o", target)
    assert told.code == 0 and "Usable" in told.out
    loop = Loop.load(target)
    assert isinstance(loop.plant, PolynomialPlant)
    assert (loop.plant.order, loop.plant.friction, loop.plant.stiffness) == (2, "coulomb", False)
    assert loop.sample_rate == pytest.approx(RATE)
    assert loop.columns.output == "0.001 * `Istposition [mm]`" and loop.columns.time_unit == "ms"
    assert 0.2 < (loop.monitor.cutoff or 0.0) <= RATE / 10.0 and 5.0 <= loop.monitor.memory <= 10.0
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
