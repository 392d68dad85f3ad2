"""Puts the rows of a log on one rising time axis: runs, swapped rows, sample rate, jitter."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

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
RATE_TOLERANCE = 0.01
RATE_NOTE = 0.001


class Axis(NamedTuple):
    """A rising time axis: rows of the log in its order (M,), their t [s] (M,), run (M,), sample rate [Hz]."""

    rows: Index
    t: FloatArray
    run: IntArray
    sample_rate: float
    notes: list[Defect]


def gaps(t: FloatArray, run: IntArray, period: float) -> Index:
    """Return the indices of the rows after which more than 1.5 samples are missing within a run."""
    return np.flatnonzero((np.diff(t) > (GAP + 1e-6) * period) & (np.diff(run) == 0))


def arrange(t: FloatArray, marks: npt.NDArray[np.generic], sample_rate: float | None, name: str) -> Axis:
    """Sort the rows within their runs and lay the runs end to end where their times overlap.

    Parameters
    ----------
    t
        Time stamps [s] as logged, shape (N,).
    marks
        Values, shape (N,), whose change starts a new run.
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
    rows = np.flatnonzero(np.isfinite(t))
    if rows.size < 2:
        raise RecordingError(f"{name}: the time column holds no numbers, choose another")
    lost = t.size - rows.size
    change = np.concatenate([[0], np.cumsum(marks[1:] != marks[:-1])])
    period = _check_direction(t[rows], change[rows], name)
    rows, wild = _without_wild(t, rows, change, period)
    run = _split(t[rows], change[rows], period)
    order = np.lexsort((t[rows], run))
    moved = order != np.arange(order.size)
    rows, run = rows[order], run[order]
    rate, jitter = _measure(t[rows], run, sample_rate, name)
    used = sample_rate if sample_rate is not None else rate
    laid = _lay_out(t[rows], run, 1.0 / used)

    notes = [_order_note(laid[start:stop]) for start, stop in spans(moved)]
    start, end = float(laid[0]), float(laid[-1])
    if lost:
        notes.append(Defect("nan", start, end, lost, f"{lost} rows without a time stamp dropped"))
    if wild:
        notes.append(Defect("clock", start, end, wild, f"{wild} rows with an absurd time stamp dropped"))
    if jitter:
        words = f"time stamps jitter: {jitter} steps off by more than {JITTER:.0%} of a sample, taken as uniform"
        notes.append(Defect("jitter", start, end, jitter, words))
    if abs(rate / used - 1.0) > RATE_NOTE:
        words = f"time stamps say {rate:.6g} Hz, the loop says {used:.6g} Hz: the loop's is used"
        notes.append(Defect("clock", start, end, rows.size, words))
    return Axis(rows, laid, run, used, notes)


def _check_direction(t: FloatArray, change: Index, name: str) -> float:
    """Return a first guess of the sample time [s]."""
    steps = np.diff(t)[np.diff(change) == 0]
    steps = steps if steps.size else np.diff(t)
    backwards = int((steps < 0.0).sum())
    if backwards > 0.9 * steps.size:
        raise RecordingError(f"{name}: time runs backwards throughout, sort the rows or choose another time column")
    if backwards > DISORDER * steps.size:
        raise RecordingError(
            f"{name}: {backwards} of {steps.size} time steps go backwards, choose another time column or sort the rows"
        )
    repeated = int((steps == 0.0).sum())
    if repeated > COARSE * steps.size:
        raise RecordingError(
            f"{name}: {repeated} of {steps.size + 1} time stamps repeat the one before:"
            " the clock is too coarse, log finer time stamps or leave the time column out"
        )
    return float(np.median(steps[steps > 0.0]))


def _without_wild(t: FloatArray, rows: Index, change: Index, period: float) -> tuple[Index, int]:
    """Drop single stamps far ahead of both neighbours; sorted in, they would stretch the time axis."""
    stamps, runs = t[rows], change[rows]
    between = stamps[2:] - stamps[:-2]
    close = (between > 0.0) & (between < LATE * period) & (runs[2:] == runs[:-2])
    wild = close & (stamps[1:-1] - stamps[2:] > LATE * period)
    keep = np.ones(rows.size, dtype=bool)
    keep[1:-1] = ~wild
    return rows[keep], int(wild.sum())


def _split(t: FloatArray, change: Index, period: float) -> IntArray:
    """Return the number of each row's run; a change of the marks and a time that falls back start one."""
    starts = np.concatenate([[True], np.diff(change) != 0])
    begin, high = 0, t[0]
    for back in np.flatnonzero((np.diff(t) < 0.0) | starts[1:]) + 1:
        if starts[back]:
            begin, high = int(back), t[back]
            continue
        high = max(high, float(t[begin:back].max()))
        returns = (t[back : back + LATE + 1] > high).any()
        if high - t[back] > LATE * period and not returns:
            starts[back] = True
            begin, high = int(back), t[back]
    return np.asarray(np.cumsum(starts) - 1, dtype=np.int32)


def _measure(t: FloatArray, run: IntArray, expected: float | None, name: str) -> tuple[float, int]:
    """Return the measured rate [Hz] and the number of jittery steps."""
    steps = np.diff(t)[np.diff(run) == 0]
    steps = steps[steps > 0.0]
    if steps.size == 0:
        raise RecordingError(f"{name}: time does not advance, choose another time column")
    typical = float(np.median(steps))
    typical = float(np.median(steps[steps > SAME * typical]))
    near = steps[(steps > 0.5 * typical) & (steps < GAP * typical)]
    # The mean is right also where stamps are rounded, for example 3, 3, 4 ms at 300 Hz; the median is not.
    rate = float(f"{1.0 / near.mean():.9g}")  # stamps are no better than that, and 25 Hz should read 25
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
    steps = steps[steps > SAME * period]
    far = int(((steps > GAP * period * (1 + 1e-6)) | (steps < 0.5 * period)).sum())
    if far > IRREGULAR * steps.size:
        raise RecordingError(
            f"{name}: {far} of {steps.size} time steps are far from one sample of {period:g} s:"
            " log at a fixed rate, nothing is interpolated here"
        )
    jitter = (np.abs(steps / period - 1.0) > JITTER + 1e-6) & (steps <= GAP * period)
    return rate, int(jitter.sum())


def _lay_out(t: FloatArray, run: IntArray, period: float) -> FloatArray:
    laid = t.copy()
    begins = np.flatnonzero(np.diff(run, prepend=run[:1] - 1))
    stops = [*begins[1:], t.size]
    for begin, stop in zip(begins[1:], stops[1:], strict=True):
        if laid[begin] < laid[begin - 1] + 0.5 * period:
            laid[begin:stop] += laid[begin - 1] + period - t[begin]
    return laid


def _order_note(t: FloatArray) -> Defect:
    return Defect(
        "order",
        float(t[0]),
        float(t[-1]),
        t.size,
        f"{t.size} rows out of order from {t[0]:g} to {t[-1]:g} s, sorted",
    )
