"""Several sensors of one output: which one departs from the others, how, and the actuator's diagnosis apart from it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import servoscope as ss
from servoscope.baseline import sensors
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import LoopError
from servoscope.signals import clean
from servoscope.signals.readers.columns import parse_columns
from servoscope.signals.writers import write_recording

RATE, NOISE, ONSET = 100.0, 0.2, 3000
NAMES = ("one", "two")
SETTINGS = {
    "name": "pitch",
    "sample_rate": RATE,
    "columns": {"reference": "r", "input": "u", "output": list(NAMES)},
    "plant": {"kind": "polynomial", "order": 2, "stiffness": True},
    "monitor": {"cutoff": 1.0, "memory": 5.0, "frequencies": [0.1, 0.5]},
}


def pitch(seed: int, samples: int = 6000, w: float = 11.11, xi: float = 0.6) -> tuple[FloatArray, FloatArray]:
    """Return u and the true output of a second-order actuator, by small Euler steps; random motion about 10."""
    rng = np.random.default_rng(seed)
    u = 10.0 + np.cumsum(rng.normal(0.0, 0.05, samples)) - np.linspace(0.0, 1.0, samples)
    y, v, out = u[0], 0.0, np.empty(samples)
    for k in range(samples):
        out[k] = y
        for _ in range(10):
            v += (w * w * (u[k] - y) - 2.0 * xi * w * v) * 1e-3
            y += v * 1e-3
    return u, out


def recording(seed: int, change: dict[int, FloatArray] | None = None, count: int = 2) -> ss.Recording:
    """Return a recording of several sensors; `change`: by sensor, what it measures instead of the truth."""
    u, y = pitch(seed)
    rng = np.random.default_rng(1000 + seed)
    noise = rng.normal(0.0, NOISE, (len(y), count))
    x = {f"{name}": (change or {}).get(i, y) + noise[:, i] for i, name in enumerate(("one", "two", "three")[:count])}
    mean = np.mean(list(x.values()), axis=0)
    return clean(np.arange(len(y)) / RATE, u, u, mean, name="case", sample_rate=RATE, channels=x)


def after(values: FloatArray, changed: FloatArray) -> FloatArray:
    return np.where(np.arange(len(values)) >= ONSET, changed, values)


@pytest.fixture(scope="module")
def baseline() -> ss.Baseline:
    return ss.learn(ss.Loop.from_dict(SETTINGS), [recording(seed) for seed in range(3)])


def found(baseline: ss.Baseline, rec: ss.Recording) -> list[str]:
    return [w.description.key for w in ss.diagnose(baseline, rec).warnings if w.kind == "sensor"]


class TestDiagnosis:
    def test_healthy_sensors_are_no_finding(self, baseline: ss.Baseline) -> None:
        assert baseline.sensors is not None
        for seed in range(10, 16):
            diagnosis = ss.diagnose(baseline, recording(seed))
            assert diagnosis.verdict == "healthy"
            assert not [w for w in diagnosis.warnings if w.kind == "sensor"]

    @pytest.mark.parametrize("which", [0, 1])
    @pytest.mark.parametrize(("kind", "size"), [("gain", 1.2), ("offset", 1.0), ("fixed", 5.0), ("noise", 3.0)])
    def test_the_sensor_and_its_fault_are_named_and_the_actuator_is_healthy(
        self, baseline: ss.Baseline, which: int, kind: str, size: float
    ) -> None:
        rec = recording(20)
        x = dict(rec.channels)
        truth = x[NAMES[which]]
        loud = np.random.default_rng(5).normal(0.0, NOISE * np.sqrt(size**2 - 1.0), len(truth))
        changed = {"gain": 1.2 * truth, "offset": truth + 1.0, "fixed": np.full_like(truth, 5.0), "noise": truth + loud}
        x[NAMES[which]] = after(truth, changed[kind])
        diagnosis = ss.diagnose(baseline, replace(rec, channels=x, y=np.mean(list(x.values()), axis=0)))
        (warning,) = [w for w in diagnosis.warnings if w.kind == "sensor"]
        assert warning.description.key == f"sensor.{kind}"
        assert warning.description.values["name"] == NAMES[which]
        assert warning.description.values["size"] == pytest.approx(size, rel=0.1)
        assert warning.from_s == pytest.approx(ONSET / RATE, abs=0.5)
        assert diagnosis.verdict == "healthy"
        assert NAMES[which] in warning.message

    def test_a_fault_of_the_actuator_is_no_fault_of_a_sensor(self, baseline: ss.Baseline) -> None:
        u, y = pitch(30, w=3.42, xi=0.9)
        rng = np.random.default_rng(1)
        x = {name: y + rng.normal(0.0, NOISE, len(y)) for name in NAMES}
        mean = np.mean(list(x.values()), axis=0)
        rec = clean(np.arange(len(y)) / RATE, u, u, mean, name="slow", sample_rate=RATE, channels=x)
        assert found(baseline, rec) == []
        assert ss.diagnose(baseline, rec).verdict == "fault"


class TestThreeSensors:
    def test_the_odd_one_of_three_is_named_without_the_plant(self) -> None:
        loop = ss.Loop.from_dict({**SETTINGS, "columns": {"output": ["one", "two", "three"]}})
        model = sensors.learn_sensors(loop, [recording(seed, count=3) for seed in range(3)])
        assert model is not None
        for i in range(3):
            _, y = pitch(40)
            deviation = sensors.find_sensor_deviation(model, recording(40, {i: after(y, y + 1.0)}, count=3))
            assert deviation is not None
            assert (deviation.names, deviation.kind) == ((model.names[i],), "offset")
            assert deviation.size == pytest.approx(1.0, rel=0.1)


class TestModel:
    def test_two_sensors_whose_fault_the_plant_does_not_show_are_both_named(self) -> None:
        loop = ss.Loop.from_dict(SETTINGS)
        model = sensors.learn_sensors(loop, [recording(seed) for seed in range(3)])
        assert model is not None
        _, y = pitch(40)
        deviation = sensors.find_sensor_deviation(model, recording(40, {0: after(y, y + 1.0)}))
        assert deviation is not None
        assert set(deviation.names) == set(NAMES)
        assert deviation.text.key == "sensor.either"
        assert "which of them is wrong" in str(deviation.text)

    @given(st.floats(-3.0, 3.0), st.floats(0.9, 1.1))
    def test_healthy_offset_and_gain_between_sensors_are_learned(self, offset: float, gain: float) -> None:
        loop = ss.Loop.from_dict(SETTINGS)
        _, y = PITCH
        rec = recording_of(y, offset, gain, 1)
        model = sensors.learn_sensors(loop, [rec])
        assert model is not None
        assert sensors.find_sensor_deviation(model, recording_of(y, offset, gain, 2)) is None

    def test_the_sum_minus_its_smallest_value_is_the_cusum(self) -> None:
        z = np.random.default_rng(0).normal(1.0, 2.0, (500, 2))
        slow, g = np.empty_like(z), np.zeros(2)
        for k, row in enumerate(z):
            g = np.maximum(0.0, g + row - sensors.ALLOWANCE)
            slow[k] = g
        np.testing.assert_allclose(sensors._cusum(z), slow, atol=1e-9)

    def test_a_sensor_that_rests_with_the_others_does_not_stand_still(self) -> None:
        x = np.array([[1.0, 1.0]] * 50 + [[1.0, 2.0 + k] for k in range(4)] + [[2.0, 9.0]])
        assert sensors._repeats(x)[:, 0].tolist() == [0] * 50 + [1, 2, 3, 4, 0]

    def test_one_sensor_has_no_model(self) -> None:
        loop = ss.Loop.from_dict({**SETTINGS, "columns": {}})
        assert sensors.learn_sensors(loop, [recording(0)]) is None


PITCH = pitch(50, samples=3000)


def recording_of(y: FloatArray, offset: float, gain: float, seed: int) -> ss.Recording:
    rng = np.random.default_rng(seed)
    x = {"one": y + rng.normal(0.0, NOISE, len(y)), "two": offset + gain * y + rng.normal(0.0, NOISE, len(y))}
    mean = np.mean(list(x.values()), axis=0)
    return clean(np.arange(len(y)) / RATE, PITCH[0], PITCH[0], mean, name="case", sample_rate=RATE, channels=x)


class TestColumns:
    def test_files_are_read_with_all_sensors_and_y_is_their_mean(self, tmp_path: Path) -> None:
        loop = ss.Loop.from_dict(SETTINGS)
        rec = recording(3)
        written = write_recording(tmp_path / "case.csv", rec, loop.columns)
        assert written.output == NAMES
        back = ss.read(tmp_path / "case.csv", loop)
        assert list(back.channels) == list(NAMES)
        np.testing.assert_allclose(back.y, rec.y, rtol=1e-12)
        np.testing.assert_allclose(back.channels["two"], rec.channels["two"], rtol=1e-12)

    def test_rows_that_are_dropped_are_dropped_of_every_sensor(self) -> None:
        t, x = np.arange(100) / RATE, np.sin(np.arange(100) / 9.0)
        y = x.copy()
        y[40] = np.nan
        rec = clean(t, x, x, y, name="gap", sample_rate=RATE, channels={"one": np.arange(100.0)})
        assert rec.channels["one"].tolist() == [k for k in range(100) if k != 40]

    def test_the_command_line_names_y_once_per_sensor(self) -> None:
        assert parse_columns("y=a, y=2 * b, u=c").output == ("a", "2 * b")
        assert parse_columns("y=a").output == "a"
        with pytest.raises(LoopError, match="names a channel twice"):
            parse_columns("y=a, y=a")

    def test_a_loop_with_two_sensors_is_saved_with_its_baseline(self, baseline: ss.Baseline, tmp_path: Path) -> None:
        baseline.save(tmp_path / "b.json")
        back = ss.Baseline.load(tmp_path / "b.json")
        assert back.loop.columns.outputs == NAMES
        assert back.sensors == baseline.sensors
