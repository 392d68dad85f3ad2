"""Noise that grows within a recording: when, by how much, and what is none."""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files
from typing import Any

import numpy as np
import pytest

import servoscope as ss
from servoscope.detection.louder_noise import find_louder_noise
from servoscope.simulation import FaultEvent, reference, simulate

N, ONSET = 4000, 2400
MEMORY_S = 1.0


@pytest.fixture
def recording() -> ss.Recording:
    """A motion at 100 Hz, of which u and y are measured with noise."""
    t, rng = np.arange(N) / 100.0, np.random.default_rng(1)
    r = np.sin(2.0 * t) + 0.3 * np.sin(7.0 * t)
    u, y = 5.0 * r + 0.01 * rng.normal(size=N), r + 1e-4 * rng.normal(size=N)
    restart, run = np.zeros(N, dtype=np.bool_), np.zeros(N, dtype=np.int32)
    return ss.Recording(t=t, r=r, u=u, y=y, restart=restart, name="motion", sample_rate=100.0, run=run)


def with_noise(recording: ss.Recording, signal: str, std: float, seed: int = 2) -> ss.Recording:
    x = getattr(recording, signal).copy()
    x[ONSET:] += std * np.random.default_rng(seed).normal(size=len(x) - ONSET)
    return replace(recording, **{signal: x})


@pytest.mark.parametrize(("signal", "std"), [("y", 4e-4), ("u", 0.04)])
def test_onset_and_size(recording: ss.Recording, signal: str, std: float) -> None:
    noise = find_louder_noise(with_noise(recording, signal, std), MEMORY_S)
    assert noise is not None
    assert noise.signal == signal
    assert abs(noise.onset - ONSET) <= 10
    assert noise.growth == pytest.approx(np.sqrt(17.0), rel=0.15)


def test_what_is_no_noise(recording: ss.Recording) -> None:
    """The same noise throughout, a signal in another unit, a motion that begins, a vibration, a single outlier."""
    later = np.arange(N) >= ONSET
    shaken = recording.y + later * 1e-3 * np.sin(2.0 * np.pi * 12.0 * recording.t)
    resting = replace(recording, y=np.where(later, recording.y, 1e-4 * np.random.default_rng(3).normal(size=N)))
    outlier = recording.y.copy()
    outlier[ONSET] += 1.0
    scaled = replace(recording, u=np.where(later, 3.0, 1.0) * recording.u)
    for other in (recording, scaled, resting, replace(recording, y=shaken), replace(recording, y=outlier)):
        assert find_louder_noise(other, MEMORY_S) is None


def simulated(loop: ss.Loop, seed: int, *faults: FaultEvent) -> ss.Recording:
    return simulate(loop, reference("multisine", 40.0, 100.0, seed=seed), faults=faults, seed=seed)[0]


@pytest.fixture(scope="module")
def baseline() -> ss.Baseline:
    loop = ss.Loop.load(str(files("servoscope") / "simulation" / "reference-rig.toml"))
    return ss.learn(loop, [simulated(loop, seed) for seed in range(2)])


def test_a_sensor_that_fails_is_no_fault_of_the_plant(baseline: ss.Baseline) -> None:
    diagnosis = ss.diagnose(baseline, with_noise(simulated(baseline.loop, 9), "y", 1.2e-3))
    assert diagnosis.verdict != "fault"
    assert "y is" in str(diagnosis.warnings[-1].description)


def test_a_fault_keeps_its_name(baseline: ss.Baseline) -> None:
    leaking = simulated(baseline.loop, 9, FaultEvent("C_ie", 1.5, 16.0))
    diagnosis = ss.diagnose(baseline, with_noise(leaking, "y", 1.2e-3))
    (fault,) = diagnosis.faults
    assert fault.name == "leakage"
    assert fault.interval[0] <= 1.5 <= fault.interval[1]
    assert diagnosis.onset_s is not None
    assert diagnosis.onset_s[0] <= 16.0 <= diagnosis.onset_s[2]


AXIS: dict[str, Any] = {
    "kind": "axis", "terms": ["viscous", "coulomb", "offset"],
    "coefficients": {"inertia": 2.0, "viscous_friction": 8.0, "coulomb_friction": 3.0, "offset": 0.5},
}  # fmt: skip


def moved_axis(seed: int, *faults: FaultEvent) -> ss.Recording:
    t = np.arange(2400) / 100.0
    loop = ss.Loop.from_dict(
        {"sample_rate": 100.0, "plant": AXIS, "controller": {"kind": "pi", "k_p": 400.0, "k_i": 0.0}}
    )
    r = 0.5 * np.sin((2.0 + 0.1 * seed) * t) + 0.2 * np.sin(5.1 * t)
    return simulate(loop, r, faults=faults, noise_u_std=0.05, noise_y_std=1e-5, seed=seed)[0]


def test_a_sensor_of_an_axis_that_fails_is_told_and_a_fault_before_keeps_its_name() -> None:
    """Noise of y takes the inertia away from the estimate: "the moved mass has fallen by 80 %"."""
    loop = ss.Loop.from_dict({"sample_rate": 100.0, "plant": {"kind": "axis"}, "monitor": {"memory": 2.0}})
    learned = ss.learn(loop, [moved_axis(seed) for seed in range(2)])
    weaker = FaultEvent("input_gain", 0.8, 12.0)
    for recording, names in ((moved_axis(3), []), (moved_axis(3, weaker), ["motor_constant"])):
        y = recording.y.copy()
        y[1600:] += 3e-3 * np.random.default_rng(4).normal(size=800)
        diagnosis = ss.diagnose(learned, replace(recording, y=y))
        assert [fault.name for fault in diagnosis.faults] == names
        assert diagnosis.verdict == ("fault" if names else "undetermined")
        assert "times as noisy from 16" in str(diagnosis.warnings[-1].description)
        assert all(warning.kind != "noise" for warning in ss.diagnose(learned, recording).warnings)
