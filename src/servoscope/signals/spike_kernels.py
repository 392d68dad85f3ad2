"""Where samples stand out from their neighbours, and what steps are usual around them; compiled."""

from __future__ import annotations

import math
from typing import Any

from servoscope.core.jit import maximum, minimum, where
from servoscope.core.jit.array_function import ArrayFunction
from servoscope.core.jit.arrays import Variable


@ArrayFunction
def write_excursions(
    printer: Any, z: Any, run: Any, at: Any, width: Any, smallest: Any, at_edge: Any, start: Any, height: Any
) -> Any:
    """Write where `width` samples of one run stand above or below both neighbours, and how far; return how many do.

    They are looked for at some places. They must do so by more than `smallest`; at the edge of a run, where there is
    one neighbour, by more than `at_edge`.
    """
    count, end = Variable(printer, 0), z.shape[0] - 1
    for place in printer.loop(0, at.shape[0]):
        first = at[place]
        last = first + width - 1
        inside = minimum(last, end)
        with printer.when((last <= end) & run[first].is_equal(run[inside])):
            low, high = Variable(printer, z[first]), Variable(printer, z[first])
            for k in printer.loop(first + 1, last + 1):
                low.value, high.value = minimum(low.value, z[k]), maximum(high.value, z[k])
            left, right = maximum(first - 1, 0), minimum(last + 1, end)
            before = (first > 0) & run[left].is_equal(run[first])
            after = (last < end) & run[right].is_equal(run[last])
            below = maximum(where(before, z[left], -math.inf), where(after, z[right], -math.inf))
            above = minimum(where(before, z[left], math.inf), where(after, z[right], math.inf))
            size = maximum(low.value - below, above - high.value)
            with printer.when((before | after) & (size > where(before & after, smallest, at_edge))):
                start[count.value], height[count.value] = first, size
                count.value = count.value + 1
    return count.value


@ArrayFunction
def write_local_steps(printer: Any, z: Any, start: Any, width: Any, around: Any, out: Any) -> None:
    """Write the upper quartile of the steps around places of some width; `out` has their number.

    Mirrored at the ends, a place's own width away, so that one at the end is not compared with itself; of the
    steps on either side, as many are taken as `around` has room for.
    """
    count, size = z.shape[0] - 1, around.shape[0]
    for i in printer.loop(0, start.shape[0]):
        for k in printer.loop(0, size):
            offset = k - size // 2
            place = where(offset < 0, start[i] + offset, start[i] + width[i] + offset)
            place = where(place < 0, width[i] - place, place)
            place = where(place >= count, 2 * count - 2 - place - width[i], place)
            place = minimum(maximum(place, 0), count - 1)
            step, j = abs(z[place + 1] - z[place]), Variable(printer, k)

            def is_later(step: Any = step, j: Any = j) -> Any:
                return (j.value > 0) & (around[maximum(j.value - 1, 0)] > step)

            for _ in printer.loop_while(is_later):  # sorted as they come: few
                around[j.value] = around[j.value - 1]
                j.value = j.value - 1
            around[j.value] = step
        place = (printer.number(size) - 1.0) * 0.75
        below = printer.truncate(place)
        out[i] = around[below] + (around[below + 1] - around[below]) * (place - printer.number(below))
