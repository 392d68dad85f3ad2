"""From estimates to "since when": the statistic T^2, its threshold from a false-alarm budget, its power, the onset."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.estimation.noise_model import long_run_inflation
from servoscope.estimation.pipeline import Pipeline
from servoscope.signals import Recording

SECONDS_PER_YEAR = 365.25 * 86400.0
POWER = 0.9  # probability with which a promised change is seen
REACH = 40.0  # memories before an alarm in which its onset is looked for first
NEGLIGIBLE = 1e-9  # probability that it came earlier


def threshold(
    n: int, evaluation_rate: float, memory: float, false_alarms_per_year: float, dof: float, counted: float = 1.0
) -> float:
    """Return the limit of T^2 that a healthy loop crosses as often as the budget allows.

    theta_hat forgets within `memory`, so looks close together are one look; how close depends on the level: an
    Ornstein-Uhlenbeck process stays above a high level only for a time of the order of memory / level (Aldous, 1989,
    section D). Simulated healthy loops show level / (2 memory) looks per second. The noise's variance is itself
    estimated, so T^2 follows Hotelling's distribution rather than a chi-square.

    `evaluation_rate`: evaluations per second [Hz]; `memory`: of the estimator [s]; `dof`: effective number of
    independent values behind the noise's variance; `counted`: alarms that a rehearsal counted (see
    `threshold_calibration`), divided by those that this rule expects.
    """
    from scipy import special  # not scipy.stats: half a second to import

    dof = min(max(dof, n + 2.0), 1e9)
    rest = dof - n + 1.0
    limit = 10.0
    for _ in range(20):
        looks = counted * SECONDS_PER_YEAR * min(evaluation_rate, max(limit / (2.0 * memory), 1.0 / memory))
        tail = min(false_alarms_per_year / looks, 0.5)
        share = float(special.betaincinv(rest / 2.0, n / 2.0, tail))  # upper quantile of F(n, rest) through the beta's
        limit = dof * (1.0 - share) / share
    return limit


def apply_alarm_delays(exceeded: BoolArray, on: int, off: int) -> BoolArray:
    """Return an alarm with delays: raised when it has lasted for `on` evaluations, kept for `off` after it has gone."""
    if not exceeded.any():
        return exceeded
    k, raised = np.arange(len(exceeded)), consecutive_exceedances(exceeded) > on
    last = np.maximum.accumulate(np.where(raised, k, -off - 1))
    return np.asarray(k - last <= off)


def consecutive_exceedances(exceeded: BoolArray, before: int = 0) -> IntArray:
    """Return for how many evaluations the limit has been exceeded without interruption, shape (K,).

    `before`: the same for the evaluation before the first one.
    """
    k = np.arange(len(exceeded))
    below = np.maximum.accumulate(np.where(exceeded, -1 - before, k))  # last evaluation below the limit
    return np.asarray(k - below)


@functools.lru_cache(1024)  # it takes a search, and a baseline asks for its own each time that it is examined
def required_noncentrality(n: int, limit: float) -> float:
    """Return the noncentrality at which a chi-square with n degrees of freedom exceeds `limit` with `POWER`."""
    from scipy import special

    return float(special.chndtrinc(limit, n, 1.0 - POWER))


def whiten(covariance: FloatArray, deviation: FloatArray) -> FloatArray:
    """Return L^-1 d with L L' the covariance, row by row; units of very different sizes are evened out first.

    `covariance`: shape (K, n, n); `deviation`: shape (K, n) or (K, n, m).
    """
    from servoscope.estimation.moments import whiten_each  # late: loads numba

    columns = deviation if deviation.ndim == 3 else deviation[..., None]
    C, d = np.ascontiguousarray(covariance, dtype=np.float64), np.ascontiguousarray(columns, dtype=np.float64)
    white, n = np.empty(d.shape), C.shape[-1]
    if not whiten_each(C, d, np.empty(n), np.empty((n, n)), white):
        raise np.linalg.LinAlgError("a covariance is not positive definite")
    return white[..., 0] if deviation.ndim == 2 else white


def t2_statistic(theta: FloatArray, expected: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return ``T^2 = (theta - mu)' Cov^-1 (theta - mu)``, shape (K,)."""
    return _sum_of_squares(whiten(covariance, theta - expected))


def noncentrality(covariance: FloatArray, Psi: FloatArray, directions: FloatArray) -> FloatArray:
    """Return what a unit change along each direction would have added to T^2 by now.

    After a change Delta the mean of theta_hat has moved by (I - Psi) Delta, so the recording's own excitation, and
    not a promise made elsewhere, says what would have been seen.

    `covariance, Psi`: shape (K, n, n); `directions`: one change per row, shape (m, n); returns numpy.ndarray: shape
    (K, m).
    """
    moved = (np.eye(Psi.shape[-1]) - Psi) @ directions.T
    return _sum_of_squares(whiten(covariance, moved))


