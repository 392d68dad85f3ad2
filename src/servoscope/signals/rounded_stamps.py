"""Time stamps that a logger rounded to a few digits: the uniform clock behind them, where one explains all of them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from servoscope.core import outofcore
from servoscope.core.arrays import BoolArray, FloatArray, IndexArray
from servoscope.signals.timebase import GAP_STEP, NO_ROWS, backward_rows, time_steps

MAX_DECIMALS, MAX_DIGITS = 7, 8  # stamps with more are as good as exact
MIN_RESOLUTION = 0.1  # sample periods: what is rounded more finely does no harm
MIN_STAMP_S = 1e-9  # what is nearer to 0 is as good as exact
MIN_GRID_ROWS = 20
MAX_COARSENESS = 0.01  # of the length of a run: stamps rounded to more leave its rate open
MAX_PERIOD_ERROR = 0.05  # of the mean step without gaps, up to which a period is no other clock
MAX_RUNS = 1000
NICE_DIGITS = 9  # of a rate or a period, which the stamps cannot distinguish from rounder ones
SLACK = 1e-3  # of half a last digit, for the arithmetic
COPIED_SHARE = 0.9  # share of rows of one stamp that repeat the row before, where rows were written twice


class _Digits(NamedTuple):
    """How stamps were rounded: to so many decimals, to so many significant digits, or to single precision.

    A number that is too large for stamps that show no such rounding.
    """

    decimals: int
    significant: int
    single: bool

    @classmethod
    def of(cls, t: FloatArray) -> _Digits:
        """Return the fewest digits that hold all stamps."""
        decimals = next((d for d in range(MAX_DECIMALS) if _is_whole(t * 10.0**d).all()), MAX_DECIMALS)
        scale = _decade(t)
        significant = next(
            (s for s in range(1, MAX_DIGITS) if _is_whole(t * 10.0 ** (s - 1 - scale)).all()), MAX_DIGITS
        )
        return cls(decimals, significant, bool((t == t.astype(np.float32)).all()))

    def half(self, t: FloatArray) -> FloatArray:
        """Return half of the last digit of each stamp [s], shape (N,)."""
        last = np.full(t.shape, 10.0**-self.decimals if self.decimals < MAX_DECIMALS else 0.0)
        if self.significant < MAX_DIGITS:
            last = np.maximum(last, 10.0 ** (_decade(t) + 1 - self.significant))
        if self.single:
            last = np.maximum(last, np.spacing(np.abs(t).astype(np.float32)).astype(np.float64))
        return 0.5 * last

    def holds(self, t: FloatArray) -> bool:
        """Tell whether further stamps are rounded so, too."""
        other = _Digits.of(t)
        return (
            other.decimals <= self.decimals
            and other.significant <= self.significant
            and (other.single or not self.single)
        )


def _is_whole(x: FloatArray) -> BoolArray:
    return np.asarray(np.abs(x - np.rint(x)) < 1e-6 + 4.0 * np.spacing(np.abs(x)))


def _decade(t: FloatArray) -> FloatArray:
    """Return the power of ten of the leading digit."""
    # rounding in the logarithm must not put 1000 a decade lower
    return np.floor(np.log10(np.maximum(np.abs(t), MIN_STAMP_S)) + 1e-12)


class _Run(NamedTuple):
    """Rows of one run, and how many samples are missing before the rows after each gap, shape (G,) each."""

    rows: slice
    after: IndexArray
    missing: IndexArray

    def numbers(self, rows: slice) -> FloatArray:
        """Return the number of the sample of each row of a piece, from the first of the run on."""
        index = np.arange(rows.start, rows.stop)
        extra = np.append(0, np.cumsum(self.missing))[np.searchsorted(self.after, index, side="right")]
        return np.asarray(index - self.rows.start + extra, dtype=np.float64)

    def pieces(self, t: FloatArray) -> Sequence[slice]:
        """Return the rows piece by piece."""
        return [
            slice(piece.start + self.rows.start, piece.stop + self.rows.start)
            for piece in outofcore.iter_chunks(0, self.rows.stop - self.rows.start, t)
        ]


class _Clock(NamedTuple):
    """The period of a clock [s], and when sample 0 of each run was [s]."""

    period: float
    runs: list[_Run]
    offsets: list[float]


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # of stamps that are none, which no clock fits
def uniform_stamps(t: FloatArray, begins: IndexArray, signals: Sequence[npt.NDArray[np.float64]]) -> FloatArray | None:
    """Return the stamps of the uniform clock that all logged ones lie within half a last digit of, shape (N,).

    None where there is no such clock, the stamps need none, or the same rows were written several times.

    Parameters
    ----------
    t
        Stamps as logged [s], shape (N,), all finite.
    begins
        Rows at which a new run begins, beside those at which time goes back.
    signals
        Columns of the same rows, shape (N,) each.
    """
    if t.size < MIN_GRID_ROWS:
        return None
    cuts = np.union1d(begins, backward_rows(t))
    if cuts.size >= MAX_RUNS:
        return None
    bounds = [slice(a, b) for a, b in pairwise([0, *cuts.tolist(), t.size])]
    longest = max(bounds, key=lambda rows: rows.stop - rows.start)
    digits = _Digits.of(t[longest][:: max(1, (longest.stop - longest.start) // outofcore.CHUNK_ROWS)])
    period, coarsest = (
        _rough_period(t, longest, digits),
        2.0 * float(digits.half(t[longest.stop - 1 : longest.stop])[0]),
    )
    span = float(t[longest.stop - 1] - t[longest.start])
    if longest.stop - longest.start < MIN_GRID_ROWS or not coarsest <= MAX_COARSENESS * span:
        return None
    if not 0.0 < MIN_RESOLUTION * period <= coarsest:
        return None
    # a step of two samples is a missing one; where rounding alone may make such steps, nobody knows how many samples
    # lie in a gap, and what follows it counts from a beginning of its own
    fitted = (_fit(t, split(t, bounds, digits, period), digits) for split in (_count_gaps, _cut_gaps))
    clocks = (clock for clock in fitted if clock and abs(clock.period / period - 1.0) < MAX_PERIOD_ERROR)
    if (clock := next(clocks, None)) is None or _are_copies(t, signals):
        return None
    grid, farthest = outofcore.empty((t.size,)), 0.0
    for run, offset in zip(clock.runs, clock.offsets, strict=True):
        for piece in run.pieces(t):
            grid[piece] = offset + clock.period * run.numbers(piece)
            farthest = max(farthest, float(np.abs(grid[piece] - t[piece]).max()))
    return grid if farthest > 0.5 * MIN_RESOLUTION * clock.period else None


def _fit(t: FloatArray, runs: list[_Run], digits: _Digits) -> _Clock | None:
    """Return the clock that the stamps of all runs agree with, None if there is none."""
    if not runs:
        return None
    longest = max(runs, key=lambda run: run.rows.stop - run.rows.start)
    for period in _nice_periods(_fitted_period(t, longest, digits)):
        offsets: list[float] = []
        for run in runs:
            if (offset := _offset(t, run, digits, period)) is None:
                break
            offsets.append(offset)
        else:
            return _Clock(period, runs, offsets)
    return None


def _rough_period(t: FloatArray, rows: slice, digits: _Digits) -> float:
    """Return the mean step of a run without its gaps [s]; 0 where the stamps do not advance."""
    some = [
        rows.start + np.arange(piece.start, piece.stop) for piece in outofcore.sample_chunks(rows.stop - rows.start)
    ]
    steps = np.concatenate([np.diff(t[index]) for index in some])
    last = 2.0 * np.concatenate([digits.half(t[index])[1:] for index in some])
    period = float(steps.mean()) if steps.size else 0.0
    for _ in range(10):  # each gap that is left out lets more of them be seen
        within = steps <= GAP_STEP * period + last
        if not within.any() or np.isclose(mean := float(steps[within].mean()), period, rtol=1e-12):
            break
        period = mean
    return period


def _count_gaps(t: FloatArray, bounds: list[slice], digits: _Digits, period: float) -> list[_Run]:
    """Return runs with the samples that are missing in them, of stamps that tell how many."""
    runs = []
    for rows in bounds:
        within = t[rows]
        after = outofcore.find_rows(lambda piece, x=within: time_steps(x, piece) > GAP_STEP * period, within, first=1)  # type: ignore[misc]
        missing = np.rint((within[after] - within[after - 1]) / period).astype(np.intp) - 1
        runs.append(_Run(rows, after + rows.start, missing))
    return runs


def _cut_gaps(t: FloatArray, bounds: list[slice], digits: _Digits, period: float) -> list[_Run]:
    """Return runs and what follows a gap in them as a run of its own."""

    def is_gap(rows: slice) -> BoolArray:
        return np.asarray(time_steps(t, rows) > GAP_STEP * period + 2.0 * digits.half(t[rows]))

    cuts = np.union1d(outofcore.find_rows(is_gap, t, first=1), [rows.start for rows in bounds]).astype(np.intp)
    if cuts.size > MAX_RUNS:
        return []
    return [_Run(slice(a, b), NO_ROWS, NO_ROWS) for a, b in pairwise([*cuts.tolist(), t.size])]


def _fitted_period(t: FloatArray, run: _Run, digits: _Digits) -> float:
    """Return the period by least squares, finely rounded stamps weighing more."""
    sums = np.zeros(5)
    ends = slice(run.rows.stop - 1, run.rows.stop)
    origin = float(t[run.rows.start])
    period = (float(t[ends][0]) - origin) / max(float(run.numbers(ends)[0]), 1.0)
    for piece in run.pieces(t):
        half = digits.half(t[piece])
        k, weight = run.numbers(piece), np.maximum(half, 1e-3 * half.max()) ** -2.0
        off = t[piece] - origin - k * period  # small numbers, whose squares keep their digits
        sums += [weight.sum(), weight @ k, weight @ (k * k), weight @ off, weight @ (k * off)]
    w, wk, wkk, we, wke = sums
    spread = wkk - wk * wk / w
    return period + float((wke - wk * we / w) / spread) if spread > 0.0 else period


def _nice_periods(period: float) -> list[float]:
    """Return periods next to one, those of a round rate or of few digits first."""
    nice = list[float]()
    if not np.isfinite([period, 1.0 / period if period > 0.0 else np.inf]).all():
        return nice
    for digits in range(1, NICE_DIGITS + 1):
        nice += [1.0 / float(f"{1.0 / period:.{digits}g}"), float(f"{period:.{digits}g}")]
    return [*dict.fromkeys(nice), period]


def _offset(t: FloatArray, run: _Run, digits: _Digits, period: float) -> float | None:
    """Return when sample 0 of a run was, if all stamps then lie within half a last digit [s]; None: they do not."""
    low, high = -np.inf, np.inf
    for piece in run.pieces(t):
        if not digits.holds(t[piece]):
            return None
        off, half = t[piece] - period * run.numbers(piece), digits.half(t[piece]) * (1.0 + SLACK)
        low, high = max(low, float((off - half).max())), min(high, float((off + half).min()))
        if low > high:
            return None
    return 0.5 * (low + high)


def _are_copies(t: FloatArray, signals: Sequence[npt.NDArray[np.float64]]) -> bool:
    """Tell whether rows of one stamp repeat the row before, as a logger that is faster than its source writes them."""
    counts = np.zeros((2, 2))  # rows whose stamp is new, and is not; rows of each that repeat the row before
    for rows in outofcore.iter_chunks(0, t.size, t):
        rows = slice(max(rows.start, 1), rows.stop)
        old = time_steps(t, rows) == 0.0
        same = np.all([time_steps(x, rows) == 0.0 for x in signals], axis=0) if signals else np.zeros_like(old)
        counts += [[(~old).sum(), old.sum()], [(same & ~old).sum(), (same & old).sum()]]
    shares = counts[1] / np.maximum(counts[0], 1.0)
    return bool(counts[0, 1] and shares[1] > COPIED_SHARE and shares[0] < 0.5 * shares[1])
