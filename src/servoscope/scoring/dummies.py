"""Detectors to put beside the real one: always, never, and the textbook's CUSUM; all with one interface."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray

Detector = Callable[[FloatArray], BoolArray]
"""Standardised residuals (N,), standard normal and independent while healthy -> whether there is an alarm, (N,)."""


def always(residuals: FloatArray) -> BoolArray:
    """Raise the alarm at every sample."""
    return np.ones(residuals.shape, dtype=np.bool_)


def never(residuals: FloatArray) -> BoolArray:
    """Raise no alarm at all."""
    return np.zeros(residuals.shape, dtype=np.bool_)


def cusum(residuals: FloatArray, k: float = 0.5, h: float = 5.0) -> BoolArray:
    """Watch the mean with the two-sided cumulative sum, starting anew after each alarm.

    ::

        C+(t) = max(0, C+(t-1) + x(t) - k)
        C-(t) = max(0, C-(t-1) - x(t) - k)        alarm where one of them exceeds h; then both are 0

    Page (1954); Montgomery, Introduction to Statistical Quality Control, chapter 9, for k = 0.5 and h = 5: tuned for a
    shift by one standard deviation, a false alarm every 465 samples on average.

    Parameters
    ----------
    residuals
        Standardised, shape (N,).
    k, h
        Reference value and decision interval, in standard deviations.
    """
    from servoscope.scoring.kernels import run_cusum

    alarm = np.zeros(len(residuals), dtype=np.bool_)
    run_cusum(np.ascontiguousarray(residuals, dtype=np.float64), float(k), float(h), alarm)
    return alarm


DUMMIES: Mapping[str, Detector] = {"always": always, "never": never, "CUSUM": cusum}
