"""Irregular or foreign time stamps to the loop's own rate, with the error that this makes at the loop's cutoff."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from servoscope.core import number_format
from servoscope.core.arrays import BoolArray, FloatArray, IndexArray, Int32Array
from servoscope.core.errors import RecordingError

SPLINE_ERROR = 5.0 / 384.0  # times (omega h)^4: of a cubic spline through a sine (Hall and Meyer, 1976, theorem 5)
MAX_SPLINE_ERROR = 0.01  # of a sine at the cutoff, up to which a step between stamps is bridged
MAX_UNBRIDGED_SHARE = 0.2  # share of the time that may lie in longer steps
MAX_STEP_SAMPLES = 10.0  # samples: a longer step is a gap, whatever the cutoff
OVERLAP = 64  # rows beside a piece: a spline forgets a row by a factor of 3.7 per row, so by 10^36
PIECE_ROWS = 1 << 18


class ResampleTarget(NamedTuple):
    """What rows are put on: the rate [Hz], the cutoff up to which it has to be right [Hz], the hold of u."""

    rate: float = 0.0  # 0: as measured
    cutoff: float = 0.0  # 0: a tenth of the rate, as the filters have it
    hold: str = "zoh"
    before: float = 0.0  # error that an earlier resampling has made, as a share of the amplitude at the cutoff

    def at(self, measured: float, t: FloatArray) -> ResampleTarget:
        """Return the target with nothing left open, for rows at a measured rate [Hz] with the stamps t [s], shape (N,).

        An open cutoff is a tenth of the rate, or what nearly all steps allow.
        """
        rate = self.rate or float(f"{measured:.4g}")
        full = self._replace(rate=rate, cutoff=self.cutoff or rate / 10.0)
        steps = np.diff(t)
        usual = float(np.quantile(steps[steps < MAX_STEP_SAMPLES / measured], 0.999))
        if self.cutoff == 0.0 and usual > full.longest_step():
            full = full._replace(cutoff=full.cutoff * full.longest_step() / usual)
        return full

    def longest_step(self) -> float:
        """Return the longest step between stamps that is bridged [s]."""
        return float((MAX_SPLINE_ERROR / SPLINE_ERROR) ** 0.25 / (2.0 * math.pi * self.cutoff))

    def error(self, step: float) -> float:
        """Return how far a spline over steps of this length is off at the cutoff, as a share of the amplitude."""
        return float(SPLINE_ERROR * (2.0 * math.pi * self.cutoff * step) ** 4)


class UniformRows(NamedTuple):
    """Rows on a uniform grid.

    `t`: time [s] (M,); `run` (M,); `restart`: where samples are missing before a row (M,); `columns`: (M,) each;
    `error`: largest at the cutoff, as a share of the amplitude; `gap_after`: rows of the log after which nothing is
    known (K,).
    """

    t: FloatArray
    run: Int32Array
    restart: BoolArray
    columns: list[FloatArray]
    error: float
    gap_after: IndexArray


def resample_rows(
    t: FloatArray,
    run: Int32Array,
    columns: list[npt.NDArray[Any]],
    inputs: set[int],
    target: ResampleTarget,
    name: str,
    begin: float | None = None,
) -> UniformRows:
    """Put rows on the grid of the target's rate, run by run, by cubic splines through them.

    A held input is a spline through the middles of its steps, read at the middles of the new ones, so that what acts
    on the plant is the same; where the log is much faster, a zero-phase filter goes before.

    `t`: rising time stamps [s], shape (N,); `run`: shape (N,); `columns`: signals, shape (N,) each; `inputs`: which of
    them are held as u is; `name`: what errors call the recording; `begin`: a point of the grid [s]; None: the first row
    of each run is one. Raises RecordingError if the steps are too long for the cutoff in more than a fifth of the time.
    """
    steps = np.diff(t)
    within = run[1:] == run[:-1]
    longest = target.longest_step() * (1.0 + 1e-6)
    apart = within & (steps > longest)
    if steps[apart].sum() > MAX_UNBRIDGED_SHARE * steps[within].sum():
        usual = float(np.quantile(steps[within], 0.9))
        fitting = number_format.round_down(target.cutoff * longest / usual)
        raise RecordingError(
            f"{name}: steps of {1e3 * usual:.3g} ms between rows are too long for a cutoff of {target.cutoff:g} Hz:"
            f" resampled, it would be off by {target.error(usual):.2g} of its size there (allowed"
            f" {MAX_SPLINE_ERROR:g}); set [monitor] cutoff to {fitting:g} Hz or lower, or log faster"
        )
    cuts = np.flatnonzero(apart | ~within) + 1
    usual = float(np.median(steps[within & ~apart]))
    begins, ends = np.append(0, cuts), np.append(cuts, t.size)
    stretches: list[tuple[FloatArray, int, list[FloatArray]]] = []
    origin = {int(run[first]): float(t[first]) for first in begins[::-1]}  # the first row of each run
    for first, end in zip(begins.tolist(), ends.tolist(), strict=True):
        if end - first < 4:  # a cubic needs four points
            continue
        start = origin[int(run[first])] if begin is None else begin
        low = math.ceil((t[first] - start) * target.rate - 1e-6)
        high = math.floor((t[end - 1] - start) * target.rate + 1e-6)
        for lowest in range(low, high + 1, PIECE_ROWS):
            grid = start + np.arange(lowest, min(lowest + PIECE_ROWS, high + 1)) / target.rate
            a, b = np.searchsorted(t[first:end], grid[[0, -1]])
            rows = slice(max(first, first + int(a) - OVERLAP), min(end, first + int(b) + OVERLAP))
            new = [
                _resample_stretch(t[rows], x[rows], grid, target, usual, index in inputs)
                for index, x in enumerate(columns)
            ]
            stretches.append((grid, int(run[first]) if lowest == low else -1 - int(run[first]), new))
    if not stretches:
        raise RecordingError(f"{name}: falls into stretches of under four rows, too short to resample")
    grid = np.concatenate([times for times, *_ in stretches])
    runs = np.concatenate([np.full(times.size, k if k >= 0 else -1 - k, np.int32) for times, k, _ in stretches])
    restart = np.zeros(grid.size, dtype=np.bool_)
    restart[np.cumsum([0, *(times.size for times, *_ in stretches)])[:-1]] = [k >= 0 for _, k, _ in stretches]
    merged = [np.concatenate([new[index] for *_, new in stretches]) for index in range(len(columns))]
    bridged = float(steps[within & ~apart].max())
    return UniformRows(grid, runs, restart, merged, max(target.error(bridged), target.before), np.flatnonzero(apart))


def _resample_stretch(
    t: FloatArray, x: npt.NDArray[Any], grid: FloatArray, target: ResampleTarget, usual: float, held: bool
) -> FloatArray:
    """Return a signal, shape (N,) at t, at a uniform grid within it, shape (M,)."""
    from scipy import interpolate, signal

    period = 1.0 / target.rate
    middle = held and target.hold == "zoh"
    if middle:
        knots, wanted = t + 0.5 * np.append(np.diff(t), usual), grid + 0.5 * period
    else:
        knots, wanted = t, grid
    spline = interpolate.CubicSpline(knots, x)
    # what folds back to below the cutoff has to go first: frequencies from rate - cutoff on
    finer = math.ceil(period / usual) if 0.5 / usual > target.rate - target.cutoff else 1
    if finer == 1:
        samples = spline(np.clip(wanted, knots[0], knots[-1]))
    else:
        fine = wanted[0] + np.arange(grid.size * finer) * (period / finer)
        samples = signal.resample_poly(spline(np.clip(fine, knots[0], knots[-1])), 1, finer, padtype="line")[
            : grid.size
        ]
    if held and samples.size > 2:
        # a hold over h damps by 1 - (omega h)^2/24 (a straight line between samples twice that); the new one makes up
        # for the difference
        share = (1.0 if middle else 2.0) / 24.0 * (1.0 - (usual / period) ** 2)
        samples[1:-1] -= share * np.diff(samples, 2)
    return np.asarray(samples, dtype=np.float64)
