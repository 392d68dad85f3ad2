"""Puts the rows of a log on one rising time axis: runs, rows out of order, sample rate, jitter."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from servoscope.core import outofcore
from servoscope.core.arrays import FloatArray, IndexArray, Int32Array, select_rows
from servoscope.core.errors import IrregularTimeError, RecordingError
from servoscope.core.messages import message
from servoscope.signals.defects import Defect, mask_spans
from servoscope.signals.rounded_stamps import uniform_stamps
from servoscope.signals.timebase import (
    GAP_STEP,
    MAX_TIME_S,
    NO_ROWS,
    REPEAT_STEP,
    backward_rows,
    outlier_rows,
    previous_rows,
    run_starts,
    time_steps,
)

MAX_BACKWARD_SHARE = 0.25  # share of steps that may go backwards
MAX_REPEATED_SHARE = 0.3  # share of stamps that may be repeated
MAX_IRREGULAR_SHARE = 0.2  # share of steps that may be far from one sample period
JITTER = 0.1  # sample periods
RATE_TOLERANCE = 0.01
RATE_NOTE = 0.001
RESAMPLE_HINT = "correct sample_rate, or say --resample (resample = true in [columns])"


class TimeAxis(NamedTuple):
    """A rising time axis: t [s] (M,), run (M,), sample rate [Hz], and what was done to the rows of the log for it.

    `dropped` are the rows without a usable stamp; `sorted_rows` the stretches of what is left that were sorted, each as
    its first row and the order of its rows.
    """

    t: FloatArray
    run: Int32Array
    sample_rate: float
    defects: list[Defect]
    dropped: IndexArray
    sorted_rows: list[tuple[int, IndexArray]]

    def reorder(self, column: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return a column of the log, shape (N,), in the order of this axis, shape (M,)."""
        column = outofcore.drop_rows(column, self.dropped)
        if self.sorted_rows:
            column = outofcore.copy_column(column)
        for first, rows in self.sorted_rows:
            column[first : first + rows.size] = column[first : first + rows.size][rows]
        return column


def build_time_axis(
    t: FloatArray,
    marks: npt.NDArray[Any] | None,
    sample_rate: float | None,
    name: str,
    regular: bool = True,
    signals: Sequence[FloatArray] = (),
) -> TimeAxis:
    """Sort the rows within their runs and lay the runs end to end where their times overlap.

    `t`: time stamps [s] as logged, shape (N,); `marks`: values, shape (N,), whose change starts a new run; None:
    there is one; `sample_rate`: expected [Hz]; None: as measured; `name`: what errors call the recording; `regular`:
    whether steps have to be of one length, because nobody resamples them; `signals`: columns (N,), which distinguish
    rows of one stamp that were sampled one after the other from rows that were written twice.

    Raises RecordingError if the time axis runs backwards or in disorder, is too coarse or irregular, or the rate is not
    the expected one.
    """
    if marks is None and (axis := _as_it_stands(t, sample_rate)) is not None:
        return axis
    lost = outofcore.find_rows(lambda rows: ~(np.abs(t[rows]) < MAX_TIME_S), t)
    if t.size - lost.size < 2:
        raise RecordingError(f"{name}: the time column holds no numbers, choose another")
    begins = NO_ROWS
    if marks is not None:
        begins = outofcore.find_rows(lambda rows: np.asarray(marks[rows] != marks[previous_rows(rows)]), marks, first=1)
    t = outofcore.drop_rows(t, lost)
    begins = _shift_run_starts(begins, lost, t.size)
    exact = uniform_stamps(t, begins, [outofcore.drop_rows(x, lost) for x in signals])
    t = t if exact is None else exact
    period, backwards = _check_direction(t, begins, name)
    wild = outlier_rows(t, begins, backwards, period)
    if wild.size:
        t = outofcore.drop_rows(t, wild)
        begins = _shift_run_starts(begins, wild, t.size)
        backwards = backward_rows(t)
    begins = run_starts(t, begins, backwards, period)
    t, order = _sort_runs(t, begins, np.setdiff1d(backwards, begins))
    rate, jitter = _measure_rate(t, begins, sample_rate, name, regular)
    used = sample_rate if sample_rate is not None else rate
    laid = _separate_runs(t, begins, 1.0 / used)

    defects, start, end = [], float(laid[0]), float(laid[-1])
    for first, rows in order:
        for a, b in mask_spans(rows != np.arange(rows.size)):
            span = float(laid[first + a]), float(laid[first + b - 1])
            text = message("defect.order", rows=b - a, from_s=span[0], to_s=span[1])
            defects.append(Defect("order", *span, b - a, text))
    if lost.size:
        defects.append(Defect("nan", start, end, lost.size, message("defect.no_stamp", rows=lost.size)))
    if wild.size:
        defects.append(Defect("clock", start, end, wild.size, message("defect.wild_stamp", rows=wild.size)))
    if jitter:
        defects.append(Defect("jitter", start, end, jitter, message("defect.jitter", steps=jitter, limit=JITTER)))
    if abs(rate / used - 1.0) > RATE_NOTE:
        defects.append(Defect("clock", start, end, t.size, message("defect.rate", measured=rate, used=used)))
    dropped = np.union1d(lost, wild + np.searchsorted(lost - np.arange(lost.size), wild, side="right"))
    return TimeAxis(laid, number_runs(begins, t.size), used, defects, dropped, order)


