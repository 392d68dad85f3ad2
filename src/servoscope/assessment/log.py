"""The rows of a log that facts are measured on: valid ones, without rest, and the longest stretch on an even grid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from servoscope.assessment.indices import Oscillation, find_oscillation
from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.core.errors import RecordingError
from servoscope.signals.samples import Samples

MAX_FILLED_GAP = 3  # samples that are interpolated; at a longer gap the log is cut
MAX_ROWS = 200_000  # of the even stretch; of a longer one, means of neighbours
REST_BLOCKS = 200  # of a log, in which rest is looked for
MAX_REST_RANGE = 0.02  # of the range of a signal in the log
MIN_REGULARITY = 1.0  # of an oscillation, after Thornhill et al.
MIN_REST_SHARE = 0.1  # of the log, in one stretch


@dataclass(frozen=True, eq=False)
class Signals:
    """Samples of a log, whose reference may be unknown."""

    samples: Samples
    known: bool  # whether r is

    @property
    def t(self) -> FloatArray:
        """The time [s]."""
        return self.samples.t

    @property
    def r(self) -> FloatArray | None:
        """The reference; None where it is unknown."""
        return self.samples.r if self.known else None

    @property
    def u(self) -> FloatArray:
        """The control input."""
        return self.samples.u

    @property
    def y(self) -> FloatArray:
        """The measured output."""
        return self.samples.y

    @property
    def step(self) -> float:
        """The sample period [s]."""
        return float(self.t[-1] - self.t[0]) / max(self.t.size - 1, 1)

    @property
    def e(self) -> FloatArray:
        """The control error; of an unknown reference, the mean of y is taken."""
        return (self.r if self.r is not None else float(self.y.mean())) - self.y

    @cached_property
    def cycle(self) -> Oscillation | None:
        """The oscillation of the error where it is regular."""
        strongest = find_oscillation(self.e)
        return strongest if strongest is not None and strongest.regularity > MIN_REGULARITY else None

    def rows(self, chosen: BoolArray | slice) -> Signals:
        """Return some of the rows."""
        return Signals(self.samples[chosen], self.known)


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
        known = not (np.array_equal(samples.r, samples.u, equal_nan=True) or np.isnan(samples.r).all())
        valid = np.isfinite(samples.t) & np.isfinite(samples.u) & np.isfinite(samples.y)
        if known:
            valid &= np.isfinite(samples.r)
        if valid.sum() < 2:
            raise RecordingError(f"{name}: u and y hold no numbers in the same rows, choose other columns")
        recorded = Signals(samples, known).rows(valid)
        steps = np.diff(recorded.t)
        if not (steps > 0.0).any():
            raise RecordingError(f"{name}: the time does not advance, choose another time column")
        resting = find_rest(recorded)
        runs = (np.cumsum(samples.restart)[valid] + np.cumsum(np.r_[0, np.diff(resting.astype(int)) != 0]))[~resting]
        moving = recorded.rows(~resting)
        return cls(recorded, resting, moving, form_even(moving, runs), 1.0 - float(valid.mean()))


def find_rest(log: Signals) -> BoolArray:
    """Return the rows, shape (N,), of long stretches in which r, u and y all keep to a small part of their range."""
    size = max(log.t.size // REST_BLOCKS, 1)
    starts = np.arange(0, log.t.size, size)
    known = [x for x in (log.r, log.u, log.y) if x is not None]
    resting = np.zeros(log.t.size, np.bool_)
    if not (np.ptp(log.u) > 0.0 and np.ptp(log.y) > 0.0):
        return resting  # what never changes does not rest
    spans = np.array([np.ptp(x) for x in known]) * MAX_REST_RANGE
    low = np.array([np.minimum.reduceat(x, starts) for x in known])
    high = np.array([np.maximum.reduceat(x, starts) for x in known])
    least, first = MIN_REST_SHARE * starts.size, 0
    for k in range(starts.size):  # the widest window up to block k in which all keep still
        while first <= k and np.any(high[:, first : k + 1].max(axis=1) - low[:, first : k + 1].min(axis=1) > spans):
            first += 1
        if k + 1 - first >= least:
            resting[first * size : (k + 1) * size] = True
    return resting


def form_even(log: Signals, runs: IntArray) -> Signals:
    """Return the longest stretch without a long gap on an even grid; runs: a number per row, of its stretch."""
    steps = np.diff(log.t)
    if not (steps > 0.0).any():
        return log
    period = float(np.median(steps[steps > 0.0]))
    breaks = np.flatnonzero((steps > (MAX_FILLED_GAP + 1.5) * period) | (steps <= 0.0) | (np.diff(runs) != 0)) + 1
    edges = np.r_[0, breaks, log.t.size]
    longest = int(np.argmax(np.diff(edges)))
    part = log.rows(slice(edges[longest], edges[longest + 1]))
    even = np.arange(part.t[0], part.t[-1] + 0.5 * period, period)
    factor = -(-even.size // MAX_ROWS)
    t, r, u, y = (thin(np.interp(even, part.t, x), factor) for x in (part.t, part.samples.r, part.u, part.y))
    return Signals(Samples.from_columns(t, r, u, y), log.known)


def thin(x: FloatArray, factor: int) -> FloatArray:
    """Return means of `factor` neighbours each."""
    return x if factor == 1 else np.asarray(x[: x.size // factor * factor].reshape(-1, factor).mean(axis=1))
