"""Finds isolated spikes: samples that jump out and back again, far beyond the steps around them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from servoscope.core import outofcore
from servoscope.core.arrays import BoolArray, FloatArray, IndexArray
from servoscope.signals.timebase import NO_ROWS, previous_rows, time_steps

MAX_WIDTH = 50  # samples
MAX_PLAUSIBLE_WIDTH = 10  # samples; wider ones must be beyond everything
MAX_NORMAL_WIDTH = 3  # samples; wider ones must be enormous
MIN_WIDE_SPIKE_FACTOR = 10.0  # times the range of the signal,
MIN_BEYOND_FACTOR = 1e4  # and of those that are beyond everything
LOCAL_STEP_FACTOR = 6.0  # times the upper quartile of the local steps: about 9 standard deviations of white noise
QUANTUM_FACTOR = 4.0  # times the median step that is not zero, so that an encoder's counts at rest are no spikes
NEIGHBOURS = 20  # samples on either side that define what is normal
STEP_SHARE = 0.02  # of the reference's range: smaller steps do not make u kick
REACTION_SAMPLES = 3  # samples in which u may kick after a step of r
PASSES = 30
CHUNK_PLACES = 4096  # that are looked at together: each of them brings the pages around it into memory


def find_spikes(
    x: FloatArray,
    run: npt.NDArray[np.int32],
    *,
    share: float,
    excused: Callable[[IndexArray], BoolArray] = lambda rows: np.zeros(rows.size, dtype=np.bool_),
) -> IndexArray:
    """Find isolated spikes of at most ten samples, and of fifty where they are ten thousand times the range.

    A spike rises above both of its neighbours by more than `share` of the signal's range (1 to 99 %
    quantile) and far more than the steps around it; where it is wider than three samples or stands at the
    edge of a run, by more than ten times the range. A signal that merely moves does not return within a few
    samples.

    `x`: signal, shape (N,), finite; `run`: index of the run of each sample, shape (N,); nothing is compared across
    runs; `share`: smallest height of a spike, as a share of the signal's range; `excused`: tells which of some
    samples may jump, for example u where the reference steps; by no more than ten times the range.
    """
    spikes = NO_ROWS
    for _ in range(PASSES):  # spikes hide others: range and neighbours are taken again without those found
        z, runs = outofcore.drop_rows(x, spikes), outofcore.drop_rows(run, spikes)
        before = spikes - np.arange(spikes.size)

        def logged(rows: IndexArray, before: IndexArray = before) -> IndexArray:
            return np.asarray(rows + np.searchsorted(before, rows, side="right"))

        higher = logged(_find_spikes_once(z, runs, share, lambda rows, logged=logged: excused(logged(rows))))  # type: ignore[misc]
        if not higher.size:
            break
        spikes = np.union1d(spikes, higher)
    return spikes


def follows_reference_step(r: FloatArray, run: npt.NDArray[np.int32], rows: IndexArray) -> BoolArray:
    """Return at which of some rows (n,) a controller may kick: where r steps or a run starts, shape (n,)."""
    low, high = outofcore.extremes(r)
    kicked = np.zeros(rows.size, dtype=np.bool_)
    for places in outofcore.iter_chunks(0, rows.size, r, run, at_once=CHUNK_PLACES):
        for offset in range(-1, REACTION_SAMPLES + 1):
            at = rows[places] - offset
            inside = (at > 0) & (at < r.size)
            at = np.where(inside, at, 1)
            step = np.abs(r[at] - r[at - 1])
            is_step = (step > STEP_SHARE * (high - low)) & (
                step > LOCAL_STEP_FACTOR * _local_step_quartile(r, at, np.zeros_like(at))
            )
            kicked[places] |= (inside & (is_step | (run[at] != run[at - 1]))) | (rows[places] == offset)
    return kicked


def _find_spikes_once(
    z: FloatArray, run: npt.NDArray[np.int32], share: float, excused: Callable[[IndexArray], BoolArray]
) -> IndexArray:
    if z.size < 2 * NEIGHBOURS:
        return NO_ROWS
    some = outofcore.sample_chunks(z.size)
    span = float(np.subtract(*np.quantile(np.concatenate([z[rows] for rows in some]), [0.99, 0.01])))
    moving = np.abs(np.concatenate([np.diff(z[rows]) for rows in some]))
    moving = moving[moving > 0.0]
    outofcore.release(z)
    quantum = float(np.median(moving)) if moving.size > NEIGHBOURS else 0.0
    modest, enormous = max(share * span, QUANTUM_FACTOR * quantum), MIN_WIDE_SPIKE_FACTOR * span
    least = min(modest, enormous) if span > 0.0 else modest
    # a spike is entered by a high step, or stands where a run starts
    highest = 0.0

    def enters(rows: slice) -> BoolArray:
        nonlocal highest
        steps = np.abs(time_steps(z, rows))
        highest = max(highest, float(steps.max()))
        return np.asarray((steps > least) | (run[rows] != run[previous_rows(rows)]))

    entered = np.append(0, outofcore.find_rows(enters, z, run, first=1))
    for width in range(1, MAX_WIDTH + 1):
        if width > MAX_NORMAL_WIDTH and (span == 0.0 or highest <= enormous):
            break  # one that is wide is entered, or left where it stands at an edge, by an enormous step
        if width > MAX_PLAUSIBLE_WIDTH and highest <= MIN_BEYOND_FACTOR * span:
            break
        wide = enormous if width <= MAX_PLAUSIBLE_WIDTH else MIN_BEYOND_FACTOR * span
        smallest = modest if width <= MAX_NORMAL_WIDTH else wide
        start, height = _find_excursions(z, run, entered, width, smallest, enormous if span > 0.0 else np.inf)
        # The spike itself takes two steps of its surroundings; a quartile does not notice.
        high = height > LOCAL_STEP_FACTOR * _local_step_quartile(z, start, np.full(start.size, width))
        start, height = start[high], height[high]
        start = start[~excused(start) | ((span > 0.0) & (height > enormous))]  # no controller kicks as far as that
        if start.size:
            # narrow ones first: what lies between two of them looks like a wide one of the other sign
            return np.unique(start + np.arange(width)[:, None])
    return NO_ROWS


def _find_excursions(
    z: FloatArray, run: npt.NDArray[np.int32], at: IndexArray, width: int, smallest: float, at_edge: float
) -> tuple[IndexArray, FloatArray]:
    """Find at which places `width` samples of one run stand above or below both neighbours: where, and how far, (n,).

    They must do so by more than `smallest`; at the edge of a run, where there is one neighbour, by more than `at_edge`.
    """
    starts, heights, end = [at[:0]], [np.empty(0)], z.size - 1
    for places in outofcore.iter_chunks(0, at.size, z, run, at_once=CHUNK_PLACES):
        first = at[places][at[places] + width - 1 <= end]
        first = first[run[first] == run[first + width - 1]]
        previous, following = np.maximum(first - 1, 0), np.minimum(first + width, end)
        before = (first > 0) & (run[previous] == run[first])
        after = (first + width <= end) & (run[following] == run[first])
        inside = z[first[:, None] + np.arange(width)]
        below = np.maximum(np.where(before, z[previous], -np.inf), np.where(after, z[following], -np.inf))
        above = np.minimum(np.where(before, z[previous], np.inf), np.where(after, z[following], np.inf))
        height = np.maximum(inside.min(axis=1) - below, above - inside.max(axis=1))
        high = (before | after) & (height > np.where(before & after, smallest, at_edge))
        starts.append(first[high])
        heights.append(height[high])
    return np.concatenate(starts), np.concatenate(heights)


def _local_step_quartile(z: FloatArray, start: IndexArray, width: IndexArray) -> FloatArray:
    """Upper quartile of the steps around each place, shape (n,).

    Mirrored at the ends, a place's own width away, so that one at the end is not compared with itself.
    """
    quartile, last, offset = np.zeros(start.size), z.size - 2, np.arange(-NEIGHBOURS, NEIGHBOURS)
    for places in outofcore.iter_chunks(0, start.size if last >= 0 else 0, z, at_once=CHUNK_PLACES):
        wide = width[places, None]
        at = start[places, None] + offset + np.where(offset < 0, 0, wide)
        at = np.where(at < 0, wide - at, at)
        at = np.clip(np.where(at > last, 2 * last - at - wide, at), 0, last)
        quartile[places] = np.quantile(np.abs(z[at + 1] - z[at]), 0.75, axis=1)
    return quartile
