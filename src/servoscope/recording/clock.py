"""Puts the rows of a log on one rising time axis: runs, swapped rows, sample rate, jitter."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from servoscope import spool
from servoscope.errors import RecordingError
from servoscope.recording.defects import Defect, spans

__all__ = ["GAP", "SAME", "Axis", "arrange", "gaps"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int32]
Index = npt.NDArray[np.intp]

GAP = 1.5  # samples: a longer step is a gap
SAME = 0.05  # samples: stamps closer than this are one
LATE = 10  # samples: a row this late, or one of so few, is out of order; beyond, time was reset
DISORDER = 0.25  # share of steps that may go backwards
COARSE = 0.3  # share of stamps that may be repeated
IRREGULAR = 0.2  # share of steps that may be far from one sample
JITTER = 0.1  # samples
FARTHEST = 1e100  # s: beyond, steps cannot be counted any more
RATE_TOLERANCE = 0.01
RATE_NOTE = 0.001


class Axis(NamedTuple):
    """A rising time axis: t [s] (M,), run (M,), sample rate [Hz], and what was done to the rows of the log for it.

    `dropped` are the rows without a usable stamp; `sorted_rows` the stretches of what is left that were sorted, each as
    its first row and the order of its rows.
    """

    t: FloatArray
    run: IntArray
    sample_rate: float
    notes: list[Defect]
    dropped: Index
    sorted_rows: list[tuple[int, Index]]

    def arranged(self, column: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return a column of the log, shape (N,), in the order of this axis, shape (M,)."""
        return _sorted(spool.without(column, self.dropped), self.sorted_rows)


def gaps(t: FloatArray, run: IntArray, period: float) -> Index:
    """Return the indices of the rows after which more than 1.5 samples are missing within a run."""

    def test(rows: slice) -> npt.NDArray[np.bool_]:
        return np.asarray((_steps(t, rows) > (GAP + 1e-6) * period) & (run[rows] == run[_before(rows)]))

    return spool.where(test, t, run, first=1) - 1


def arrange(t: FloatArray, marks: npt.NDArray[Any] | None, sample_rate: float | None, name: str) -> Axis:
    """Sort the rows within their runs and lay the runs end to end where their times overlap.

    Parameters
    ----------
    t
        Time stamps [s] as logged, shape (N,).
    marks
        Values, shape (N,), whose change starts a new run; None: there is one.
    sample_rate
        Expected [Hz]; None: as measured.
    name
        What errors call the recording.

    Raises
    ------
    RecordingError
        If the time axis runs backwards or in disorder, is too coarse or irregular, or the rate is not the
        expected one.
    """
    lost = spool.where(lambda rows: ~(np.abs(t[rows]) < FARTHEST), t)
    if t.size - lost.size < 2:
        raise RecordingError(f"{name}: the time column holds no numbers, choose another")
    begins = np.empty(0, dtype=np.intp)
    if marks is not None:
        begins = spool.where(lambda rows: np.asarray(marks[rows] != marks[_before(rows)]), marks, first=1)
    t = spool.without(t, lost)
    begins = _moved_up(begins, lost, t.size)
    period, backwards = _check_direction(t, begins, name)
    wild = _wild(t, begins, backwards, period)
    if wild.size:
        t = spool.without(t, wild)
        begins = _moved_up(begins, wild, t.size)
        backwards = _backwards(t)
    begins = _split(t, begins, backwards, period)
    t, order = _in_order(t, begins, np.setdiff1d(backwards, begins))
    rate, jitter = _measure(t, begins, sample_rate, name)
    used = sample_rate if sample_rate is not None else rate
    laid = _lay_out(t, begins, 1.0 / used)

    moved = [_order_note(laid[first + a : first + b]) for first, rows in order for a, b in _displaced(rows)]
    notes, start, end = moved, float(laid[0]), float(laid[-1])
    if lost.size:
        notes.append(Defect("nan", start, end, lost.size, f"{lost.size} rows without a time stamp dropped"))
    if wild.size:
        notes.append(Defect("clock", start, end, wild.size, f"{wild.size} rows with an absurd time stamp dropped"))
    if jitter:
        words = f"time stamps jitter: {jitter} steps off by more than {JITTER:.0%} of a sample, taken as uniform"
        notes.append(Defect("jitter", start, end, jitter, words))
    if abs(rate / used - 1.0) > RATE_NOTE:
        words = f"time stamps say {rate:.6g} Hz, the loop says {used:.6g} Hz: the loop's is used"
        notes.append(Defect("clock", start, end, t.size, words))
    dropped = np.union1d(lost, wild + np.searchsorted(lost - np.arange(lost.size), wild, side="right"))
    return Axis(laid, _numbered(t.size, begins), used, notes, dropped, order)


