"""Measured numbers with their 95 % intervals: shares and coverage; and selection among many p-values."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import BoolArray, FloatArray


class Measured(NamedTuple):
    """A number from finite data: the estimate, and the ends of its confidence interval."""

    value: float
    low: float
    high: float


def share(count: int, total: int, confidence: float = 0.95) -> Measured:
    """Return a share with Wilson's (1927) score interval, which keeps its promise near 0 and 1 too.

    Parameters
    ----------
    count, total
        How many of how many; the total is positive.
    confidence
        Of the interval.

    Raises
    ------
    ValueError
        If the count is not between 0 and the total, or the total is 0.
    """
    from scipy.stats import binomtest

    if total < 1:
        raise ValueError("a share of nothing: total must be positive")
    interval = binomtest(count, total).proportion_ci(confidence, method="wilson")
    return Measured(count / total, float(interval.low), float(interval.high))


def coverage(low: npt.ArrayLike, high: npt.ArrayLike, truth: npt.ArrayLike, confidence: float = 0.95) -> Measured:
    """Return how often intervals hold the truth, ends included, with Wilson's interval.

    Parameters
    ----------
    low, high, truth
        Ends of the intervals and true values, of one shape or broadcast to one.
    confidence
        Of the interval around the share, not of the intervals that are judged.
    """
    inside = (np.asarray(low) <= np.asarray(truth)) & (np.asarray(truth) <= np.asarray(high))
    return share(int(np.count_nonzero(inside)), inside.size, confidence)


def discoveries(p: FloatArray, rate: float = 0.05) -> BoolArray:
    """Select among many tests so that the expected share of false ones among the selected stays below `rate`.

    Benjamini and Hochberg (1995): with p_(i) the i-th smallest of M, all up to the largest i with
    p_(i) <= i rate / M. It holds for independent tests, and for positively dependent ones (Benjamini and Yekutieli,
    2001): the assets of a fleet.

    Parameters
    ----------
    p
        One p-value per test, shape (M,).
    rate
        False discovery rate that is accepted.

    Returns
    -------
    numpy.ndarray
        Which are selected, bool, shape (M,).
    """
    from scipy.stats import false_discovery_control

    return np.asarray(false_discovery_control(p, method="bh") <= rate)
