"""Logs as they come: each kind of bad one is refused with one line that says what to do, and read when that is done."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from commands import one_line, run, write_rows

import servoscope as ss
from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import LoopError
from servoscope.models.loop import Columns, Loop
from servoscope.signals.readers import read
from servoscope.signals.readers.axes import find_axes
from servoscope.signals.readers.wrap import find_wrap
from servoscope.signals.resample import ResampleTarget, resample_rows

RATE = 200.0
AXIS = """sample_rate = 200.0
[plant]
kind = "polynomial"
order = 2
friction = "coulomb"
offset = true
[monitor]
cutoff = 10.0
memory = 2.0
"""


def axis(t: FloatArray, seed: int = 3) -> dict[str, FloatArray]:
    """A mass of 2 with viscous friction of 3 and dry friction of 0.4, moved along three sines; any time stamps."""
    rng = np.random.default_rng(seed)
    w = 2.0 * np.pi * np.array([0.23, 0.71, 1.9])[:, None]
    a = np.array([0.05, 0.02, 0.008])[:, None]
    y, v = (a * np.sin(w * t)).sum(axis=0), (a * w * np.cos(w * t)).sum(axis=0)
    u = -2.0 * (a * w**2 * np.sin(w * t)).sum(axis=0) + 3.0 * v + 0.4 * np.sign(v) + 0.1
    u += 0.02 * rng.standard_normal(t.size)
    return {"t": t, "r": y + 1e-3 * v, "u": u, "y": y + 2e-6 * rng.standard_normal(t.size)}


def uniform(seconds: float = 30.0, rate: float = RATE, seed: int = 3) -> dict[str, FloatArray]:
    return axis(np.arange(round(seconds * rate)) / rate, seed)


def jittered(seconds: float, rate: float = RATE, spread: float = 0.4) -> FloatArray:
    """Stamps whose steps are 0.6 to 1.4 sample periods."""
    steps = 1.0 + spread * np.random.default_rng(1).uniform(-1.0, 1.0, round(seconds * rate))
    return np.asarray(np.cumsum(steps) / rate)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A loop file, a sound log, and the baseline learned from it."""
    folder = tmp_path_factory.mktemp("axis")
    (folder / "loop.toml").write_text(AXIS, encoding="utf-8")
    write_rows(folder / "healthy.csv", uniform(60.0))
    assert run("learn", folder / "loop.toml", folder / "healthy.csv", "-o", folder / "b.json").code == 0
    return folder


@pytest.mark.parametrize("frequency", [2.0, 6.0, 10.0])
def test_a_resampled_sine_is_as_exact_as_stated(frequency: float) -> None:
    """Theorem 5 of Hall and Meyer (1976): 5/384 (omega h)^4, here of the longest step."""
    t, target = jittered(20.0), ResampleTarget(RATE, 10.0)
    x = np.sin(2.0 * np.pi * frequency * t)
    found = resample_rows(t, np.zeros(t.size, np.int32), [x], set(), target, "x")
    inside = slice(100, -100)
    error = np.abs(found.columns[0] - np.sin(2.0 * np.pi * frequency * found.t))[inside].max()
    assert error < found.error * (frequency / 10.0) ** 4 and found.error < 0.01
    np.testing.assert_allclose(np.diff(found.t), 1.0 / RATE, atol=1e-9)


@pytest.mark.parametrize("rate", [150.0, 320.0, 1000.0])
def test_a_held_input_acts_the_same_when_resampled(rate: float) -> None:
    """What a held u does to the plant, its Fourier coefficient as a staircase, is the same at another rate."""
    f, target = 6.0, ResampleTarget(RATE, 10.0)
    t = np.arange(round(12.0 * rate)) / rate
    u = np.sin(2.0 * np.pi * f * t)
    found = resample_rows(t, np.zeros(t.size, np.int32), [u], {0}, target, "x")
    fine = np.arange(1.0, 11.0, 1e-4)

    def staircase(times: FloatArray, x: FloatArray) -> complex:
        held = x[np.searchsorted(times, fine + 1e-9, side="right") - 1]
        return complex((held * np.exp(-2j * np.pi * f * fine)).mean())

    assert abs(staircase(found.t, found.columns[0]) / staircase(t, u) - 1.0) < 0.005


