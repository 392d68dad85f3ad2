"""What a fit leaves over: white or structured, repeating with the reference or noise."""

from __future__ import annotations

import math

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.estimation.reference_period import autocovariance_with_gaps, to_uniform_grid
from servoscope.learning.inspection.signals import InspectionModel
from servoscope.signals import Recording

LAGS = 20
MAX_WHITE_PROBABILITY = 0.01  # probability below which a residual is called structured


class Residual(InspectionModel):
    """The residual of the regression."""

    relative: float  # its standard deviation over that of the filtered u
    # p_value, white: ljung-Box-like test over 20 lags beyond the filters' memory; white if above 0.01. None: too
    # short.
    p_value: float | None
    white: bool | None
    correlation_s: float  # time over which residuals hang together [s]
    period_s: float | None  # period of the reference [s]; None if it does not repeat
    # repeating, repeating_std: share of the residual's variance that repeats with that period: what the model lacks,
    # not noise. Both None without a period.
    repeating: float | None
    repeating_std: float | None
    # share of u (rms) that the model leaves unexplained apart from noise, as far as this recording shows
    model_error: float


def effective_sample_size(rho: FloatArray, rows: int, memory: int) -> float:
    """Return the number of independent values among `rows` with autocorrelation `rho` (Bartlett)."""
    return rows / max(1.0 + 2.0 * float((rho[1 : memory + 1] ** 2).sum()), 1.0)


def analyse_residual(
    recording: Recording, v: FloatArray, eta: FloatArray, used: BoolArray, memory: int, period: int | None
) -> tuple[Residual, float, FloatArray]:
    """Test a residual for whiteness and for what repeats with the reference.

    `memory` is the number of samples over which the filters alone correlate residuals. Returns the result,
    the number of independent residuals, and the autocorrelation from lag 0 on.
    """
    x, there = to_uniform_grid(recording, v, used)
    covariance, pairs = autocovariance_with_gaps(x, there)
    variance = max(float(covariance[0]), np.finfo(np.float64).tiny)
    rho = covariance / variance
    # Few pairs make wild correlations; the biased estimate lets them fade.
    faded = rho * pairs / max(float(pairs[0]), 1.0)
    rows = int(used.sum())
    inflation = 1.0 + 2.0 * float((faded[1:memory] ** 2).sum())
    p_value = None
    lags = memory * np.arange(1, LAGS + 1)
    lags = lags[lags < rho.size // 2]
    lags = lags[pairs[lags] > 0.2 * rows]
    if lags.size >= 3:
        from scipy.stats import chi2

        Q = float((pairs[lags] * rho[lags] ** 2).sum()) / inflation
        p_value = float(chi2.sf(Q, lags.size))
    repeating = std = None
    if period is not None and period >= memory:
        multiples = np.arange(period, rho.size - period // 2, period)
        multiples = multiples[pairs[multiples] > 0.2 * rows] if multiples.size else multiples
        if multiples.size:
            weight = pairs[multiples]
            repeating = float((weight * rho[multiples]).sum() / weight.sum())
            std = math.sqrt(inflation / float(weight.sum()))
    relative = math.sqrt(variance / max(float(eta[used].var()), np.finfo(np.float64).tiny))
    far = float(np.median(np.abs(faded[memory : 3 * memory]))) if rho.size > 3 * memory else 0.0
    structured = max(repeating - 2.0 * (std or 0.0), 0.0) if repeating is not None else far
    if p_value is not None and p_value > MAX_WHITE_PROBABILITY and repeating is None:
        structured = 0.0
    reach = min(rho.size, 50 * memory)
    below = np.flatnonzero(np.abs(faded[:reach]) < 0.1)
    residual = Residual(
        relative=relative,
        p_value=p_value,
        white=None if p_value is None else p_value > MAX_WHITE_PROBABILITY,
        correlation_s=float(below[0] if below.size else reach) / recording.sample_rate,
        period_s=None if period is None else period / recording.sample_rate,
        repeating=repeating,
        repeating_std=std,
        model_error=relative * math.sqrt(min(structured, 1.0)),
    )
    return residual, effective_sample_size(faded, rows, reach), faded[:reach]
