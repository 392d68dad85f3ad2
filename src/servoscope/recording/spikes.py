"""Finds isolated spikes: samples that jump out and back again, far outside of what is normal around them."""

from __future__ import annotations

from collections.abc import Callable

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
_NOWHERE = np.empty(0, dtype=np.intp)


def find_spikes(
    x: FloatArray, run: npt.NDArray[np.int32], *, share: float, excused: Callable[[], BoolArray] | None = None
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
        Samples that may jump, for example u where the reference steps: a mask (N,), asked for when it is needed.

    Returns
    -------
    Samples in order, shape (n,)
    """
    spikes = np.empty(0, dtype=np.intp)
    for _ in range(PASSES):  # spikes hide others: range and neighbours are taken again without those found
        z, runs = spool.without(x, spikes), spool.without(run, spikes)
        found = _one_pass(z, runs, share, lambda: None if excused is None else spool.without(excused(), spikes))  # noqa: B023
        if not found.size:
            break
        spikes = np.union1d(spikes, found + np.searchsorted(spikes - np.arange(spikes.size), found, side="right"))
    return spikes


def steps_in(r: FloatArray, run: npt.NDArray[np.int32]) -> BoolArray:
    """Mark the samples, shape (N,), at which a controller may kick: where r steps or a run starts."""
    low, high = (float(x) for x in _range(r)) if r.size else (0.0, 0.0)
    smallest = STEP_SHARE * (high - low)
    jumps = spool.where(1, r.size, lambda rows: np.abs(_steps(r, rows)) > smallest) if high > low else _NOWHERE
    local = _local_steps(r, jumps, np.zeros_like(jumps))
    starts = spool.where(1, run.size, lambda rows: run[rows] != run[rows.start - 1 : rows.stop - 1])
    mask = spool.empty((r.size,), np.bool_)
    for rows in spool.pieces(0, r.size, mask):
        mask[rows] = False
    loud = jumps[np.abs(r[jumps] - r[jumps - 1]) > LOCAL * local]
    for offset in range(-1, REACTION + 1):
        at = np.concatenate([loud, [0][: r.size], starts]).astype(np.intp) + offset
        mask[at[(at >= 0) & (at < r.size)]] = True
    return np.asarray(mask)


def _range(x: FloatArray) -> tuple[float, float]:
    each = [(float(x[rows].min()), float(x[rows].max())) for rows in spool.pieces(0, x.size, x)]
    return min(low for low, _ in each), max(high for _, high in each)


def _steps(x: FloatArray, rows: slice) -> FloatArray:
    return np.asarray(x[rows] - x[rows.start - 1 : rows.stop - 1])


def _one_pass(
    z: FloatArray, run: npt.NDArray[np.int32], share: float, excused: Callable[[], BoolArray | None]
) -> Index:
    if z.size < 2 * NEIGHBOURS:
        return _NOWHERE
    some = spool.some(z.size)
    span = float(np.subtract(*np.quantile(np.concatenate([z[rows] for rows in some]), [0.99, 0.01])))
    moving = np.abs(np.concatenate([np.diff(z[rows]) for rows in some]))
    moving = moving[moving > 0.0]
    largest = max(float(np.abs(_steps(z, rows)).max()) for rows in spool.pieces(1, z.size, z))
    quantum = float(np.median(moving)) if moving.size > NEIGHBOURS else 0.0
    for width in range(1, WIDEST + 1):
        smallest = max(share * span, QUANTUM * quantum) if width <= MODEST_WIDEST else ENORMOUS * span
        if width > MODEST_WIDEST and span == 0.0:
            break
        if largest <= smallest:
            continue  # no step is high enough to enter such a spike
        start, height = _heights(z, run, width, smallest, ENORMOUS * span if span > 0.0 else np.inf)
        free = excused() if start.size else None
        if free is not None:
            start, height = start[~free[start]], height[~free[start]]
        # The spike itself takes two steps of its surroundings; a quartile does not notice.
        far = height > LOCAL * _local_steps(z, start, np.full(start.size, width))
        if far.any():
            # narrow ones first: what lies between two of them looks like a wide one of the other sign
            return np.unique(start[far] + np.arange(width)[:, None])
    return _NOWHERE


def _heights(
    z: FloatArray, run: npt.NDArray[np.int32], width: int, smallest: float, at_edge: float
) -> tuple[Index, FloatArray]:
    """Find where `width` samples stand above or below both neighbours: where (n,), and heights (n,)."""
    from servoscope.recording.scanning import heights

    each: list[tuple[Index, FloatArray]] = []
    for rows in spool.pieces(0, z.size, z, run):
        begin = max(rows.start - 1, 0)  # a neighbour before, and as many samples as a spike has and a neighbour after
        near = slice(begin, rows.stop + width)
        start, height = np.empty(z[near].size, dtype=np.intp), np.empty(z[near].size)
        found = heights(z[near], run[near], width, smallest, at_edge, start, height)
        start, height = start[:found] + begin, height[:found]
        own = (start >= rows.start) & (start < rows.stop)
        each.append((start[own], height[own]))
    return np.concatenate([start for start, _ in each]), np.concatenate([height for _, height in each])


def _local_steps(z: FloatArray, start: Index, width: Index) -> FloatArray:
    """Upper quartile of the steps around each place, shape (n,)."""
    if start.size == 0 or z.size < 2:
        return np.zeros(start.size)
    from servoscope.recording.scanning import local_steps

    quartile = np.empty(start.size)
    local_steps(z, start, width, NEIGHBOURS, quartile)
    return quartile
