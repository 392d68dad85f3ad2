"""Finds isolated spikes: samples that jump out and back again, far outside of what is normal around them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["find_spikes", "steps_in"]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

WIDEST = 10  # samples
MODEST_WIDEST = 3  # samples; wider ones must be enormous
ENORMOUS = 10.0  # times the range of the signal
LOCAL = 6.0  # times the upper quartile of the local steps: about 9 standard deviations of white noise
QUANTUM = 4.0  # times the median step that is not zero, so that an encoder's counts at rest are no spikes
NEIGHBOURS = 20  # samples on either side that say what is normal here
STEP_SHARE = 0.02  # of the reference's range: smaller steps do not make u kick
REACTION = 3  # samples in which u may kick after a step of r
PASSES = 30


def find_spikes(
    x: FloatArray, run: npt.NDArray[np.int32], *, share: float, excused: BoolArray | None = None
) -> BoolArray:
    """Mark isolated spikes of at most ten samples.

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
        Samples, shape (N,), that may jump, for example u where the reference steps.

    Returns
    -------
    mask, shape (N,)
    """
    spike = np.zeros(x.size, dtype=bool)
    for _ in range(PASSES):  # spikes hide others: range and neighbours are taken again without those found
        kept = np.flatnonzero(~spike)
        free = None if excused is None else excused[kept]
        found = _one_pass(x[kept], run[kept], share, free)
        if not found.any():
            break
        spike[kept[found]] = True
    return spike


def steps_in(r: FloatArray, run: npt.NDArray[np.int32]) -> BoolArray:
    """Mark the samples, shape (N,), at which a controller may kick: where r steps or a run starts."""
    steps = np.abs(np.diff(r, prepend=r[:1]))
    span = float(np.ptp(r)) if r.size else 0.0
    candidates = np.flatnonzero(steps > STEP_SHARE * span) if span > 0.0 else np.empty(0, dtype=np.intp)
    local = _local_steps(r, candidates, np.zeros_like(candidates))
    starts = np.flatnonzero(np.diff(run, prepend=run[:1] - 1) != 0)
    mask = np.zeros(r.size, dtype=bool)
    for offset in range(-1, REACTION + 1):
        at = np.concatenate([candidates[steps[candidates] > LOCAL * local], starts]) + offset
        mask[at[(at >= 0) & (at < r.size)]] = True
    return mask


def _one_pass(z: FloatArray, run: npt.NDArray[np.int32], share: float, excused: BoolArray | None) -> BoolArray:
    found = np.zeros(z.size, dtype=bool)
    if z.size < 2 * NEIGHBOURS:
        return found
    span = float(np.subtract(*np.quantile(z, [0.99, 0.01])))
    moving = np.abs(np.diff(z))
    moving = moving[moving > 0.0]
    largest = float(moving.max(initial=0.0))
    quantum = float(np.median(moving)) if moving.size > NEIGHBOURS else 0.0
    for width in range(1, WIDEST + 1):
        smallest = max(share * span, QUANTUM * quantum) if width <= MODEST_WIDEST else ENORMOUS * span
        if width > MODEST_WIDEST and span == 0.0:
            break
        if largest <= smallest:
            continue  # no step is high enough to enter such a spike
        start, height = _heights(z, run, width, smallest, ENORMOUS * span if span > 0.0 else np.inf)
        if excused is not None:
            free = ~excused[start]
            start, height = start[free], height[free]
        # The spike itself takes two steps of its surroundings; a quartile does not notice.
        far = height > LOCAL * _local_steps(z, start, np.full(start.size, width))
        for offset in range(width):
            found[start[far] + offset] = True
        if found.any():
            break  # narrow ones first: what lies between two of them looks like a wide one of the other sign
    return found


def _heights(
    z: FloatArray, run: npt.NDArray[np.int32], width: int, smallest: float, at_edge: float
) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Find where `width` samples stand above or below both neighbours: where (n,), and heights (n,)."""
    from servoscope.recording.scanning import heights

    start, height = np.empty(z.size, dtype=np.intp), np.empty(z.size)
    found = heights(z, run, width, smallest, at_edge, start, height)
    return start[:found], height[:found]


def _local_steps(z: FloatArray, start: npt.NDArray[np.intp], width: npt.NDArray[np.intp]) -> FloatArray:
    """Upper quartile of the steps around each place, shape (n,)."""
    if start.size == 0 or z.size < 2:
        return np.zeros(start.size)
    from servoscope.recording.scanning import local_steps

    quartile = np.empty(start.size)
    local_steps(z, start, width, NEIGHBOURS, quartile)
    return quartile