def test_irregular_stamps_ask_for_resampling(folder: Path, tmp_path: Path) -> None:
    path = write_rows(tmp_path / "x.csv", axis(jittered(30.0, spread=0.9)))
    one_line(run("diagnose", folder / "b.json", path), "far from one sample", "--resample")
    told = run("diagnose", folder / "b.json", path, "--resample")
    assert told.code == 0 and "Healthy" in told.out
    assert "Hz as logged to 200" in " ".join(told.out.split()) and "off by at most" in told.out
    proposed = run("init", path, "-o", tmp_path / "x.toml")
    assert proposed.code == 0 and Loop.load(tmp_path / "x.toml").columns.resample


def test_steps_too_long_for_the_cutoff_are_refused_with_the_cutoff_that_they_allow(tmp_path: Path) -> None:
    path = write_rows(tmp_path / "slow.csv", uniform(60.0, 40.0))
    loop = tmp_path / "loop.toml"
    loop.write_text(AXIS, encoding="utf-8")
    line = one_line(run("inspect", path, "--loop", loop, "--resample"), "cutoff of 10 Hz", "allowed 0.01")
    allowed = line.split("cutoff to ")[1].split(" Hz")[0]
    loop.write_text(AXIS.replace("cutoff = 10.0", f"cutoff = {allowed}"), encoding="utf-8")
    assert run("inspect", path, "--loop", loop, "--resample").code == 0


def test_a_log_at_another_rate_is_judged_with_the_same_baseline(folder: Path, tmp_path: Path) -> None:
    path = write_rows(tmp_path / "fast.csv", uniform(30.0, 330.0, seed=8))
    one_line(run("diagnose", folder / "b.json", path), "330 Hz", "200 Hz", "--resample")
    assert "Healthy" in run("diagnose", folder / "b.json", path, "--resample").out
    heavier = axis(np.arange(9900) / 330.0, seed=9)
    heavier["u"][5000:] *= 1.2
    found = run("diagnose", folder / "b.json", write_rows(tmp_path / "weak.csv", heavier), "--resample").out
    assert "Fault: the input for the same motion has risen by a fifth" in found


def test_a_word_that_wraps_is_found_declared_and_unwrapped(folder: Path, tmp_path: Path) -> None:
    log = uniform(30.0)
    counts = np.round(500.0 * log["u"])
    path = write_rows(tmp_path / "w.csv", log | {"u": np.mod(counts, 65536.0)})
    one_line(run("learn", folder / "loop.toml", path, "-o", tmp_path / "b.json"), "u jumps by 65536", "% 65536")
    assert run("init", path, "-o", tmp_path / "w.toml").code == 0
    loop = Loop.load(tmp_path / "w.toml")
    assert loop.columns.input == "u % 65536"
    np.testing.assert_array_equal(read(path, loop).u, counts)
    with pytest.raises(LoopError, match="channel % range"):
        read(path, columns=Columns(input="(u + y) % 65536"))


def test_which_columns_seem_to_wrap() -> None:
    t = np.arange(0.0, 20.0, 0.005)
    turning = 900.0 * np.sin(t)
    assert find_wrap(np.mod(turning, 360.0)) == 360.0
    assert find_wrap(np.mod(np.radians(turning) + np.pi, 2.0 * np.pi) - np.pi) == pytest.approx(2.0 * np.pi)
    assert find_wrap(np.floor(np.mod(turning * 40.0, 4096.0))) == 4096.0
    assert find_wrap(turning) is None and find_wrap(360.0 * (t % 2.0 > 1.0)) is None
    assert find_wrap(np.random.default_rng(0).uniform(0.0, 360.0, 1000)) is None


@pytest.mark.parametrize("begin", [datetime(2026, 3, 29, 0, 40, tzinfo=UTC), datetime(2026, 10, 25, 0, 40, tzinfo=UTC)])
def test_local_time_is_continuous_where_clocks_are_changed(begin: datetime, tmp_path: Path) -> None:
    """German dates, 01.02.2026 13:00:00,123, over both changes of the clocks in a year."""
    log, berlin = uniform(2400.0, 1.0), ZoneInfo("Europe/Berlin")
    moments = [(begin + timedelta(seconds=float(t), milliseconds=123)).astimezone(berlin) for t in log["t"]]
    lines = ["Zeit;r;u;y"]
    for moment, *row in zip(moments, log["r"], log["u"], log["y"], strict=True):
        cells = [f"{cell:.9f}".replace(".", ",") for cell in row]
        lines.append(";".join([f"{moment:%d.%m.%Y %H:%M:%S},{moment.microsecond // 1000:03d}", *cells]))
    path = tmp_path / "x.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    told = read(path, columns=Columns(time="Zeit", time_zone="Europe/Berlin"))
    assert (told.duration_s, told.defects) == (2400.0, ())
    untold = read(path, columns=Columns(time="Zeit"))
    assert untold.run[-1] == 1 or any(defect.kind == "gap" for defect in untold.defects)
    assert run("inspect", path, "--columns", "t=Zeit[Europe/Berlin], r=r, u=u, y=y").code == 0
    wrong = run("inspect", path, "--columns", "t=Zeit[Europe/Berlim]")
    assert wrong.code == 2 and "no zone" in wrong.err


