"""From estimates to "since when": the statistic T^2, its threshold from a false-alarm budget, its power, the onset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servoscope.pipeline import Estimates, Pipeline, Tuning
from servoscope.plants import FloatArray
from servoscope.recording import Recording

SECONDS_PER_YEAR = 365.25 * 86400.0
TEMPER = 0.5  # power of the onset's likelihood: while the filters settle, neither model is true
POWER = 0.9  # probability with which a promised change is seen


def threshold(n: int, evaluation_rate: float, memory: float, false_alarms_per_year: float, dof: float) -> float:
    """Return the limit of T^2 that a healthy loop crosses as often as the budget allows.

    theta_hat forgets within `memory`, so looks close together are one look; how close depends on the level: an
    Ornstein-Uhlenbeck process stays above a high level only for a time of the order of memory / level (Aldous, 1989,
    section D). Simulated healthy loops show level / (2 memory) looks per second. The noise's variance is itself
    estimated, so T^2 follows Hotelling's distribution rather than a chi-square.

    Parameters
    ----------
    n
        Number of coefficients.
    evaluation_rate
        Evaluations per second [Hz].
    memory
        Of the estimator [s].
    false_alarms_per_year
        Budget.
    dof
        Effective number of independent values behind the noise's variance.
    """
    from scipy import stats

    dof = max(dof, n + 2.0)
    limit = 10.0
    for _ in range(20):
        looks = SECONDS_PER_YEAR * min(evaluation_rate, max(limit / (2.0 * memory), 1.0 / memory))
        tail = min(false_alarms_per_year / looks, 0.5)
        limit = float(n * dof / (dof - n + 1.0) * stats.f.isf(tail, n, dof - n + 1.0))
    return limit


def required_noncentrality(n: int, limit: float) -> float:
    """Return the noncentrality at which a chi-square with n degrees of freedom exceeds `limit` with `POWER`."""
    from scipy import optimize, stats

    def miss(noncentrality: float) -> float:
        return float(stats.ncx2.sf(limit, n, noncentrality)) - POWER

    return float(optimize.brentq(miss, 1e-6, 10.0 * limit + 100.0))


def whiten(covariance: FloatArray, deviation: FloatArray) -> FloatArray:
    """Return L^-1 d with L L' the covariance, row by row; units of very different sizes are evened out first.

    Parameters
    ----------
    covariance
        Shape (K, n, n).
    deviation
        Shape (K, n) or (K, n, m).
    """
    size = np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), np.finfo(float).tiny))
    n = covariance.shape[-1]
    correlation = covariance / (size[..., :, None] * size[..., None, :]) + 1e-12 * np.eye(n)
    columns = deviation[..., None] if deviation.ndim == covariance.ndim - 1 else deviation
    white = np.linalg.solve(np.linalg.cholesky(correlation), columns / size[..., :, None])
    return np.asarray(white[..., 0] if deviation.ndim == covariance.ndim - 1 else white)


def statistic(theta: FloatArray, expected: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return ``T^2 = (theta - mu)' Cov^-1 (theta - mu)``, shape (K,)."""
    return np.asarray((whiten(covariance, theta - expected) ** 2).sum(axis=-1))


def noncentrality(covariance: FloatArray, Psi: FloatArray, directions: FloatArray) -> FloatArray:
    """Return what a unit change along each direction would have added to T^2 by now.

    After a change Delta the mean of theta_hat has moved by (I - Psi) Delta, so the recording's own excitation, and
    not a promise made elsewhere, says what would have been seen.

    Parameters
    ----------
    covariance, Psi
        Shape (K, n, n).
    directions
        One change per row, shape (m, n).

    Returns
    -------
    numpy.ndarray
        Shape (K, m).
    """
    moved = (np.eye(Psi.shape[-1]) - Psi) @ directions.T
    return np.asarray((whiten(covariance, moved) ** 2).sum(axis=-2))


@dataclass(frozen=True)
class Onset:
    """Since when: the 95 % interval and the most likely time [s], and the sample of the latter."""

    low_s: float
    likely_s: float
    high_s: float
    sample: int


def onset(
    pipeline: Pipeline,
    tuning: Tuning,
    recording: Recording,
    estimates: Estimates,
    healthy: FloatArray,
    faulty: FloatArray,
    until: int,
    last: int,
) -> Onset:
    """Find when the regression stopped following `healthy` and began to follow `faulty`.

    Change point by maximum likelihood on the residual whitened by the noise's own autoregression, with a flat prior
    over the samples before the alarm (Basseville and Nikiforov, 1993, section 2.6).

    Parameters
    ----------
    healthy, faulty
        Coefficients before and after, shape (n,).
    until
        Sample of the alarm: the onset is not later.
    last
        Last sample that `faulty` speaks for.
    """
    g = pipeline.regression(recording.r, recording.u, recording.y, recording.restart)
    used = np.flatnonzero(g.ok[: last + 1])
    gain = np.zeros(last + 1)
    white = [_whitened((g.eta - g.phi @ theta)[used], tuning.noise_a) for theta in (healthy, faulty)]
    innovation = tuning.innovation * max(1.0, float(estimates.power[-1]))
    gain[used] = (white[0] ** 2 - white[1] ** 2) / (2.0 * innovation)
    log_likelihood = np.cumsum(gain[::-1])[::-1][: until + 1]  # of a change at each sample, up to a constant
    weight = np.exp(TEMPER * (log_likelihood - log_likelihood.max()))
    share = np.cumsum(weight) / weight.sum()
    likely = int(np.argmax(log_likelihood))
    low, high = np.searchsorted(share, [0.025, 0.975])
    # the filters delay and blur a step: it may have come up to their settling time before it shows
    blur = pipeline.bank.wait / recording.sample_rate
    t = recording.t
    return Onset(
        max(float(t[min(low, until)]) - blur, float(t[0])),
        float(t[likely]),
        min(float(t[min(high, until)]) + blur / 2.0, float(t[until])),
        likely,
    )


def _whitened(v: FloatArray, a: FloatArray) -> FloatArray:
    white = v.copy()
    for lag, weight in enumerate(a, start=1):
        white[lag:] -= weight * v[:-lag]
    return white
