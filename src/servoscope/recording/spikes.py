"""Finds isolated spikes: samples that jump out and back again, far outside of what is normal around them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope import spool

__all__ = ["find_spikes", "steps_in"]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
Index = npt.NDArray[np.intp]

WIDEST = 10  # samples
MODEST_WIDEST = 3  # samples; wider ones must be enormous
ENORMOUS = 10.0  # times the range of the signal
LOCAL = 6.0  # times the upper quartile of the local steps: about 9 standard deviations of white noise
QUANTUM = 4.0  # times the median step that is not zero, so that an encoder's counts at rest are no spikes
NEIGHBOURS = 20  # samples on either side that say what is normal here
STEP_SHARE = 0.02  # of the reference's range: smaller steps do not make u kick
REACTION = 3  # samples in which u may kick after a step of r
PASSES = 30
PLACES = 512  # that are looked at together: each of them brings the pages around it into memory
_NOWHERE = np.empty(0, dtype=np.intp)


def find_spikes(
    x: FloatArray,
    run: npt.NDArray[np.int32],
    *,
    share: float,
    excused: Callable[[Index], BoolArray] = lambda rows: np.zeros(rows.size, dtype=np.bool_),
) -> Index:
    """Find isolated spikes of at most ten samples.

    A spike rises above both of its neighbours by more than `share` of the signal's range (1 to 99 %
    quantile) and far more than the steps around it; where it is wider than three samples or stands at the
    edge of a run, by more than ten times the range. A signal that merely moves does not return within a few
    samples.

    Parameters
    ----------
    x
        Signal, shape (N,), finite.
    run
        Index of the run of each sample, shape (N,); nothing is compared across runs.
    share
        Smallest height of a spike, as a share of the signal's range.
    excused
        Tells which of some samples may jump, for example u where the reference steps.

    Returns
    -------
    Samples in order, shape (n,)
    """
    spikes = np.empty(0, dtype=np.intp)
    for _ in range(PASSES):  # spikes hide others: range and neighbours are taken again without those found
        z, runs, before = spool.without(x, spikes), spool.without(run, spikes), spikes - np.arange(spikes.size)

        def logged(rows: Index, before: Index = before) -> Index:
            return np.asarray(rows + np.searchsorted(before, rows, side="right"))

        found = logged(_one_pass(z, runs, share, lambda rows, logged=logged: excused(logged(rows))))  # type: ignore[misc]
        if not found.size:
            break
        spikes = np.union1d(spikes, found)
    return spikes


def steps_in(r: FloatArray, run: npt.NDArray[np.int32], rows: Index) -> BoolArray:
    """Return at which of some rows (n,) a controller may kick: where r steps or a run starts, shape (n,)."""
    low, high = _range(r)
    kicked = np.zeros(rows.size, dtype=np.bool_)
    for places in spool.pieces(0, rows.size, r, run, at_once=PLACES):
        for offset in range(-1, REACTION + 1):
            at = rows[places] - offset
            inside = (at > 0) & (at < r.size)
            at = np.where(inside, at, 1)
            step = np.abs(r[at] - r[at - 1])
            loud = (step > STEP_SHARE * (high - low)) & (step > LOCAL * _local_steps(r, at, np.zeros_like(at)))
            kicked[places] |= (inside & (loud | (run[at] != run[at - 1]))) | (rows[places] == offset)
    return kicked


def _range(x: FloatArray) -> tuple[float, float]:
    each = [(float(x[rows].min()), float(x[rows].max())) for rows in spool.pieces(0, x.size, x)]
    return min(low for low, _ in each), max(high for _, high in each)


def _before(x: npt.NDArray[Any], rows: slice) -> npt.NDArray[Any]:
    return x[rows.start - 1 : rows.stop - 1]


def _steps(x: FloatArray, rows: slice) -> FloatArray:
    return np.asarray(x[rows] - _before(x, rows))


def _one_pass(z: FloatArray, run: npt.NDArray[np.int32], share: float, excused: Callable[[Index], BoolArray]) -> Index:
    if z.size < 2 * NEIGHBOURS:
        return _NOWHERE
    some = spool.some(z.size)
    span = float(np.subtract(*np.quantile(np.concatenate([z[rows] for rows in some]), [0.99, 0.01])))
    moving = np.abs(np.concatenate([np.diff(z[rows]) for rows in some]))
    moving = moving[moving > 0.0]
    spool.release(z)
    quantum = float(np.median(moving)) if moving.size > NEIGHBOURS else 0.0
    modest, enormous = max(share * span, QUANTUM * quantum), ENORMOUS * span
    least = min(modest, enormous) if span > 0.0 else modest
    # a spike is entered by a high step, or stands where a run starts
    entered = spool.where(
        lambda rows: (np.abs(_steps(z, rows)) > least) | (run[rows] != _before(run, rows)), z, run, first=1
    )
    entered = np.append(0, entered)
    for width in range(1, WIDEST + 1):
        if width > MODEST_WIDEST and span == 0.0:
            break
        smallest = modest if width <= MODEST_WIDEST else enormous
        start, height = _heights(z, run, entered, width, smallest, enormous if span > 0.0 else np.inf)
        # The spike itself takes two steps of its surroundings; a quartile does not notice.
        start = start[height > LOCAL * _local_steps(z, start, np.full(start.size, width))]
        start = start[~excused(start)]
        if start.size:
            # narrow ones first: what lies between two of them looks like a wide one of the other sign
            return np.unique(start + np.arange(width)[:, None])
    return _NOWHERE


def _heights(
    z: FloatArray, run: npt.NDArray[np.int32], at: Index, width: int, smallest: float, at_edge: float
) -> tuple[Index, FloatArray]:
    """Find at which places `width` samples stand above or below both neighbours: where (n,), and heights (n,)."""
    from servoscope.recording.scanning import heights

    start, height, count = np.empty(at.size, dtype=np.intp), np.empty(at.size), 0
    for places in spool.pieces(0, at.size, z, run, at_once=PLACES):
        count += heights(z, run, at[places], width, smallest, at_edge, start[count:], height[count:])
    return start[:count], height[:count]


def _local_steps(z: FloatArray, start: Index, width: Index) -> FloatArray:
    """Upper quartile of the steps around each place, shape (n,)."""
    if start.size == 0 or z.size < 2:
        return np.zeros(start.size)
    from servoscope.recording.scanning import local_steps

    quartile = np.empty(start.size)
    for places in spool.pieces(0, start.size, z, at_once=PLACES):
        local_steps(z, start[places], width[places], NEIGHBOURS, quartile[places])
    return quartile