def test_without_a_reference_all_but_the_reference_works(tmp_path: Path) -> None:
    log = uniform(60.0)
    del log["r"]
    path = write_rows(tmp_path / "x.csv", log)
    assert run("init", path, "-o", tmp_path / "loop.toml").code == 0
    assert run("learn", tmp_path / "loop.toml", path, "-o", tmp_path / "b.json").code == 0
    told = run("diagnose", tmp_path / "b.json", path, "--report", tmp_path / "r.html")
    assert told.code == 0 and "Healthy" in told.out
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert ">Friction band<" in page and ">Lost motion<" not in page  # rows of the table


def test_a_file_of_several_axes_gives_one_loop_each(tmp_path: Path) -> None:
    one, two = uniform(30.0, seed=1), uniform(30.0, seed=2)
    rows = {"time": one["t"]}
    for number, log in ((1, one), (2, two)):
        rows |= {f"J{number}_setpoint": log["r"], f"J{number}_torque": log["u"], f"J{number}_position": log["y"]}
    path = write_rows(tmp_path / "robot.csv", rows)
    told = run("init", path, "-o", tmp_path / "loop.toml")
    assert told.code == 0 and "axes 1, 2" in told.out
    assert [Loop.load(tmp_path / f"loop-{k}.toml").columns.input for k in (1, 2)] == ["J1_torque", "J2_torque"]
    assert run("inspect", path, "--axis", "2").code == 0
    one_line(run("inspect", path, "--axis", "3"), "no axis '3'", "it has 1, 2")


def test_axes_are_told_by_one_number_or_letter() -> None:
    xy = ["t", "X soll", "X ist", "X strom", "Y soll", "Y ist", "Y strom"]
    assert find_axes(xy) == {"X": ["t", "X soll", "X ist", "X strom"], "Y": ["t", "Y soll", "Y ist", "Y strom"]}
    assert find_axes(["t", "r", "u", "y1", "y2"]) == {}  # two sensors
    assert find_axes(["c0", "c1", "c2", "c3"]) == {}


def test_no_baseline_that_no_machine_has(folder: Path, tmp_path: Path) -> None:
    loop, log, target = folder / "loop.toml", uniform(60.0), tmp_path / "b.json"
    turned = write_rows(tmp_path / "turned.csv", log | {"u": -log["u"]})
    one_line(run("learn", loop, turned, "-o", target), "inertia is negative", "wrong sign", "--force")
    assert not target.exists()
    assert run("learn", loop, turned, "-o", target, "--force").code == 0
    assert any("no machine has" in str(note) for note in Baseline.load(target).notes)
    noise = np.random.default_rng(1).standard_normal(log["t"].size)
    foreign = write_rows(tmp_path / "foreign.csv", log | {"u": noise})
    one_line(run("learn", loop, foreign, "-o", target), "explains only", "not usable", "--force")
    assert "Not usable" in run("inspect", foreign, "--loop", loop).out


def test_no_cause_is_named_from_coefficients_that_no_machine_has(shared_data: Path) -> None:
    """Cranfield's u is a stepper's current: its inertia is negative, and a dry screw looks like an input gain."""
    loop = Loop.load(Path(__file__).resolve().parents[2] / "examples" / "cranfield.toml")
    folder, at_20 = shared_data / "real" / "cranfield", {"load": "20"}
    healthy = ss.read_parts(folder / "normal.csv", loop, where=at_20, by="run")
    dry = ss.read_parts(folder / "lackLubrication1.csv", loop, where=at_20, by="run")
    diagnosis = ss.diagnose(ss.learn(loop, healthy[:5]), dry[1])
    assert diagnosis.verdict == "fault"
    assert diagnosis.candidates[0].name == "input_gain"
    assert diagnosis.candidates[0].probability > 0.9
    assert diagnosis.faults == ()
    (warning,) = [one for one in diagnosis.warnings if one.kind == "implausible"]
    assert "inertia and viscous_friction_backward came out negative" in warning.message
