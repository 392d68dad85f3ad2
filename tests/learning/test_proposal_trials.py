"""What init proposes was tried: it can be learned from, or one line says why nothing can."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import servoscope as ss
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import RecordingError

RATE, SAMPLES = 100.0, 6000


def motion(seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a sum of sines up to 3 Hz with its first and second derivative."""
    rng = np.random.default_rng(seed)
    w, t = 2.0 * np.pi * rng.uniform(0.1, 3.0, 8)[:, None], np.arange(SAMPLES) / RATE
    angle = w * t + rng.uniform(0.0, 2.0 * np.pi, 8)[:, None]
    size = 1.0 / w
    return tuple((part).sum(axis=0) for part in (size * np.sin(angle), np.cos(angle), -w * np.sin(angle)))  # type: ignore[return-value]


def written(path: Path, u: FloatArray, y: FloatArray, names: str = "u,y") -> Path:
    header = f"t,r,{names}"
    rows = np.column_stack([np.arange(SAMPLES) / RATE, np.roll(y, 1), u, y])
    np.savetxt(path, rows, "%.9g", ",", header=header, comments="")
    return path


def test_a_fast_valve_at_1_hz_can_be_learned(tmp_path: Path) -> None:
    rng, path = np.random.default_rng(2), tmp_path / "valve.csv"
    command = np.cumsum(rng.standard_normal(3600)) * 0.1 + rng.standard_normal(3600)
    position = np.zeros(3600)
    for k in range(1, 3600):
        position[k] = position[k - 1] + 0.7 * (command[k - 1] - position[k - 1])
    np.savetxt(path, np.column_stack([np.arange(3600.0), command, position]), "%.3f", ",", header="t,u,y", comments="")
    loop = ss.init(path).loop
    assert ss.learn(loop, [ss.read(path, loop)]).detectability.explained > 0.9


def test_a_speed_without_unit_is_no_position(tmp_path: Path) -> None:
    _, speed, acceleration = motion(1)
    noise = 0.005 * np.random.default_rng(3).standard_normal(SAMPLES)
    u = 0.05 * acceleration + 0.2 * speed + 0.5 * np.sign(speed) + noise
    proposal = ss.init(written(tmp_path / "a.csv", u, 300.0 * speed, "u,n"), "y=n,u=u")
    assert proposal.loop.plant.kind == "axis" and proposal.candidates[0].settings["y"] == "speed"
    assert [line.doubtful for line in proposal.lines if line.key == "y"] == [True]
    position, *_ = motion(1)
    u = 0.05 * acceleration + 0.2 * speed + 0.5 * np.sign(speed) + noise
    assert "y" not in ss.init(written(tmp_path / "b.csv", u, position)).candidates[0].settings


def test_words_and_kind_choose_between_a_valve_and_a_motor(tmp_path: Path) -> None:
    position, speed, acceleration = motion(2)
    u = 0.002 * acceleration + np.where(speed > 0.0, 1.0, 1.3) * speed
    u += 0.01 * np.random.default_rng(4).standard_normal(SAMPLES)
    valve, motor = (
        written(tmp_path / f"{name}.csv", u, position, f"{name},y") for name in ("ValveVoltage", "MotorVoltage")
    )
    assert ss.init(valve).loop.plant.kind == "cylinder"
    proposal = ss.init(motor)
    assert proposal.loop.plant.kind == "axis"
    assert [note.values["kind"] for note in proposal.notes if note.key == "init.rival"] == ["cylinder"]
    assert ss.init(motor, kind="cylinder").loop.plant.kind == "cylinder"


def test_what_explains_nothing_is_not_proposed(tmp_path: Path) -> None:
    position, _, _ = motion(3)
    u = np.random.default_rng(5).standard_normal(SAMPLES)
    with pytest.raises(RecordingError, match="not usable: no plant explains u"):
        ss.init(written(tmp_path / "noise.csv", u, position))


def test_signs_that_no_machine_has_are_said_and_learned(tmp_path: Path) -> None:
    position, speed, acceleration = motion(4)
    u = 0.05 * acceleration - 0.5 * np.abs(speed) - 0.6 * speed + 0.3 * np.sign(speed)
    u += 0.01 * np.random.default_rng(6).standard_normal(SAMPLES)
    path = written(tmp_path / "odd.csv", u, position)
    proposal = ss.init(path)
    assert proposal.loop.implausible == "note"
    assert [line.key for line in proposal.lines if line.doubtful and line.section == ""] == ["implausible"]
    assert ss.learn(proposal.loop, [ss.read(path, proposal.loop)]).notes
