"""What runs over each recording of one baseline: the recursion, its sequential test, and the healthy expectation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.expectation import NO_REFERENCE, Expectation, MeanPropagator
from servoscope.core import outofcore
from servoscope.detection.cusum_design import build_cusum_constants, sure_level, worst_case_hypotheses
from servoscope.estimation.kernel.cusum import CusumConstants
from servoscope.estimation.pipeline import EstimationRunner, Pipeline, RegressionRunner, Tuning
from servoscope.signals import Recording

MIN_INSTRUMENT_EIGENVALUE = 0.05  # of 1; below, the recursion follows too slowly, and below 0 it runs away


class BaselineRun(NamedTuple):
    """What runs over each recording of one baseline, at the first sample: go on with `again` of each."""

    estimates: EstimationRunner  # with the sequential test as the baseline has it
    mean: MeanPropagator | None  # None where the loop cannot be simulated
    # of the test's level, up to which the same test with limits fitted to whatever reference raises no alarm either
    sure_level: float


def baseline_run(baseline: Baseline) -> BaselineRun:
    """Return what runs over each recording; computed once, for a service examines thousands of windows an hour."""
    return baseline.remember("baseline_run", _make_run)


def _make_run(baseline: Baseline) -> BaselineRun:
    pipeline, tuning, mean = baseline.pipeline(), baseline.tuning, None
    if baseline.healthy.noise is not None:
        expectation = Expectation(pipeline, tuning, baseline.healthy.noise, NO_REFERENCE)
        mean = expectation.propagator(np.array(baseline.healthy.theta), baseline.plant)
    estimates = EstimationRunner(pipeline, tuning, cusum_constants(baseline, pipeline))
    budget = baseline.thresholds.calibration.sequential_budget(baseline.loop)
    return BaselineRun(estimates, mean, sure_level(baseline.thresholds.hypotheses, budget))


def cusum_constants(
    baseline: Baseline, pipeline: Pipeline, expectation: Expectation | None = None, growth: float = 1.0
) -> CusumConstants | None:
    """Return the sequential test beside a pipeline's recursion; None where the baseline has none.

    `expectation` is that of a recording, to whose reference the limits are then fitted, instead of that of the
    baseline; `growth` is that of the noise's variance.
    """
    if baseline.healthy.loudest is None or not baseline.thresholds.hypotheses:
        return None
    noise, plant, hypotheses = (
        baseline.healthy.loudest.times(np.sqrt(growth)),
        baseline.plant,
        baseline.thresholds.hypotheses,
    )
    if expectation is not None:
        covariance = np.array(baseline.healthy.covariance)
        hypotheses = worst_case_hypotheses(expectation, plant, baseline.healthy.loudest, covariance, hypotheses)
    budget = baseline.thresholds.calibration.sequential_budget(baseline.loop)
    return build_cusum_constants(pipeline, plant, noise, np.array(baseline.recursion.scale), hypotheses, budget)


def has_failed_instrument(pipeline: Pipeline, tuning: Tuning, recording: Recording) -> bool:
    """Return whether the instrument of the nominal loop tells nothing of this recording's motion, or the contrary.

    The mean of theta moves by -E[z z']^-1 E[z phi'] theta/N: its eigenvalues tell where it goes. Coefficients that an
    instrument has been learned for are not those of the AKF, which therefore cannot take over there.
    """
    if not pipeline.bank.has_instrument:
        return False
    runner, scale = RegressionRunner(pipeline), tuning.scale
    own = shared = np.zeros((len(scale), len(scale)))
    for rows in outofcore.iter_chunks(0, recording.samples):
        part = recording.rows(rows)
        g = runner.advance(part.r, part.u, part.y, part.restart)
        z, phi = g.z[g.ok] / scale, g.phi[g.ok] / scale
        own, shared = own + z.T @ z, shared + z.T @ phi
    if not own.any():
        return False
    return bool(np.linalg.eigvals(np.linalg.lstsq(own, shared, rcond=None)[0]).real.min() < MIN_INSTRUMENT_EIGENVALUE)
