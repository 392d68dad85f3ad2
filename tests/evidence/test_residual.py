"""What the healthy coefficients leave of u, over whole recordings and in their halves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import servoscope as ss
from servoscope.baseline.residual_model import (
    CLASSES,
    FADE_S,
    SIZE,
    MotionFits,
    ResidualLayout,
    ResidualModel,
    fit_coefficients,
    mean_t2,
)
from servoscope.evidence.examination import Examination
from servoscope.evidence.residual import further_covariance
from servoscope.signals import Recording
from servoscope.simulation import CylinderRig, FaultEvent, cylinder_motion, simulate_cylinder

DURATION_S = 30.0


def day(seed: int, *faults: FaultEvent, kind: str = "production", duration_s: float = DURATION_S) -> Recording:
    rig = CylinderRig(temperature=38.0 + 3.0 * (seed % 6))
    log, _ = simulate_cylinder(cylinder_motion(kind, duration_s, 250.0, seed), rig, faults=list(faults), seed=seed)
    return replace(log, name=f"{kind} {seed}", channels={"oil": log.channels["T_oil"]})


@pytest.fixture(scope="module")
def learned() -> ss.Baseline:
    loop = ss.Loop.from_dict(
        {
            "name": "cylinder",
            "sample_rate": 250.0,
            "plant": {"kind": "cylinder", "terms": ["spring", "process", "overlap", "offset"], "contact": 0.06},
            "monitor": {"cutoff": 10.0, "memory": 7.0, "frequencies": [0.5, 2.0]},
            "columns": {"covariates": {"oil": "oil temperature"}},
        }
    )
    return ss.learn(loop, [day(seed) for seed in range(7)])


def ratios(baseline: ss.Baseline, recording: Recording) -> np.ndarray:
    return Examination.from_recording(baseline, recording).residual_ratios


def model_of(baseline: ss.Baseline) -> ResidualModel:
    assert baseline.residual is not None
    return baseline.residual


def obvious_features(layout: ResidualLayout, baseline: ss.Baseline, recording: Recording, part: slice) -> np.ndarray:
    """Class by class, over whole arrays."""
    pipeline, y = baseline.pipeline(), recording.y - layout.origin
    g = pipeline.regression(recording.r, recording.u, recording.y, recording.restart)
    k = pipeline.kinematics.regression(y, y, y, recording.restart)
    ok = np.flatnonzero(g.ok & k.ok)
    ok = ok[np.isin(ok, np.arange(recording.samples)[part])]
    y, v, a = k.phi[ok].T
    e = (g.eta - g.phi @ np.array(layout.theta))[ok] - np.array(layout.means)[layout.cell(k.phi[ok])]
    classes = np.searchsorted(layout.speeds, v, side="right")
    means = [e[classes == j].sum() / ((classes == j).sum() + FADE_S * 250.0) for j in range(CLASSES)]
    signs = a, abs(a) * np.sign(v), y, y * np.sign(v)
    return np.array([*means, *((e * w).mean() / np.sqrt((w**2).mean()) for w in signs), np.sqrt((e**2).mean())])


def test_features_are_those_of_the_obvious_way(learned: ss.Baseline) -> None:
    layout, recording = model_of(learned).layout, day(20)
    features = layout.features(learned.pipeline(), recording).features
    half = recording.samples // 2
    for row, part in zip(features, (slice(None), slice(half), slice(half, None)), strict=True):
        np.testing.assert_allclose(row, obvious_features(layout, learned, recording, part), rtol=1e-9, atol=1e-12)
    assert features.shape == (3, SIZE)


def test_healthy_days_are_healthy_and_a_fault_shows_in_whole_or_half(learned: ss.Baseline) -> None:
    for seed in range(30, 36):
        assert (ratios(learned, day(seed)) < 1.0).all()
    whole, _, _ = ratios(learned, day(40, FaultEvent("gain_extend", 0.94, 0.0)))
    assert whole > 1.0
    _, shift, _ = ratios(learned, day(41, FaultEvent("overlap", 3.5, 15.0)))
    assert shift > 1.0


def test_an_alarm_of_the_residual_alone_is_explained(learned: ss.Baseline) -> None:
    quiet = learned.thresholds.model_copy(update={"statistic": 1e9})
    baseline = learned.model_copy(update={"thresholds": quiet, "features": None})
    diagnosis = ss.diagnose(baseline, day(42, FaultEvent("pump_pressure", 0.85, 0.0)))
    assert diagnosis.verdict == "fault"
    assert any("what the healthy coefficients leave of u" in str(reason) for reason in diagnosis.reasons)


@pytest.mark.parametrize(
    ("parameter", "name", "ratio"), [("pump_pressure", "supply", 0.92), ("gain_retract", "valve_backward", 0.92)]
)
def test_a_stretch_names_a_fault_with_its_size(learned: ss.Baseline, parameter: str, name: str, ratio: float) -> None:
    for seed, at_s in ((43, 0.0), (44, 12.0)):
        diagnosis = ss.diagnose(learned, day(seed, FaultEvent(parameter, ratio, at_s)))
        assert [fault.name for fault in diagnosis.faults] == [name]
        low, high = diagnosis.faults[0].interval
        assert low < ratio < high
        assert high - low < 0.1


def test_halves_scatter_and_few_samples_more(learned: ss.Baseline) -> None:
    model = model_of(learned)
    C = model.stretch_covariance(model.samples)
    np.testing.assert_array_equal(C, np.array(model.halves))
    np.testing.assert_allclose(model.stretch_covariance(0.25 * model.samples), 2.0 * C)
    assert np.linalg.eigvalsh(C / np.outer(*2 * [np.sqrt(np.diag(C))])).min() > 0.05


def test_a_fit_of_all_samples_shows_what_the_residual_hides(learned: ss.Baseline) -> None:
    """A slower spool moves one small coefficient, of which few classes of speed show anything."""
    plain = learned.loop.to_dict()
    del plain["columns"]["covariates"]
    baseline = ss.learn(ss.Loop.from_dict(plain), [day(seed) for seed in range(7)])
    whole, shift, fit = ratios(baseline, slow := day(45, FaultEvent("valve_hz", 0.5, 0.0)))
    assert max(whole, shift) < 1.0 < fit
    diagnosis = ss.diagnose(baseline, slow)
    assert [fault.name for fault in diagnosis.faults] == ["lag"]
    assert any("a fit of the coefficients" in str(reason) for reason in diagnosis.reasons)
    assert all(ratios(baseline, day(seed))[2] < 1.0 for seed in range(30, 34))
    # what is promised is what a fit shows, and half as much does not
    changes = {change.name: change.change or np.inf for change in baseline.detectability.changes}
    for ratio, shows in ((1.0 - 1.5 * changes["valve_forward"], True), (1.0 - 0.5 * changes["valve_forward"], False)):
        assert (ratios(baseline, day(47, FaultEvent("gain_extend", ratio, 0.0)))[2] > 1.0) == shows


def test_what_a_motion_lets_expect_is_what_recordings_of_it_show() -> None:
    fits = MotionFits(fits=((2.0, 7.0), (4.0, 1.0)), motions=((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)))
    theta = np.array([3.0, 5.0])
    # its own motion once, the other one's hardly, and the coefficients of all as half a fit
    for motion, fit in zip(np.array(fits.motions), np.array(fits.fits), strict=True):
        np.testing.assert_allclose(fits.expected(motion, theta), (fit + 0.5 * theta) / 1.5, rtol=1e-6)
    np.testing.assert_array_equal(fits.expected(np.full(3, 9.0), theta), theta)
    tenth = np.array([np.log(1.1), 0.0, 0.0])  # a motion that is 10 % larger is much the same
    assert abs(fits.expected(tenth, theta)[0] - fits.expected(np.zeros(3), theta)[0]) < 0.1


def test_a_coefficient_that_rows_do_not_show_counts_nothing(learned: ss.Baseline) -> None:
    recording = day(46)
    pipeline, rms = learned.pipeline(), np.array(model_of(learned).rms)
    still = replace(recording, y=np.minimum(recording.y, 0.05))  # it never reaches the process
    thetas = [
        fit_coefficients(pipeline.regression(log.r, log.u, log.y, log.restart), rms) for log in (recording, still)
    ]
    assert [int(np.isnan(theta).sum()) for theta in thetas] == [0, 1]
    left = np.random.default_rng(0).standard_normal((400, 2)) * [1.0, 3.0]
    left[::2, 1] = np.nan
    np.testing.assert_allclose(np.sqrt(np.diag(further_covariance(left, 200))), [1.0, 3.0], rtol=0.15)
    assert mean_t2(np.array([2.0, np.nan]), np.diag([4.0, 1.0])) == pytest.approx(1.0)


def test_a_short_recording_is_no_fault(learned: ss.Baseline) -> None:
    for seed in range(50, 54):
        assert not (ratios(learned, day(seed, duration_s=10.0)) > 1.0).any()


def test_another_motion_or_temperature_is_no_evidence(learned: ss.Baseline) -> None:
    assert np.isnan(ratios(learned, day(60, kind="sweep"))).all()
    hot = day(61)
    hot = replace(hot, channels={"oil": hot.channels["oil"] + 30.0})
    assert np.isnan(model_of(learned).ratios_of(learned.pipeline(), hot)).all()


def test_it_is_stored_and_needs_six_recordings(learned: ss.Baseline, tmp_path: Path) -> None:
    learned.save(tmp_path / "baseline.json")
    again = ss.Baseline.load(tmp_path / "baseline.json")
    recording = day(70)
    np.testing.assert_array_equal(ratios(again, recording), ratios(learned, recording))
    few = ss.learn(learned.loop, [day(seed) for seed in range(4)])  # one is needed for the temperature
    assert few.residual is None
    assert few.at({"oil": 44.0}).residual is None


def test_a_motion_that_never_asks_for_a_coefficient_leaves_the_covariates_of_others(learned: ss.Baseline) -> None:
    days = [day(seed) for seed in range(4)] + [day(80, kind="teach")]
    assert ss.learn(learned.loop, days).covariates is not None
