"""The paper's measures, mended where they need it, and those that its words ask for: pure functions."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import ComplexArray, FloatArray
from servoscope.research.paper.sensitivity import angle_between

MIN_DURATION_S = 1.0  # s


def cv_theta(theta: FloatArray) -> float:
    """Return CV_theta = sqrt(mean of sigma/|mu|) over time; the paper prints mu without its magnitude."""
    return float(np.sqrt((theta.std(axis=0) / np.abs(theta.mean(axis=0))).mean()))


def cv_H(H: ComplexArray) -> float:
    """Return CV_H, likewise over the real and the imaginary part of H (K,)."""
    return cv_theta(np.column_stack([H.real, H.imag]))


def rise_time(
    t: FloatArray, H: ComplexArray, at_s: float, before: complex, after: complex, share: float = 0.5
) -> float:
    """Return how long after `at_s` the iFRF gets `share` of the way from `before` to `after` [s]; NaN: never.

    It has to stay there for a second: a noisy estimate crosses any level at once.
    """
    way = np.real((H - before) * np.conj(after - before)) / abs(after - before) ** 2
    last = np.searchsorted(t, t + MIN_DURATION_S + 1e-9)  # the sample after that second
    misses = np.concatenate([[0], np.cumsum(way < share)])
    reached = np.flatnonzero((t > at_s) & (misses[last] == misses[:-1]))
    return float(t[reached[0]] - at_s) if reached.size else float("nan")


def separation(a: ComplexArray, b: ComplexArray) -> float:
    """Return the distance between the means of two clouds in units of their pooled scatter (Mahalanobis)."""
    both = [np.column_stack([x.real, x.imag]) for x in (a, b)]
    difference = both[0].mean(axis=0) - both[1].mean(axis=0)
    pooled = sum(np.cov(x, rowvar=False) for x in both) / 2.0
    return float(np.sqrt(difference @ np.linalg.solve(pooled + 1e-18 * np.eye(2), difference)))


def compare_clouds(first: list[ComplexArray], second: list[ComplexArray], origin: complex) -> tuple[float, float]:
    """Compare two families of residual clouds, one cloud per size of a fault.

    Returns the median angle [degrees] between their directions from the healthy residual, and the smallest separation.
    """
    angles = [float(angle_between(a.mean() - origin, b.mean() - origin)) for a in first for b in second]
    return float(np.median(angles)), min(separation(a, b) for a in first for b in second)


def ratio_at_equal_rise(
    rise_a: npt.ArrayLike, cv_a: npt.ArrayLike, rise_b: npt.ArrayLike, cv_b: npt.ArrayLike
) -> float:
    """Return CV_a/CV_b, the geometric mean over the rise times that both curves cover; NaN if they share none."""
    x, y = ([np.asarray(v, dtype=np.float64) for v in pair] for pair in ((rise_a, cv_a), (rise_b, cv_b)))
    kept = [[v[np.isfinite(pair[0]) & np.isfinite(pair[1])] for v in pair] for pair in (x, y)]
    if any(len(pair[0]) < 2 for pair in kept):
        return float("nan")
    low, high = max(pair[0].min() for pair in kept), min(pair[0].max() for pair in kept)
    if low >= high:
        return float("nan")
    grid = np.exp(np.linspace(np.log(low), np.log(high), 21))
    logs = []
    for times, values in kept:
        order = np.argsort(times)
        logs.append(np.interp(np.log(grid), np.log(times[order]), np.log(values[order])))
    return float(np.exp(np.mean(logs[0] - logs[1])))
