"""The CUSUM's recursion, compiled."""

from __future__ import annotations

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.jit import kernel


@kernel
def run_cusum(x: FloatArray, k: float, h: float) -> BoolArray:
    """Return the alarms (N,) of `servoscope.scoring.cusum`."""
    alarm = np.zeros(x.size, dtype=np.bool_)
    up = 0.0
    down = 0.0
    for t in range(x.size):
        up = max(0.0, up + x[t] - k)
        down = max(0.0, down - x[t] - k)
        if up > h or down > h:
            alarm[t] = True
            up = 0.0
            down = 0.0
    return alarm
