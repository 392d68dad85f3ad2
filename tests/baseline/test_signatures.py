"""What a monitor is expected to say, against many simulated recordings: mean path, covariance, statistic."""

from __future__ import annotations

from typing import Any, NamedTuple

import naive
import numpy as np
import pytest

from servoscope.baseline.expectation import Expectation, WhiteNoise, reference_path
from servoscope.detection.statistic import t2_statistic
from servoscope.estimation.pipeline import Pipeline, Regression, Tuning
from servoscope.fit.tuning import fit_tuning, least_squares
from servoscope.models.loop import Loop
from servoscope.models.lti import solve_scaled
from servoscope.signals import clean
from servoscope.simulation import FaultEvent, reference, simulate
from servoscope.simulation.measurement import NOISE_U_STD, NOISE_Y_STD

SEEDS = 60
NOISE = WhiteNoise(u_std=NOISE_U_STD, y_std=NOISE_Y_STD)
LATE = slice(150, None, 50)  # evaluations 5 s apart, after the start is forgotten


class Ensemble(NamedTuple):
    """Estimates of many recordings that differ by noise alone, shapes (SEEDS, K, ...), and what was expected."""

    theta: naive.Array
    S: naive.Array
    expectation: Expectation


def ensemble(loop: Loop, kind: str, faults: list[FaultEvent], louder: float = 1.0, seeds: int = SEEDS) -> Ensemble:
    pipeline = Pipeline.of(loop)
    noise = WhiteNoise(u_std=louder * NOISE.u_std, y_std=louder * NOISE.y_std)

    def recorded(seconds: float, seed: int, faults: list[FaultEvent]) -> Any:
        r = reference(kind, seconds, loop.sample_rate)
        return simulate(loop, r, faults=faults, noise_u_std=noise.u_std, noise_y_std=noise.y_std, seed=seed)[0]

    healthy = recorded(300.0, 999, [])
    g = pipeline.regression(healthy.r, healthy.u, healthy.y, healthy.restart)
    tuning = fit_tuning(pipeline, [g]).tuning
    recordings = [recorded(60.0, seed, faults) for seed in range(seeds)]
    estimates = [pipeline.estimate(tuning, recording) for recording in recordings]
    expectation = Expectation(pipeline, tuning, noise, reference_path(recordings[0]))
    return Ensemble(np.array([e.theta for e in estimates]), np.array([e.S for e in estimates]), expectation)


def expected(run: Ensemble, fault: FaultEvent | None) -> naive.Array:
    plant, start = run.expectation.pipeline.loop.plant, run.expectation.tuning.theta
    if fault is None:
        return run.expectation.mean_path(start, plant)
    ill = plant.with_ratios({fault.parameter: fault.ratio})
    return run.expectation.mean_path(start, plant, ill, round(100 * fault.at_s))


@pytest.mark.parametrize(
    ("kind", "fault", "louder"),
    [
        ("multisine", None, 1.0),
        ("profile", None, 5.0),  # here the noise in phi moves theta by many standard errors
        ("profile", FaultEvent("b_p", 20.0, 30.0), 1.0),
        ("multisine", FaultEvent("beta", 0.1, 30.0), 1.0),
        ("multisine", FaultEvent("C_ie", 1.3, 30.0), 5.0),
    ],
)
def test_path_is_the_mean_of_noisy_runs(
    rig: dict[str, Any], kind: str, fault: FaultEvent | None, louder: float
) -> None:
    run = ensemble(Loop.from_dict(rig), kind, [] if fault is None else [fault], louder)
    path = expected(run, fault)
    assert path.shape == run.theta.shape[1:]
    error = run.theta.std(axis=0, ddof=1) / np.sqrt(SEEDS)
    z = (run.theta.mean(axis=0) - path)[LATE] / error[LATE]
    # neighbours hang together: many z at once, of which none may be far and all together must be like a normal's
    assert np.abs(z).max() < 4.5, np.round(z, 1)
    assert np.sqrt((z**2).mean()) < 1.6, np.round(z, 1)


