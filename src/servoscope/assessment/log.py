"""The rows of a log that facts are measured on: valid ones, without rest, and the longest stretch on an even grid."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from servoscope.assessment.indices import Oscillation, find_oscillation
from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.core.errors import RecordingError
from servoscope.signals.quantisation import find_quantum
from servoscope.signals.samples import Samples

MAX_FILLED_GAP = 3  # samples that are interpolated; at a longer gap the log is cut
MAX_ROWS = 200_000  # of the even stretch; of a longer one, means of neighbours
REST_BLOCKS, MIN_REST_BLOCKS = 200, 20  # of a log, and how many in a row are rest
MAX_REST_RANGE = 0.02  # of the range of a signal in the log


@dataclass(frozen=True, eq=False)
class Signals:
    """Columns of a log."""

    t: FloatArray  # [s]
    r: FloatArray | None  # None: unknown
    u: FloatArray
    y: FloatArray

    @cached_property
    def step(self) -> float:
        """The sample period [s]."""
        return float(self.t[-1] - self.t[0]) / max(self.t.size - 1, 1)

    @cached_property
    def e(self) -> FloatArray:
        """The control error; of an unknown reference, the mean of y is taken."""
        return (float(self.y.mean()) if self.r is None else self.r) - self.y

    @cached_property
    def cycle(self) -> Oscillation | None:
        """The regular oscillation of the error."""
        return find_oscillation(self.e)

    @cached_property
    def quantum(self) -> dict[str, float | None]:
        """The step of the grid of y and of u, None where there is none."""
        return {"y": find_quantum(self.y), "u": find_quantum(self.u)}

    def rows(self, chosen: BoolArray | slice) -> Signals:
        """Return some of the rows."""
        return Signals(self.t[chosen], None if self.r is None else self.r[chosen], self.u[chosen], self.y[chosen])


@dataclass(frozen=True, eq=False)
class LogForms:
    """One log in the three forms that facts need."""

    recorded: Signals  # all valid rows as they were recorded
    rest: BoolArray  # of the recorded rows, those in which nothing moves
    moving: Signals  # the others
    even: Signals  # of the moving rows the longest stretch without a long gap, on an even grid
    missing: float  # share of the rows without a value

    @classmethod
    def from_samples(cls, samples: Samples, name: str) -> LogForms:
        """Return the log of some samples. Raises RecordingError if they hold no values, or no time."""
        t, r, u, y = (np.asarray(x, dtype=np.float64) for x in (samples.t, samples.r, samples.u, samples.y))
        known = not (np.array_equal(r, u, equal_nan=True) or np.isnan(r).all())
        valid = np.isfinite(t + u + y + (r if known else 0.0))
        if valid.sum() < 2:
            raise RecordingError(f"{name}: u and y hold no numbers in the same rows, choose other columns")
        recorded = Signals(t, r if known else None, u, y).rows(valid)
        if not (np.diff(recorded.t) > 0.0).any():
            raise RecordingError(f"{name}: the time does not advance, choose another time column")
        resting = find_rest(recorded)
        runs = np.cumsum(samples.restart)[valid] + np.cumsum(np.diff(resting, prepend=False))
        moving = recorded.rows(~resting)
        return cls(recorded, resting, moving, form_even(moving, runs[~resting]), 1.0 - float(valid.mean()))


def find_rest(log: Signals) -> BoolArray:
    """Return the rows, shape (N,), of long stretches in which r, u and y all keep to a small part of their range."""
    size = max(log.t.size // REST_BLOCKS, 1)
    starts = np.arange(0, log.t.size, size)
    if starts.size < MIN_REST_BLOCKS or not (np.ptp(log.u) > 0.0 and np.ptp(log.y) > 0.0):
        return np.zeros(log.t.size, np.bool_)  # what never changes does not rest
    still = np.ones(starts.size - MIN_REST_BLOCKS + 1, np.bool_)
    for x in (log.u, log.y) if log.r is None else (log.r, log.u, log.y):
        tops = (np.maximum.reduceat(sign * x, starts) for sign in (1.0, -1.0))
        span = sum(sliding_window_view(top, MIN_REST_BLOCKS).max(axis=1) for top in tops)
        still &= span <= MAX_REST_RANGE * np.ptp(x)
    blocks = np.convolve(still, np.ones(MIN_REST_BLOCKS)) > 0.0
    return np.asarray(np.repeat(blocks, size)[: log.t.size])


def form_even(log: Signals, runs: IntArray) -> Signals:
    """Return the longest stretch without a long gap on an even grid; runs: a number per row, of its stretch."""
    steps = np.diff(log.t)
    if not (steps > 0.0).any():
        return log
    period = float(np.median(steps[steps > 0.0]))
    # a row may repeat the time of the one before it, as clocks that are rounded write it
    breaks = np.flatnonzero((steps > (MAX_FILLED_GAP + 1.5) * period) | (steps < 0.0) | (np.diff(runs) != 0)) + 1
    first, stop = max(itertools.pairwise([0, *breaks.tolist(), log.t.size]), key=lambda edges: edges[1] - edges[0])
    part = log.rows(slice(first, stop))
    even = np.arange(part.t[0], part.t[-1] + 0.5 * period, period)
    factor = -(-even.size // MAX_ROWS)
    r = part.y if part.r is None else part.r
    t, r, u, y = (thin(np.interp(even, part.t, x), factor) for x in (part.t, r, part.u, part.y))
    return Signals(t, None if part.r is None else r, u, y)


def thin(x: FloatArray, factor: int) -> FloatArray:
    """Return means of `factor` neighbours each."""
    return x if factor == 1 else np.asarray(x[: x.size // factor * factor].reshape(-1, factor).mean(axis=1))
