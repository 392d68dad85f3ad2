"""The CUSUM's recursion, compiled."""

from __future__ import annotations

from typing import Any

from servoscope.core.jit import Int, maximum, where
from servoscope.core.jit.array_function import ArrayFunction
from servoscope.core.jit.arrays import Variable


@ArrayFunction
def run_cusum(printer: Any, x: Any, k: Any, h: Any, alarm: Any) -> None:
    """Write the alarms (N,) of `servoscope.scoring.cusum`, 0 or 1."""
    up, down = Variable(printer, 0.0), Variable(printer, 0.0)
    for t in printer.loop(0, x.shape[0]):
        up.value, down.value = maximum(up.value + x[t] - k, 0.0), maximum(down.value - x[t] - k, 0.0)
        exceeded = (up.value > h) | (down.value > h)
        alarm[t] = where(exceeded, Int(printer, "1"), 0)
        up.value, down.value = where(exceeded, 0.0, up.value), where(exceeded, 0.0, down.value)
