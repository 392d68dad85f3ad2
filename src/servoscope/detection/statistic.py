"""The statistic T^2, its power, and the delays of the alarm that it raises."""

from __future__ import annotations

import functools

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.estimation.moments import whiten_each

POWER = 0.9  # probability with which a promised change is seen


def apply_alarm_delays(exceeded: BoolArray, on: int, off: int) -> BoolArray:
    """Return an alarm with delays: raised when it has lasted for `on` evaluations, kept for `off` after it has gone."""
    if not exceeded.any():
        return exceeded
    k, raised = np.arange(len(exceeded)), consecutive_exceedances(exceeded) > on
    last = np.where(raised, k, -off - 1)
    np.maximum.accumulate(last, out=last)  # in place: a long recording has millions of evaluations
    return np.asarray(np.subtract(k, last, out=last) <= off)


def consecutive_exceedances(exceeded: BoolArray, before: int = 0) -> IntArray:
    """Return for how many evaluations the limit has been exceeded without interruption, shape (K,).

    `before`: the same for the evaluation before the first one.
    """
    k = np.arange(len(exceeded))
    below = np.where(exceeded, -1 - before, k)
    np.maximum.accumulate(below, out=below)  # last evaluation below the limit
    return np.asarray(np.subtract(k, below, out=below))


@functools.lru_cache(1024)  # it takes a search, and a baseline asks for its own each time that it is examined
def required_noncentrality(n: int, limit: float) -> float:
    """Return the noncentrality at which a chi-square with n degrees of freedom exceeds `limit` with `POWER`."""
    from scipy import special

    return float(special.chndtrinc(limit, n, 1.0 - POWER))


def whiten(covariance: FloatArray, deviation: FloatArray) -> FloatArray:
    """Return L^-1 d with L L' the covariance, row by row; units of very different sizes are evened out first.

    `covariance`: shape (K, n, n); `deviation`: shape (K, n) or (K, n, m).
    """
    columns = deviation if deviation.ndim == 3 else deviation[..., None]
    C, d = np.ascontiguousarray(covariance, dtype=np.float64), np.ascontiguousarray(columns, dtype=np.float64)
    white, n = np.empty(d.shape), C.shape[-1]
    if not whiten_each(C, d, np.empty((n, n)), white):
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
