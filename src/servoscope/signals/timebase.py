"""The rule of time stamps: what is a gap, a repeat, a late row or a clock that was set back, in files and in streams.

A file is sorted within its runs. A stream is sorted within each block that arrives: a row that comes in a later block
than its successors is left out, because they have been processed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from servoscope.core import outofcore
from servoscope.core.arrays import BoolArray, FloatArray, IndexArray, Int32Array

GAP_STEP = 1.5 + 1e-6  # sample periods: a longer step is a gap; the margin is for the rounding of stamps
REPEAT_STEP = 0.05  # sample periods: stamps closer than this are one
BACKWARD_STEP = -0.5  # sample periods: a step further back is no jitter
LATE_SAMPLES = 10  # a row that is later, or is followed by as many that are late too, means that the clock was set back
MAX_TIME_S = 1e100  # beyond, steps cannot be counted any more
NO_ROWS = np.empty(0, dtype=np.intp)


class BlockOrder(NamedTuple):
    """How the rows of a block are processed.

    `order`: all rows (N,), sorted if that is all that was wrong with them; `rows`: those that are used (M,), in the
    order of time; `restart`: which of these do not follow their predecessor by one sample period (M,); `t`: time of
    the last row that is used.
    """

    order: IndexArray
    rows: IndexArray
    restart: BoolArray
    t: float


class Timebase(NamedTuple):
    """Tells what the steps between time stamps mean, for one sample period, in the unit of the stamps."""

    period: float

    def is_gap(self, steps: npt.NDArray[Any]) -> BoolArray:
        """Tell which steps leave out samples."""
        return np.asarray(steps > GAP_STEP * self.period)

    def is_repeat(self, steps: npt.NDArray[Any]) -> BoolArray:
        """Tell which steps lead to the stamp of the row before, once rows are sorted."""
        return np.asarray(steps < REPEAT_STEP * self.period)

    def find_gaps(self, t: FloatArray, run: Int32Array) -> IndexArray:
        """Return the rows after which samples are missing within a run."""
        return self._find(self.is_gap, t, run) - 1

    def find_repeats(self, t: FloatArray, run: Int32Array) -> IndexArray:
        """Return the rows that repeat the stamp of the row before within a run."""
        return self._find(self.is_repeat, t, run)

    @staticmethod
    def _find(test: Callable[[FloatArray], BoolArray], t: FloatArray, run: Int32Array) -> IndexArray:
        return outofcore.find_rows(
            lambda rows: np.asarray(test(time_steps(t, rows)) & (run[rows] == run[previous_rows(rows)])),
            t,
            run,
            first=1,
        )

    def is_regular(self, t: FloatArray, last: FloatArray) -> BoolArray:
        """Tell which blocks, shape (assets, N), follow their `last` sample (assets,), and are in order, as they are."""
        steps = np.empty(t.shape)
        steps[:, 0], steps[:, 1:] = t[:, 0] - last, t[:, 1:] - t[:, :-1]
        return np.asarray(~(self.is_gap(steps) | self.is_repeat(steps) | np.isnan(steps)).any(axis=1))

    def order_block(self, t: FloatArray, last: float) -> BlockOrder:
        """Sort the rows of a block of a stream as those of a file, behind the rows that have been processed.

        `t`: time stamps, shape (N,), NaN where there is none; `last`: that of the last row processed; NaN: there was
        none.
        """
        if self.is_regular(t[None, :], np.array([last]))[0]:
            rows = np.arange(t.size)
            return BlockOrder(rows, rows, np.zeros(t.size, dtype=np.bool_), float(t[-1]))
        known = np.flatnonzero(np.abs(t) < MAX_TIME_S)
        if np.isfinite(last):  # row 0 is the one processed last: it stays where it is
            stamps, rows = np.append(last, t[known]), np.append(-1, known)
        else:
            stamps, rows = t[known], known
        wild = outlier_rows(stamps, NO_ROWS, backward_rows(stamps), self.period)
        stamps, rows = np.delete(stamps, wild), np.delete(rows, wild)
        backwards = backward_rows(stamps)
        starts = run_starts(stamps, NO_ROWS, backwards, self.period) if backwards.size else NO_ROWS
        run = np.searchsorted(starts, np.arange(stamps.size), side="right")
        by_time = np.lexsort((stamps, run))
        stamps, rows, run = stamps[by_time], rows[by_time], run[by_time]
        begins = np.diff(run, prepend=0) > 0
        used = begins | ~self.is_repeat(np.diff(stamps, prepend=-np.inf))
        if np.isfinite(last):
            used[: int(np.argmin(rows)) + 1] = False
        order = np.arange(t.size)
        if used.sum() == known.size and not starts.size:
            order[known] = rows[used]
        restart = begins[used] | ~(np.diff(stamps[used], prepend=last) <= GAP_STEP * self.period)
        return BlockOrder(order, rows[used], restart, float(stamps[used][-1]) if used.any() else last)


def previous_rows(rows: slice) -> slice:
    """Return the rows before some rows, one each."""
    return slice(rows.start - 1, rows.stop - 1)


def time_steps(t: FloatArray, rows: slice) -> FloatArray:
    """Return the steps to some rows, without the first of all, from those before them."""
    return np.asarray(t[rows] - t[previous_rows(rows)])


def backward_rows(t: FloatArray) -> IndexArray:
    """Return the rows whose stamp is earlier than the one before."""
    return outofcore.find_rows(lambda rows: time_steps(t, rows) < 0.0, t, first=1)


def outlier_rows(t: FloatArray, begins: IndexArray, backwards: IndexArray, period: float) -> IndexArray:
    """Return single stamps far ahead of both neighbours; sorted in, they would stretch the time axis."""
    after = backwards[backwards >= 2]
    between = t[after] - t[after - 2]
    one_run = np.searchsorted(begins, after, side="right") == np.searchsorted(begins, after - 2, side="right")
    close = (between > 0.0) & (between < LATE_SAMPLES * period) & one_run
    return np.asarray(after[close & (t[after - 1] - t[after] > LATE_SAMPLES * period)] - 1)


def run_starts(t: FloatArray, begins: IndexArray, backwards: IndexArray, period: float) -> IndexArray:
    """Return where runs begin, but for the first: where the marks say so, and where time falls back."""
    marked = set(begins.tolist())
    starts, looked, high = [], 0, float(t[0])
    for back in np.union1d(begins, backwards).tolist():
        if back in marked:
            starts.append(back)
            looked, high = back, float(t[back])
            continue
        high, looked = max(high, float(t[looked:back].max())), back
        returns = (t[back : back + LATE_SAMPLES + 1] > high).any()
        if high - t[back] > LATE_SAMPLES * period and not returns:
            starts.append(back)
            high = float(t[back])
    return np.array(starts, dtype=np.intp)
