"""Counters and angles that wrap: the range in which they do, and the same without jumps."""

from __future__ import annotations

import math

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.signals.readers.table import Table

# ranges in which counters and angles wrap: bits of a word, degrees, radians, turns, lines of encoders
RANGES = (*(2.0**bits for bits in (8, 10, 12, 14, 16, 17, 20, 23, 24, 32)), 360.0, 3600.0, 36000.0, 2.0 * math.pi, 1.0)
# share of the range from which the first value is one below zero, as a word with a sign is logged
SIGNED_WORD_SHARE = 0.75
MIN_RANGE_SHARE = 0.9  # share of the range that the values span
MIN_STEP_RATIO = 20.0  # times shorter than the range are all steps of the column unwrapped
MAX_JUMP_SHARE = 0.1  # share of the steps
ROUNDING_TOLERANCE = 1e-3  # of the range


class Unwrapper:
    """Unwraps a column piece by piece; a first value in the last quarter of the range counts as negative."""

    def __init__(self, period: float) -> None:
        self._period, self._last = period, math.nan  # the last value without jumps
        self._piece: Table | None = None
        self._found = np.zeros(0)

    def unwrap(self, table: Table, x: FloatArray) -> FloatArray:
        """Return a piece of the column, shape (N,), without jumps; several signals may ask for the same piece."""
        if table is self._piece:
            return self._found
        self._piece = table
        known = np.flatnonzero(np.isfinite(x))
        unwrapped = x.copy()
        if known.size:
            if math.isnan(self._last):
                self._last = float(x[known[0]]) - self._period * (x[known[0]] > SIGNED_WORD_SHARE * self._period)
            unwrapped[known] = np.unwrap(np.append(self._last, x[known]), period=self._period)[1:]
            self._last = float(unwrapped[known[-1]])
        self._found = unwrapped
        return unwrapped


def find_wrap(x: FloatArray) -> float | None:
    """Return the range in which a column, shape (N,), wraps; None if it does not seem to.

    It does where its values fill one of the known ranges, few steps are longer than half of it, and all steps of the
    same column unwrapped are much shorter.
    """
    x = x[np.isfinite(x)]
    if x.size < 3:
        return None
    steps, span = np.diff(x), float(np.ptp(x))
    for period in sorted(RANGES):
        if not MIN_RANGE_SHARE * period < span <= period * (1.0 + ROUNDING_TOLERANCE):
            continue
        turns = np.round(steps / period)
        left = np.abs(steps - period * turns)
        jumps = np.count_nonzero(turns)
        moves = float(left[turns == 0.0].max(initial=0.0)) > 0.0  # a switch does not move between its jumps
        if 0 < jumps <= MAX_JUMP_SHARE * steps.size and moves and MIN_STEP_RATIO * float(left.max()) < period:
            return float(period)
    return None