def _as_it_stands(t: FloatArray, sample_rate: float | None) -> TimeAxis | None:
    """Return the axis of one run whose steps are all alike, as most are; None where there may be more to say of it."""
    if not 2 < t.size <= outofcore.CHUNK_ROWS or not max(abs(t[0]), abs(t[-1])) < MAX_TIME_S:
        return None
    with np.errstate(invalid="ignore", over="ignore"):  # of stamps that are no numbers
        steps = t[1:] - t[:-1]
        mean, least, most = float(steps.mean()), float(steps.min()), float(steps.max())
    if not 0.9 * mean < least <= most < 1.1 * mean:
        return None
    rate = _to_rate(steps.size, float(steps.sum()))
    used = sample_rate if sample_rate is not None else rate
    off = max(abs(least * used - 1.0), abs(most * used - 1.0))
    if off > 0.99 * JITTER or abs(rate / used - 1.0) > 0.99 * RATE_NOTE:
        return None
    return TimeAxis(t, np.zeros(t.size, dtype=np.int32), used, [], NO_ROWS, [])


def number_runs(begins: IndexArray, rows: int) -> Int32Array:
    """Return the run of each row, from 0, where runs but for the first start at `begins`."""
    if not begins.size:
        return np.zeros(rows, dtype=np.int32)  # pages that nobody writes take no memory
    run = outofcore.empty((rows,), np.int32)
    for piece in outofcore.iter_chunks(0, rows, run):
        run[piece] = np.searchsorted(begins, np.arange(piece.start, piece.stop), side="right")
    return run


def _steps_within_runs(t: FloatArray, begins: IndexArray, rows: slice) -> FloatArray:
    """Return the steps to some rows within runs, which start at `begins`."""
    rows = slice(max(rows.start, 1), rows.stop)
    first, last = np.searchsorted(begins, [rows.start, rows.stop])
    steps = time_steps(t, rows)
    return steps if first == last else np.delete(steps, begins[first:last] - rows.start)


def _shift_run_starts(begins: IndexArray, dropped: IndexArray, left: int) -> IndexArray:
    """Return where runs begin, but for the first, when rows have been dropped and so many are left."""
    if not dropped.size:
        return begins
    begins = np.unique(begins - np.searchsorted(dropped, begins))
    return np.asarray(begins[(begins > 0) & (begins < left)])


def _check_direction(t: FloatArray, begins: IndexArray, name: str) -> tuple[float, IndexArray]:
    """Return a first guess of the sample time [s], and the rows at which time goes backwards."""
    begins = begins if begins.size < t.size - 1 else begins[:0]
    back = backward_rows(t)
    backwards = np.setdiff1d(back, begins).size
    count, repeated = t.size - 1 - begins.size, 0
    for rows in outofcore.iter_chunks(0, t.size, t):
        repeated += int((_steps_within_runs(t, begins, rows) == 0.0).sum())
    if backwards > 0.9 * count:
        raise RecordingError(f"{name}: time runs backwards throughout, sort the rows or choose another time column")
    if backwards > MAX_BACKWARD_SHARE * count:
        raise RecordingError(
            f"{name}: {backwards} of {count} time steps go backwards, choose another time column or sort the rows"
        )
    if repeated > MAX_REPEATED_SHARE * count:
        raise RecordingError(
            f"{name}: {repeated} of {count + 1} time stamps repeat the one before:"
            " the clock is too coarse, log finer time stamps, or say at which rate the rows came, --rate HZ"
        )
    return _typical_step(_sample_steps(t, begins)), back