@pytest.mark.parametrize("kind", ["multisine", "profile"])
def test_covariance_is_that_of_the_ensemble(rig: dict[str, Any], kind: str) -> None:
    run = ensemble(Loop.from_dict(rig), kind, [], seeds=120)
    S = run.S[:, LATE]
    d = run.theta[:, LATE] - run.theta[:, LATE].mean(axis=0)
    claimed = np.sqrt(np.diagonal(S, axis1=-2, axis2=-1).mean(axis=0))
    ratio = (np.sqrt((d**2).mean(axis=0)) / claimed).mean(axis=0)
    T2 = np.mean([t2_statistic(one, 0.0 * one, its) for one, its in zip(d, S, strict=True)])
    assert ratio[1:] == pytest.approx(np.ones(3), abs=0.2)
    # the slowest direction is claimed worse than it is: a short autoregression knows little of slow noise
    assert 0.25 < ratio[0] < 1.1
    assert 0.65 * 4 < T2 < 1.1 * 4


class TestExpectation:
    @pytest.fixture
    def built(self, rig: dict[str, Any]) -> tuple[Expectation, Regression, Tuning]:
        loop = Loop.from_dict(rig)
        pipeline = Pipeline.of(loop)
        recording, _ = simulate(loop, reference("profile", 40.0, 100.0), seed=1)
        g = pipeline.regression(recording.r, recording.u, recording.y, recording.restart)
        tuning = fit_tuning(pipeline, [g]).tuning
        return Expectation(pipeline, tuning, NOISE, reference_path(recording)), g, tuning

    def test_batch_is_where_least_squares_ends(self, built: tuple[Expectation, Regression, Tuning]) -> None:
        expectation, *_ = built
        pipeline, loop = expectation.pipeline, expectation.pipeline.loop
        estimates = []
        for seed in range(SEEDS):
            recording, _ = simulate(loop, expectation.reference.r, seed=seed)
            estimates.append(
                least_squares(pipeline.regression(recording.r, recording.u, recording.y, recording.restart))
            )
        error = np.std(estimates, axis=0, ddof=1) / np.sqrt(SEEDS)
        assert np.abs((np.mean(estimates, axis=0) - expectation.batch_estimate(loop.plant)) / error).max() < 3.5

    def test_healthy_keeps_what_the_model_leaves_unexplained(
        self, built: tuple[Expectation, Regression, Tuning]
    ) -> None:
        expectation, _, tuning = built
        plant = expectation.pipeline.loop.plant
        model = expectation.batch_estimate(plant)
        path = expectation.mean_path(model, plant)
        assert expectation.healthy_path(plant, model) == pytest.approx(path + (tuning.theta - model), rel=1e-12)

    def test_a_shorter_look_is_the_beginning(self, built: tuple[Expectation, Regression, Tuning]) -> None:
        expectation, _, tuning = built
        plant = expectation.pipeline.loop.plant
        ill = plant.with_ratios({"C_ie": 1.2})
        whole = expectation.mean_path(tuning.theta, plant, ill, 1000)
        part = expectation.truncate(15.0).mean_path(tuning.theta, plant, ill, 1000)
        assert np.array_equal(part, whole[:150])


def test_course_puts_gaps_back(rig: dict[str, Any]) -> None:
    r = reference("multisine", 10.0, 100.0)
    kept = np.delete(np.arange(1000), np.r_[100, 300:350])
    recording = clean(kept / 100.0, r[kept], r[kept], r[kept], sample_rate=100.0)
    back = reference_path(recording)
    assert np.array_equal(back.recorded_index, kept)
    assert np.array_equal(back.r[kept], r[kept])
    assert len(back.r) == 1000
    assert back.r[100] == pytest.approx((r[99] + r[101]) / 2.0)
    assert back.restart.sum() == 3


def test_solve_scaled_survives_units() -> None:
    rng = np.random.default_rng(0)
    X = rng.standard_normal((50, 4)) * [1.0, 1e5, 1e-9, 1e3]
    theta = np.array([1.0, 1e-5, 1e9, 1e-3])
    assert solve_scaled(X.T @ X, X.T @ X @ theta) == pytest.approx(theta, rel=1e-9)