def _before(rows: slice) -> slice:
    return slice(rows.start - 1, rows.stop - 1)


def _steps(t: FloatArray, rows: slice) -> FloatArray:
    """Return the steps to some rows from those before them; the first row of all is none of them."""
    return np.asarray(t[rows] - t[_before(rows)])


def _within(t: FloatArray, begins: Index, rows: slice) -> FloatArray:
    """Return the steps to some rows within runs, which start at `begins`."""
    rows = slice(max(rows.start, 1), rows.stop)
    first, last = np.searchsorted(begins, [rows.start, rows.stop])
    return np.asarray(np.delete(_steps(t, rows), begins[first:last] - rows.start))


def _moved_up(begins: Index, dropped: Index, left: int) -> Index:
    """Return where runs begin, but for the first, when rows have been dropped and so many are left."""
    if not dropped.size:
        return begins
    begins = np.unique(begins - np.searchsorted(dropped, begins))
    return np.asarray(begins[(begins > 0) & (begins < left)])


def _backwards(t: FloatArray) -> Index:
    """Return the rows whose stamp is earlier than the one before."""
    return spool.where(lambda rows: _steps(t, rows) < 0.0, t, first=1)


def _check_direction(t: FloatArray, begins: Index, name: str) -> tuple[float, Index]:
    """Return a first guess of the sample time [s], and the rows at which time goes backwards."""
    begins = begins if begins.size < t.size - 1 else begins[:0]
    back = _backwards(t)
    backwards = np.setdiff1d(back, begins).size
    count, repeated = t.size - 1 - begins.size, 0
    for rows in spool.pieces(0, t.size, t):
        repeated += int((_within(t, begins, rows) == 0.0).sum())
    if backwards > 0.9 * count:
        raise RecordingError(f"{name}: time runs backwards throughout, sort the rows or choose another time column")
    if backwards > DISORDER * count:
        raise RecordingError(
            f"{name}: {backwards} of {count} time steps go backwards, choose another time column or sort the rows"
        )
    if repeated > COARSE * count:
        raise RecordingError(
            f"{name}: {repeated} of {count + 1} time stamps repeat the one before:"
            " the clock is too coarse, log finer time stamps or leave the time column out"
        )
    steps = _some_steps(t, begins)
    return float(np.median(steps[steps > 0.0])), back


def _some_steps(t: FloatArray, begins: Index) -> FloatArray:
    some = np.concatenate([_within(t, begins, rows) for rows in spool.some(t.size)])
    spool.release(t)
    return some


def _wild(t: FloatArray, begins: Index, backwards: Index, period: float) -> Index:
    """Return single stamps far ahead of both neighbours; sorted in, they would stretch the time axis."""
    after = backwards[backwards >= 2]
    between = t[after] - t[after - 2]
    one_run = np.searchsorted(begins, after, side="right") == np.searchsorted(begins, after - 2, side="right")
    close = (between > 0.0) & (between < LATE * period) & one_run
    return np.asarray(after[close & (t[after - 1] - t[after] > LATE * period)] - 1)


def _split(t: FloatArray, begins: Index, backwards: Index, period: float) -> Index:
    """Return where runs begin, but for the first: where the marks say so, and where time falls back."""
    marked = set(begins.tolist())
    starts, looked, high = [], 0, float(t[0])
    for back in np.union1d(begins, backwards).tolist():
        if back in marked:
            starts.append(back)
            looked, high = back, float(t[back])
            continue
        high, looked = max(high, float(t[looked:back].max())), back
        returns = (t[back : back + LATE + 1] > high).any()
        if high - t[back] > LATE * period and not returns:
            starts.append(back)
            high = float(t[back])
    return np.array(starts, dtype=np.intp)