def _typical_step(steps: FloatArray) -> float:
    """Return the median of the steps forward; or, where all are alike, their mean, which is as good and sooner known.

    What is a gap or a repeat beside it is none beside the median either, and the other way round.
    """
    mean = float(steps.mean()) if steps.size else 0.0
    if steps.size and steps.min() > 0.9 * mean and steps.max() < 1.1 * mean:
        return mean
    return float(np.median(steps[steps > 0.0]))


def _sample_steps(t: FloatArray, begins: IndexArray) -> FloatArray:
    some = np.concatenate([_steps_within_runs(t, begins, rows) for rows in outofcore.sample_chunks(t.size)])
    outofcore.release(t)
    return some


def _sort_runs(
    t: FloatArray, begins: IndexArray, backwards: IndexArray
) -> tuple[FloatArray, list[tuple[int, IndexArray]]]:
    """Sort the rows within their runs; return the stretches concerned, each as its first row and the order of its rows.

    Up to a row at which time goes backwards all is sorted: only rows later than it, and those that are late, move.
    """
    stretches: list[tuple[int, IndexArray]] = []
    logged, done = t, 0
    t = outofcore.copy_column(t) if backwards.size else t
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
        while (
            stretches and first <= stretches[-1][0] + stretches[-1][1].size
        ):  # one stretch with what was sorted before
            first = min(first, stretches.pop()[0])
        order = np.argsort(logged[first:done], kind="stable")
        t[first:done] = logged[first:done][order]
        stretches.append((first, order))
    return t, stretches


def _measure_rate(
    t: FloatArray, begins: IndexArray, expected: float | None, name: str, regular: bool
) -> tuple[float, int]:
    """Return the measured rate [Hz] and the number of jittery steps."""
    some = _sample_steps(t, begins)
    some = some[some > 0.0]
    if some.size == 0:
        raise RecordingError(f"{name}: time does not advance, choose another time column")
    typical = _typical_step(some)
    typical = _typical_step(some[some > REPEAT_STEP * typical])
    total, count = 0.0, 0
    for rows in outofcore.iter_chunks(0, t.size, t):
        steps = _steps_within_runs(t, begins, rows)
        near = select_rows(steps, (steps > 0.5 * typical) & (steps < GAP_STEP * typical))
        total, count = total + float(near.sum()), count + near.size
    if not count:  # as many short steps as long ones: their median is near neither
        total, count = typical, 1
    # The mean is right also where stamps are rounded, for example 3, 3, 4 ms at 300 Hz; the median is not.
    rate = _to_rate(count, total)
    if expected is not None and abs(rate / expected - 1.0) > RATE_TOLERANCE:
        factor = next(
            (unit for unit, f in (("ms", 1e3), ("us", 1e6), ("ns", 1e9)) if abs(rate * f / expected - 1) < 0.02),
            None,
        )
        hint = f'is the time in {factor}? then say time_unit = "{factor}"' if factor else RESAMPLE_HINT
        raise RecordingError(f"{name}: sampled at {rate:.6g} Hz, the loop says {expected:.6g} Hz: {hint}")
    if not regular:
        return rate, 0
    period = 1.0 / (expected if expected is not None else rate)
    advancing = far = jitter = 0
    for rows in outofcore.iter_chunks(0, t.size, t):
        steps = _steps_within_runs(t, begins, rows) / period
        steps = select_rows(steps, steps > REPEAT_STEP)
        advancing += steps.size
        far += int(((steps > GAP_STEP) | (steps < 0.5)).sum())
        jitter += int(((np.abs(steps - 1.0) > JITTER + 1e-6) & (steps <= GAP_STEP)).sum())
    if far > MAX_IRREGULAR_SHARE * advancing:
        raise IrregularTimeError(
            f"{name}: {far} of {advancing} time steps are far from one sample of {period:g} s:"
            " log at a fixed rate, or have them resampled: --resample, or resample = true in [columns]"
        )
    return rate, jitter


def _to_rate(steps: int, seconds: float) -> float:
    return float(f"{steps / seconds:.9g}")  # stamps are no better than that, and 25 Hz should read 25


def _separate_runs(t: FloatArray, begins: IndexArray, period: float) -> FloatArray:
    """Move runs that begin before the one before them has ended to its end."""
    laid = t
    for begin, stop in pairwise([*begins.tolist(), t.size]):
        if laid[begin] < laid[begin - 1] + 0.5 * period:
            laid = outofcore.copy_column(t) if laid is t else laid
            laid[begin:stop] += laid[begin - 1] + period - t[begin]
    return laid
