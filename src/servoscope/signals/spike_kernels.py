"""Where samples stand out from their neighbours, and what steps are usual around them; compiled."""

from __future__ import annotations

import functools

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import FloatArray, IndexArray
from servoscope.core.jit import kernel


@functools.partial(kernel, heap=False)
def write_excursions(
    z: FloatArray,
    run: npt.NDArray[np.int32],
    at: IndexArray,
    width: int,
    smallest: float,
    at_edge: float,
    start: IndexArray,
    height: FloatArray,
) -> int:
    """Write where `width` samples of one run stand above or below both neighbours, and how far; return how many do.

    They are looked for at some places. They must do so by more than `smallest`; at the edge of a run, where there is
    one neighbour, by more than `at_edge`.
    """
    found = 0
    for i in at:
        last = i + width - 1
        if last >= len(z) or run[i] != run[last]:
            continue
        low, high = z[i], z[i]
        for k in range(i + 1, last + 1):
            low, high = min(low, z[k]), max(high, z[k])
        before = i > 0 and run[i - 1] == run[i]
        after = last + 1 < len(z) and run[last + 1] == run[last]
        if not (before or after):
            continue
        below = max(z[i - 1] if before else -np.inf, z[last + 1] if after else -np.inf)
        above = min(z[i - 1] if before else np.inf, z[last + 1] if after else np.inf)
        size = max(low - below, above - high)
        if size > (smallest if before and after else at_edge):
            start[found], height[found] = i, size
            found += 1
    return found


@functools.partial(kernel, heap=False)
def write_local_steps(z: FloatArray, start: IndexArray, width: IndexArray, around: FloatArray, out: FloatArray) -> None:
    """Write the upper quartile of the steps around places of some width; `out` has their number.

    Mirrored at the ends, a place's own width away, so that one at the end is not compared with itself; of the
    steps on either side, as many are taken as `around` has room for.
    """
    count, size = len(z) - 1, len(around)
    for i in range(len(start)):
        for k in range(size):
            offset = k - size // 2
            at = start[i] + offset if offset < 0 else start[i] + width[i] + offset
            if at < 0:
                at = width[i] - at
            if at >= count:
                at = 2 * count - 2 - at - width[i]
            at = min(max(at, 0), count - 1)
            step, j = abs(z[at + 1] - z[at]), k
            while j > 0 and around[j - 1] > step:  # sorted as they come: few, and a tenth of the compiling
                around[j] = around[j - 1]
                j -= 1
            around[j] = step
        place = 0.75 * (size - 1)
        below = int(place)
        out[i] = around[below] + (around[below + 1] - around[below]) * (place - below)
