"""Noise in y without a controller: coefficients by instruments, from u where it is the command, from r elsewhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from accuracy import noisy_output
from scipy.linalg import expm
from scipy.signal import lfilter

import servoscope as ss
from servoscope.core.errors import RecordingError
from servoscope.estimation.pipeline import Pipeline
from servoscope.fit.instrumental_fit import fit_with_instrument
from servoscope.fit.tuning import least_squares
from servoscope.learning.instrument import source_of
from servoscope.signals import Recording, clean

RATE = 100.0
HEALTHY, AIR = (11.11, 0.6), (5.73, 0.45)  # natural frequency [rad/s] and damping of a pitch actuator
TRUE = np.array([1.0, 2.0 * HEALTHY[1] / HEALTHY[0], HEALTHY[0] ** -2])
LOOP: dict[str, Any] = {
    "name": "pitch",
    "sample_rate": RATE,
    "plant": {"kind": "polynomial", "order": 2, "stiffness": True},
    "monitor": {"cutoff": 3.0, "memory": 20.0, "frequencies": [0.1, 0.5, 1.0]},
    "faults": {"air_in_oil": {"inertia": 3.76, "viscous_friction": 1.454}},
}


def second_order(w: float, xi: float) -> tuple[Any, Any]:
    block = np.zeros((3, 3))
    block[:2] = [[0.0, 1.0, 0.0], [-w * w, -2.0 * xi * w, w * w]]
    exact = expm(block / RATE)
    return exact[:2, :2], exact[:2, 2]


def motion(samples: int, seed: int, corner: float = 1.0) -> Any:
    """Return random motion of variance one below a corner [Hz]."""
    a = np.exp(-2.0 * np.pi * corner / RATE)
    noise = np.random.default_rng(seed).normal(size=samples + 2000)
    slow = lfilter([1.0], np.poly([a, a, a]), noise)[2000:]
    return slow / slow.std()


def pitch(seconds: float, seed: int, noise: float = 0.1, fault_s: float = np.inf, lively: float = 1.0) -> Recording:
    """Return a drive whose command is u: exact for a held command, from rest at zero."""
    u = 5.0 * motion(round(seconds * RATE), seed, lively)
    parts, x, y = [second_order(*HEALTHY), second_order(*AIR)], np.zeros(2), np.empty_like(u)
    for k in range(len(u)):
        y[k] = x[0]
        A, b = parts[int(k / RATE >= fault_s)]
        x = A @ x + b * u[k]
    y += 5.0 * noise * np.random.default_rng(1000 + seed).normal(size=len(y))
    return clean(np.arange(len(u)) / RATE, u, u, y, name=f"pitch {seed}", sample_rate=RATE)


def axis(seconds: float, seed: int, noise: float) -> Recording:
    """Return an axis of inertia 2 and viscous friction 8 behind a P controller, which answers the noise of y."""
    r = motion(round(seconds * RATE), seed)
    block = np.zeros((3, 3))
    block[:2] = [[0.0, 1.0, 0.0], [0.0, -4.0, 0.5]]
    exact, x = expm(block / RATE), np.zeros(2)
    n = noise * np.random.default_rng(1000 + seed).normal(size=len(r))
    u, y = np.empty_like(r), np.empty_like(r)
    for k in range(len(r)):
        y[k] = x[0] + n[k]
        u[k] = 40.0 * (r[k] - y[k])
        x = exact[:2, :2] @ x + exact[:2, 2] * u[k]
    return clean(np.arange(len(r)) / RATE, r, u, y, name=f"axis {seed}", sample_rate=RATE)


@pytest.fixture(scope="module")
def baseline() -> ss.Baseline:
    return ss.learn(ss.Loop.from_dict(LOOP), [pitch(180.0, seed) for seed in range(2)])


def test_healthy_coefficients_are_free_of_the_noise_in_y(baseline: ss.Baseline) -> None:
    """Least squares lose a tenth of the inertia here."""
    std = np.sqrt(np.diag(baseline.covariance_array()))
    assert baseline.recursion.instrument is not None and baseline.recursion.instrument.source == "input"
    assert np.all(np.abs(np.array(baseline.theta) - TRUE) < 3.0 * std)
    assert std[2] < 0.06 * TRUE[2]
    rec, pipeline = pitch(180.0, 0), Pipeline.of(ss.Loop.from_dict(LOOP))
    assert least_squares(pipeline.regression(rec.r, rec.u, rec.y, rec.restart))[2] < TRUE[2] - 3.0 * std[2]


def test_livelier_motion_is_no_fault(baseline: ss.Baseline) -> None:
    for seed, lively in ((20, 0.7), (21, 1.5)):
        assert ss.diagnose(baseline, pitch(120.0, seed, lively=lively)).verdict == "healthy"


def test_a_ray_is_named_and_sized_by_the_stretch_since_the_onset(baseline: ss.Baseline) -> None:
    found = ss.diagnose(baseline, pitch(240.0, 31, fault_s=100.0))
    (fault,) = found.faults
    assert fault.name == "air_in_oil"
    assert fault.interval[0] < 3.76 < fault.interval[1]
    assert found.intervals[0].onset_s[1] == pytest.approx(100.0, abs=0.5)


def test_a_closed_loop_takes_its_reference() -> None:
    loop = ss.Loop.from_dict({"sample_rate": RATE, "plant": {"kind": "polynomial", "order": 2}})
    healthy = [axis(60.0, seed, 0.1) for seed in range(3)]
    learned = ss.learn(loop, healthy)
    assert learned.recursion.instrument is not None and learned.recursion.instrument.source == "reference"
    std = np.sqrt(np.diag(learned.covariance_array()))
    assert np.all(np.abs(np.array(learned.theta) - [8.0, 2.0]) < 3.0 * std)


def test_an_instrument_from_r_does_not_know_the_noise_that_it_meets() -> None:
    """Short, quiet moves at 0 dB: a model r -> y that was fitted to the same noise was wrong by four deviations."""
    monitor = {"cutoff": 3.0, "memory": 20.0}
    loop = ss.Loop.from_dict({"sample_rate": RATE, "plant": {"kind": "polynomial", "order": 2}, "monitor": monitor})
    pipeline, off = Pipeline.of(loop), []
    for seed in range(4, 10):
        recording = noisy_output.drive(seed, "reference", 0, "moves").part(0.0, 45.0)
        found = fit_with_instrument(pipeline, [recording], "reference", np.zeros(2))
        assert found is not None
        inertia, std = found.fit.tuning.theta[1], np.sqrt(found.fit.covariance[1, 1])
        off.append((inertia - noisy_output.TRUE["reference"][1]) / std)
    assert np.sqrt(np.mean(np.square(off))) < 1.5


def test_a_u_that_answers_the_noise_is_no_source() -> None:
    loop = ss.Loop.from_dict({"sample_rate": RATE, "plant": {"kind": "polynomial", "order": 2}})
    without = [clean(rec.t, rec.u, rec.u, rec.y, name=rec.name, sample_rate=RATE) for rec in (axis(60.0, 0, 0.1),)]
    assert source_of(without) == "input"
    learned = ss.learn(loop, without, force=True)  # noise leaves more of u than the motion explains
    assert learned.recursion.instrument is None
    assert any("u answers the noise of y" in str(note) for note in learned.notes)


def test_what_noise_hides_is_refused_with_the_reason() -> None:
    learned = ss.learn(ss.Loop.from_dict(LOOP), [pitch(30.0, 0, noise=3.0)])
    assert learned.recursion.instrument is None
    assert any("noise in y biases the coefficients" in str(note) for note in learned.notes)


def test_a_quiet_sensor_changes_nothing() -> None:
    loop = ss.Loop.from_dict({"sample_rate": RATE, "plant": {"kind": "polynomial", "order": 2}})
    assert ss.learn(loop, [axis(60.0, 0, 1e-5)]).recursion.instrument is None


def test_a_recording_without_a_reference_has_u_in_its_place(tmp_path: Path) -> None:
    rec, path = pitch(30.0, 0), tmp_path / "pitch.csv"
    np.savetxt(path, np.c_[rec.t, rec.u, rec.y], delimiter=",", header="t,u,y", comments="")
    read = ss.read(path, ss.Loop.from_dict(LOOP))
    assert np.array_equal(read.r, read.u)
    assert not any(finding.kind == "swapped" for finding in ss.inspect(read, ss.Loop.from_dict(LOOP)).findings)
    controlled = LOOP | {"controller": {"kind": "pi", "k_p": 1.0, "k_i": 0.0}}
    with pytest.raises(RecordingError, match="no column 'r'"):
        ss.read(path, ss.Loop.from_dict(controlled))
    named = LOOP | {"columns": {"reference": "set_point"}}
    with pytest.raises(RecordingError, match="no column 'set_point'"):
        ss.read(path, ss.Loop.from_dict(named))


def test_an_integrating_plant_has_an_instrument_from_u() -> None:
    """Its y has no steady state, so the instrument begins at the speed."""
    u, x, y = motion(6000, 3), np.zeros(2), np.empty(6000)
    block = np.zeros((3, 3))
    block[:2] = [[0.0, 1.0, 0.0], [0.0, -4.0, 0.5]]
    exact = expm(block / RATE)
    for k, force in enumerate(u):
        y[k] = x[0]
        x = exact[:2, :2] @ x + exact[:2, 2] * force
    y += 0.02 * y.std() * np.random.default_rng(5).normal(size=len(y))
    rec = clean(np.arange(len(u)) / RATE, u, u, y, name="integrator", sample_rate=RATE)
    learned = ss.learn(ss.Loop.from_dict({"sample_rate": RATE, "plant": {"kind": "polynomial", "order": 2}}), [rec])
    assert learned.recursion.instrument is not None
    std = np.sqrt(np.diag(learned.covariance_array()))
    assert np.all(np.abs(np.array(learned.theta) - [8.0, 2.0]) < 3.0 * std)


@pytest.mark.slow
def test_the_study_of_the_pitch_actuator_reduced() -> None:
    """A fault of a turbine's pitch actuator is named through its ray, and dated."""
    healthy = [noisy_output.actuator("", 300.0, 900 + i, 1.0) for i in range(2)]
    learned = ss.learn(ss.Loop.from_dict(noisy_output.LOOP), healthy)
    assert learned.recursion.instrument is not None
    found = ss.diagnose(learned, noisy_output.actuator("air in oil", 400.0, 902, 1.0))
    assert [fault.name for fault in found.faults] == ["air_in_oil"]
    assert found.intervals[0].onset_s[1] == pytest.approx(300.0, abs=1.0)


@pytest.mark.parametrize(("source", "level_db"), [("input", 0), ("reference", 10)])
def test_the_study_of_the_bias_reduced(source: str, level_db: float) -> None:
    found = noisy_output.bias_job(900, source, level_db)
    assert found["instrument"]
    assert np.all(np.abs(found["error"]) < 4.0 * np.array(found["std"]))