def _sum_of_squares(white: FloatArray) -> FloatArray:
    """Return the sums over the components of deviations (K, n) or (K, n, m), shape (K,) or (K, m)."""
    total = white[:, 0] ** 2
    for i in range(1, white.shape[1]):  # a few columns of many evaluations: NumPy's sum takes three times as long
        total += white[:, i] ** 2
    return np.asarray(total)


@dataclass(frozen=True)
class Onset:
    """Since when: the 95 % interval and the most likely time [s], and the sample of the latter."""

    low_s: float
    likely_s: float
    high_s: float
    sample: int


def estimate_onset(
    pipeline: Pipeline, recording: Recording, healthy: FloatArray, faulty: FloatArray, until: int, last: int
) -> Onset:
    """Find when the regression stopped following `healthy` and went towards `faulty`.

    Change point by least squares on the residual of the regression, the size of the change at its best for each time,
    with a flat prior over the samples before the alarm (Basseville and Nikiforov, 1993, section 2.6). While the filters
    settle, the share of the change that they have let through counts. The residual is coloured, and where friction or
    elasticity are not the model's it is no noise at all; so the likelihood is tempered by the long-run variance of the
    scores (Newey and West, 1987) instead of whitened, which would raise what the model misses above the change.

    `healthy, faulty`: coefficients before, and on the way of the change, shape (n,); `until`: sample of the alarm: the
    onset is not later; `last`: last sample that `faulty` speaks for.
    """
    reach = round(REACH * pipeline.memory * pipeline.stride)
    while True:
        begin = max(until - reach, 0) // pipeline.stride * pipeline.stride
        near = recording.rows(slice(begin, min(last, until + reach) + 1))
        likelihood = _log_likelihood(pipeline, near, healthy, faulty, until - begin)
        weight = np.exp(likelihood - likelihood.max())
        share = np.cumsum(weight) / weight.sum()
        likely = int(np.argmax(likelihood))
        if not begin or share[(until - begin) // 2] < NEGLIGIBLE:
            break
        reach *= 2  # the change may have come earlier
    low, high = (begin + int(k) for k in np.searchsorted(share, [0.025, 0.975]))
    likely += begin
    # what the filters leave of a step is known only about, so neither end is surer than half their settling time
    blur = pipeline.bank.wait // 2
    low, high = max(min(low, likely - blur), 0), min(max(high, likely + blur), until)
    t = recording.t
    return Onset(float(t[low]), float(t[likely]), float(t[high]), likely)


def _log_likelihood(
    pipeline: Pipeline, recording: Recording, healthy: FloatArray, faulty: FloatArray, until: int
) -> FloatArray:
    """Return the logarithm of the likelihood of a change at each of the samples up to `until`, but for a constant."""
    # u itself changes at once, where u_a of stage 1 has to learn the change first
    single = replace(pipeline, stage_one=None)
    g = single.regression(recording.r, recording.u, recording.y, recording.restart)
    used = np.flatnonzero(g.ok)
    phi, ramp = g.phi[used], _onset_of_filters(pipeline)
    v, changed = g.eta[used] - phi @ healthy, phi @ (faulty - healthy)
    score = _sums_after(v * changed, ramp)
    information = np.maximum(_sums_after(changed**2, ramp**2), np.finfo(np.float64).tiny)
    size = np.maximum(score, 0.0) / information
    # a change between two updates shows at the later one
    at_update = np.minimum(np.searchsorted(used, np.arange(until + 1)), len(used) - 1)
    gained = size * score
    best = at_update[int(np.argmax(gained[at_update]))]
    e = v - size[best] * changed * np.concatenate([np.zeros(best), ramp, np.ones(len(v))])[: len(v)]
    variance = float(e @ e) / len(e) * long_run_inflation(e * changed, len(ramp))
    return np.asarray(gained[at_update] / (2.0 * variance))


def _onset_of_filters(pipeline: Pipeline) -> FloatArray:
    """Return how much of a sudden change the filters have let through, update by update: 0 to 1, shape (W,)."""
    bank = pipeline.bank
    w = np.zeros((bank.wait + 1, bank.system.B.shape[1]))
    w[1:, 1] = 1.0  # u steps
    response = bank.system.simulate(w)[1:, 0] / bank.gain
    share = response[pipeline.stride - 1 :: pipeline.stride] / max(float(response[-1]), 1e-12)
    return np.asarray(np.clip(share, 0.0, 1.0))


def _sums_after(x: FloatArray, ramp: FloatArray) -> FloatArray:
    """Return for each update i the sum of x(k) ramp(k - i) over k >= i, shape (N,); behind its end the ramp is 1."""
    N, W = len(x), len(ramp)
    after = np.concatenate([np.cumsum(x[::-1])[::-1], np.zeros(W + 1)])[W : W + N]
    return np.asarray(np.correlate(np.concatenate([x, np.zeros(W - 1)]), ramp, "valid") + after)
