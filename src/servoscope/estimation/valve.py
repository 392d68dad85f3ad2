"""The flow of a valve instead of u: u times the square root of the pressure drop over the control edges.

The flow K_q u sqrt(1 - sign(u) p_L/p_s) of a spool valve (Merritt, *Hydraulic Control Systems*, 1967) is linear in
u sqrt(...), so the inverse of the actuator stays linear in theta once that product takes the place of u. The load
pressure comes from the motion, p_L = (m_p y'' + b_p y' + k_p y)/A_p, with y as measured and its derivatives filtered.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.jit import maximum, minimum, sqrt, sum_products, where
from servoscope.core.jit.array_function import ArrayFunction
from servoscope.core.jit.arrays import Variable
from servoscope.models.discretise import split_delay
from servoscope.models.loop import Loop
from servoscope.models.lti import sample_system, state_variable_filter

ORDER = 3  # of the differentiator: one more than the derivatives it gives
CUTOFF_RATIO = 2.0  # its cutoff against that of the filter bank, so that p_L does not lag behind the motion
ARMED, HEADER_SIZE = 0, 1
MAX_PHYSICAL = 1e100  # as in the recursion: no physical signal, and it would stay in the filter for ever


def integer_delay(loop: Loop) -> float:
    """Return the part of the loop's delay [s] that `ValveLaw` takes over: whole samples, so that u meets p_L."""
    return split_delay(loop.delay, loop.sample_rate)[0] / loop.sample_rate if loop.plant.load_pressure else 0.0


class ValveLaw:
    """The valve law of one loop, ready to run; where the law is linear it lets u pass and has no state."""

    def __init__(self, loop: Loop) -> None:
        self.size, self._plant = 0, loop.plant
        if loop.plant.load_pressure is None:
            return
        rate, (of_y, *of_derivatives) = loop.sample_rate, loop.plant.load_pressure
        cutoff = min(CUTOFF_RATIO * loop.cutoff, 0.25 * rate)
        moving = np.array([[0.0, *of_derivatives]])
        filtered = sample_system(state_variable_filter(cutoff, ORDER), rate, "foh").output(moving)
        limits = loop.input_limits if loop.input_logged == "before_limiter" else None
        low, high = limits or (-np.inf, np.inf)
        columns = filtered.A, filtered.B[:, 0], filtered.C[0], filtered.steady[:, 0]
        sign, delay = math.copysign(1.0, loop.plant.input_gain), split_delay(loop.delay, rate)[0]
        numbers = float(filtered.D[0, 0]) + of_y, low, high, sign, loop.plant.retraction_gain**2, delay
        self._constants = *map(np.ascontiguousarray, columns), *numbers
        self._states = len(filtered.A)
        self.size = HEADER_SIZE + self._states + delay

    def start(self) -> FloatArray:
        """Return the state before the first sample, shape (size,)."""
        return np.zeros(self.size)

    def run(self, state: FloatArray, u: FloatArray, y: FloatArray, restart: BoolArray) -> FloatArray:
        """Return u sqrt(1 - sign(u) p_L/p_s) of a block, delayed, shape (N,), and change `state` (size,) in place.

        It is NaN where u or y is. After a gap, axis and u are assumed to have been constant before.
        """
        if not self.size:
            return self._plant.effective_input(u)
        out = np.empty(len(u))
        _run_square_root(*self._constants, state, u, y, restart, out, n=self._states)
        return out


@ArrayFunction
def _run_square_root(
    printer: Any, A: Any, B: Any, C: Any, X0: Any, D: Any, low: Any, high: Any, sign: Any, area_ratio: Any, delay: Any,
    s: Any, u: Any, y: Any, restart: Any, out: Any, *, n: int,
) -> None:  # fmt: skip
    """Write the flow: A, B, C, D, X0 are the filter y -> p_L/p_s and its steady state; the rest is of u."""
    for k in printer.loop(0, u.shape[0]):
        known = (abs(u[k]) < MAX_PHYSICAL) & (abs(y[k]) < MAX_PHYSICAL)
        with printer.when(~known):
            s[ARMED], out[k] = 0.0, math.nan
        with printer.when(known):
            now = Variable(printer, minimum(maximum(u[k], low), high))
            past = HEADER_SIZE + n
            with printer.when((restart[k] > 0) | s[ARMED].is_equal(0.0)):
                s[ARMED] = 1.0
                for i in range(n):
                    s[HEADER_SIZE + i] = X0[i] * y[k]
                for i in printer.loop(0, delay):
                    s[i + past] = now.value
            x, pressure = [s[HEADER_SIZE + i] for i in range(n)], D * y[k]
            for i in range(n):
                pressure = pressure + C[i] * x[i]
                s[HEADER_SIZE + i] = sum_products([A[i, j] for j in range(n)], x, B[i] * y[k])
            for i in printer.loop(0, delay):
                now.value, s[i + past] = s[i + past], now.value
            left = where(sign * now.value > 0.0, 1.0 - pressure, area_ratio + pressure)
            out[k] = now.value * sqrt(maximum(left, 0.0))
