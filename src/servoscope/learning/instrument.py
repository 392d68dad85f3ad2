"""Whether noise in y biases the coefficients of a polynomial plant, and the instrument that takes the bias out."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from servoscope.baseline.plant_fit import can_simulate
from servoscope.core.arrays import FloatArray
from servoscope.core.messages import Message, message
from servoscope.estimation.filter_bank import FilterBank
from servoscope.estimation.instrument import Source, unbroken
from servoscope.estimation.pipeline import Pipeline
from servoscope.fit.instrumental_fit import (
    MAX_RELATIVE_STD,
    InstrumentalFit,
    fit_with_instrument,
    has_feedback,
)
from servoscope.fit.tuning import TuningFit
from servoscope.models.loop import Loop
from servoscope.models.lti import autocovariances, solve_scaled
from servoscope.signals import Recording

INSTRUMENT_ESTIMATORS = (
    "akf",
    "iv-akf",
)  # estimators in whose place, or as which, one with a learned instrument is set
MIN_BIAS_STDS = 3.0  # standard deviations between both estimates, above which least squares are called biased
# share of the difference that noise in y has to explain, for other causes move both estimates too
MIN_NOISE_SHARE = 0.3
DIFFERENCES = 6  # order of the differences of y, in which motion no longer shows
MIN_RELATIVE_BIAS = 0.02  # share of a coefficient by which they are, below which nothing is changed


def learns_instrument(loop: Loop) -> bool:
    """Return whether an instrument is learned for a loop: noise in y is no part of what is expected of it.

    Where there is friction, what differs is rather its sign, which r or y tell late.
    """
    monitor = loop.monitor
    suits = monitor.estimator in INSTRUMENT_ESTIMATORS and monitor.structure == "svf" and monitor.two_stage == "none"
    linear = loop.plant.parameters_are_coefficients and loop.plant.affine
    return suits and linear and not can_simulate(loop)


def source_of(recordings: Sequence[Recording]) -> Source:
    """Return where the instrument comes from: from u where it is the command itself, so that there is no other r."""
    return "input" if all(np.array_equal(rec.r, rec.u) for rec in recordings) else "reference"


def learn_instrument(
    pipeline: Pipeline, recordings: Sequence[Recording], fit: TuningFit
) -> tuple[InstrumentalFit | None, list[Message]]:
    """Return the fit that takes the place of least squares, None where they may stay, and warnings."""
    source = source_of(recordings)
    estimate = fit_with_instrument(pipeline, recordings, source, fit.tuning.theta)
    if estimate is None:
        return None, []
    if not _is_biased(estimate, fit, recordings):
        return None, []
    if source == "input" and has_feedback(estimate.pipeline, recordings, estimate.fit.tuning.theta):
        return None, [message("learning.instrument_feedback")]
    if not estimate.settled:
        return None, [message("learning.instrument_unsettled")]
    if not estimate.trusted:
        values = {"coefficient": estimate.weakest, "deviation": estimate.deviation, "limit": MAX_RELATIVE_STD}
        return None, [message("learning.instrument_refused", **values)]
    return estimate, []


def _is_biased(instrumental: InstrumentalFit, fit: TuningFit, recordings: Sequence[Recording]) -> bool:
    """Return whether noise in y makes least squares miss a coefficient of a power of s, by enough to matter.

    Both estimates have to differ by more than chance, and the noise has to be there: what friction and elasticity leave
    unexplained also moves them apart, and neither is then the right one.
    """
    powers = slice(0, len(instrumental.pipeline.loop.plant.powers))
    theta, std = instrumental.fit.tuning.theta[powers], np.sqrt(np.diag(instrumental.fit.covariance))[powers]
    apart = np.abs(fit.tuning.theta[powers] - theta)
    of_noise = np.abs(_attenuation(instrumental, recordings)[powers])
    significant = (apart > MIN_BIAS_STDS * std) & (apart > MIN_RELATIVE_BIAS * np.abs(theta))
    return bool(np.any(significant & (of_noise > MIN_NOISE_SHARE * apart)))


def _attenuation(instrumental: InstrumentalFit, recordings: Sequence[Recording]) -> FloatArray:
    """Return what white noise of y, as loud as its roughness says, takes from least squares, shape (n,).

    Least squares are off by -R_phi^-1 S theta, S the covariance of the noise in phi (errors in variables; Soderstrom,
    2007). Motion is smooth, so that differences of a high order leave little but noise.
    """
    phi = np.vstack([g.phi[g.ok] for g in instrumental.regressions])
    rough = np.concatenate([np.diff(part.y, DIFFERENCES) for rec in recordings for part in unbroken(rec)])
    variance = float(np.mean(rough**2)) / math.comb(2 * DIFFERENCES, DIFFERENCES) if len(rough) else 0.0
    S = variance * noise_moments(instrumental.pipeline.bank)
    return solve_scaled(phi.T @ phi / len(phi), S @ instrumental.fit.tuning.theta)


def noise_moments(bank: FilterBank) -> FloatArray:
    """Return the covariance of phi under white noise of variance one in y, shape (n, n)."""
    of_y = bank.linear.input(np.eye(2, 1, -1)).output(np.eye(bank.n, 1 + bank.n, 1))
    return np.asarray(autocovariances(of_y, 0)[0])