def _in_order(t: FloatArray, begins: Index, backwards: Index) -> tuple[FloatArray, list[tuple[int, Index]]]:
    """Sort the rows within their runs; return the stretches concerned, each as its first row and the order of its rows.

    Up to a row at which time goes backwards all is sorted: only rows later than it, and those that are late, move.
    """
    found: list[tuple[int, Index]] = []
    logged, done = t, 0
    t = spool.copied(t) if backwards.size else t
    for back in backwards.tolist():
        if back < done:
            continue
        run = int(np.searchsorted(begins, back, side="right"))
        begin = int(begins[run - 1]) if run else 0
        stop = int(begins[run]) if run < begins.size else t.size
        done, high, low = back, float(t[back - 1]), float(t[back])
        while done < stop and t[done] < high:
            low, done = min(low, float(t[done])), done + 1
        first = begin + int(np.searchsorted(t[begin:back], low, side="right"))
        while found and first <= found[-1][0] + found[-1][1].size:  # one stretch with what was sorted before
            first = min(first, found.pop()[0])
        order = np.argsort(logged[first:done], kind="stable")
        t[first:done] = logged[first:done][order]
        found.append((first, order))
    return t, found


def _displaced(order: Index) -> list[tuple[int, int]]:
    return spans(order != np.arange(order.size))


def _sorted(column: npt.NDArray[Any], order: list[tuple[int, Index]]) -> npt.NDArray[Any]:
    if not order:
        return column
    column = spool.copied(column)
    for first, rows in order:
        column[first : first + rows.size] = column[first : first + rows.size][rows]
    return column


def _measure(t: FloatArray, begins: Index, expected: float | None, name: str) -> tuple[float, int]:
    """Return the measured rate [Hz] and the number of jittery steps."""
    some = _some_steps(t, begins)
    some = some[some > 0.0]
    if some.size == 0:
        raise RecordingError(f"{name}: time does not advance, choose another time column")
    typical = float(np.median(some))
    typical = float(np.median(some[some > SAME * typical]))
    total, count = 0.0, 0
    for rows in spool.pieces(0, t.size, t):
        steps = _within(t, begins, rows)
        near = steps[(steps > 0.5 * typical) & (steps < GAP * typical)]
        total, count = total + float(near.sum()), count + near.size
    # The mean is right also where stamps are rounded, for example 3, 3, 4 ms at 300 Hz; the median is not.
    rate = float(f"{count / total:.9g}")  # stamps are no better than that, and 25 Hz should read 25
    if expected is not None and abs(rate / expected - 1.0) > RATE_TOLERANCE:
        factor = next(
            (unit for unit, f in (("ms", 1e3), ("us", 1e6), ("ns", 1e9)) if abs(rate * f / expected - 1) < 0.02),
            None,
        )
        hint = (
            f'is the time in {factor}? then say time_unit = "{factor}"' if factor else "correct sample_rate or resample"
        )
        raise RecordingError(f"{name}: sampled at {rate:.6g} Hz, the loop says {expected:.6g} Hz: {hint}")
    period = 1.0 / (expected if expected is not None else rate)
    advancing = far = jitter = 0
    for rows in spool.pieces(0, t.size, t):
        steps = _within(t, begins, rows) / period
        steps = steps[steps > SAME]
        advancing += steps.size
        far += int(((steps > GAP * (1 + 1e-6)) | (steps < 0.5)).sum())
        jitter += int(((np.abs(steps - 1.0) > JITTER + 1e-6) & (steps <= GAP)).sum())
    if far > IRREGULAR * advancing:
        raise RecordingError(
            f"{name}: {far} of {advancing} time steps are far from one sample of {period:g} s:"
            " log at a fixed rate, nothing is interpolated here"
        )
    return rate, jitter


def _lay_out(t: FloatArray, begins: Index, period: float) -> FloatArray:
    """Move runs that begin before the one before them has ended to its end."""
    laid = t
    for begin, stop in pairwise([*begins.tolist(), t.size]):
        if laid[begin] < laid[begin - 1] + 0.5 * period:
            laid = spool.copied(t) if laid is t else laid
            laid[begin:stop] += laid[begin - 1] + period - t[begin]
    return laid


def _numbered(size: int, begins: Index) -> IntArray:
    """Return the number of each row's run, shape (N,)."""
    run = spool.empty((size,), np.int32)
    for rows in spool.pieces(0, size, run):
        run[rows] = np.searchsorted(begins, np.arange(rows.start, rows.stop), side="right") if begins.size else 0
    return run


def _order_note(t: FloatArray) -> Defect:
    return Defect(
        "order",
        float(t[0]),
        float(t[-1]),
        t.size,
        f"{t.size} rows out of order from {t[0]:g} to {t[-1]:g} s, sorted",
    )
