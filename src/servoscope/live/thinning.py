"""Residuals at a resolution that can be kept for years: one row per period, with the largest statistics of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from servoscope.diagnosis import Trace
from servoscope.plants import FloatArray

__all__ = ["Thinned", "gamma", "thin"]


@dataclass(frozen=True)
class Thinned:
    """What is remembered between two rows.

    Parameters
    ----------
    period
        Number of the period that is under way, of the asset's clock; None before the first evaluation.
    excess, level
        Largest T^2, over its limit, and largest value of the sequential test, since the last row.
    """

    period: int | None = None
    excess: float = 0.0
    level: float = 0.0


def thin(state: Thinned, trace: Trace, t: FloatArray, every_s: float) -> tuple[Thinned, list[dict[str, Any]]]:
    """Take the evaluations of a block, at the times `t` [UTC s], shape (K,); return the rows that are complete.

    A row is due at the first evaluation of a new period, and speaks for the time up to there.
    """
    if not t.size:
        return state, []
    periods = np.floor(t / every_s).astype(np.int64)
    excess = np.nan_to_num(np.where(trace.ready, trace.statistic / trace.threshold, 0.0))
    before = int(periods[0]) if state.period is None else state.period
    rows, first, peaks = [], 0, (state.excess, state.level)
    # the last evaluation may be one that begins a period: it counts once
    for k in dict.fromkeys([*np.flatnonzero(np.diff(periods, prepend=before)).tolist(), t.size - 1]):
        new = excess[first : k + 1], trace.level[first : k + 1]
        peaks = max(peaks[0], float(new[0].max(initial=0.0))), max(peaks[1], float(new[1].max(initial=0.0)))
        first = k + 1
        if periods[k] != (before if k == 0 else periods[k - 1]):
            rows.append({"t": float(t[k]), "statistic": peaks[0], "level": peaks[1], "residual": gamma(trace, k)})
            peaks = 0.0, 0.0
    return Thinned(int(periods[-1]), *peaks), rows


def gamma(trace: Trace, k: int) -> list[list[float | None]]:
    """Return the iFRF's residual at evaluation k, per frequency.

    Each is [frequency in Hz, real part, imaginary part, magnitude of the healthy iFRF]; None where it is unknown.
    """
    healthy = trace.ifrf_expected.H[k]
    numbers = [trace.ifrf.frequencies, *(f(trace.ifrf.H[k] - healthy) for f in (np.real, np.imag)), np.abs(healthy)]
    return [[x if math.isfinite(x) else None for x in row] for row in np.stack(numbers, axis=1).tolist()]
