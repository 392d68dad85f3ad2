"""The flow of a valve instead of u: u times the square root of the pressure drop over the control edges.

The flow K_q u sqrt(1 - sign(u) p_L/p_s) of a spool valve (Merritt, *Hydraulic Control Systems*, 1967) is linear in
u sqrt(...), so the inverse of the actuator stays linear in theta once that product takes the place of u. The load
pressure comes from the motion, p_L = (m_p y'' + b_p y' + k_p y)/A_p, with y as measured and its derivatives filtered.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.estimation.filter_bank import filter_cutoff
from servoscope.models.discretise import split_delay
from servoscope.models.loop import Loop
from servoscope.models.lti import sample_system, state_variable_filter

ORDER = 3  # of the differentiator: one more than the derivatives it gives
CUTOFF_RATIO = 2.0  # its cutoff against that of the filter bank, so that p_L does not lag behind the motion
ARMED, HEADER_SIZE = 0, 1
MAX_PHYSICAL = 1e100  # as in the recursion: no physical signal, and it would stay in the filter for ever


class ValveConstants(NamedTuple):
    """Constants of the kernel: the filter y -> p_L/p_s (A, B, C, D, steady X0), limits, sign and delay of u."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: float
    X0: FloatArray
    low: float
    high: float
    sign: float
    delay: int  # samples


def integer_delay(loop: Loop) -> float:
    """Return the part of the loop's delay [s] that `ValveLaw` takes over: whole samples, so that u meets p_L."""
    return split_delay(loop.delay, loop.sample_rate)[0] / loop.sample_rate if loop.plant.load_pressure else 0.0


class ValveLaw:
    """The valve law of one loop, ready to run; where the law is linear it lets u pass and has no state."""

    def __init__(self, loop: Loop) -> None:
        self.size = 0
        if loop.plant.load_pressure is None:
            return
        rate, (of_y, *of_derivatives) = loop.sample_rate, loop.plant.load_pressure
        cutoff = min(CUTOFF_RATIO * filter_cutoff(loop), 0.25 * rate)
        moving = np.array([[0.0, *of_derivatives]])
        filtered = sample_system(state_variable_filter(cutoff, ORDER), rate, "foh").output(moving)
        limits = loop.input_limits if loop.input_logged == "before_limiter" else None
        low, high = limits or (-np.inf, np.inf)
        self._constants = ValveConstants(
            A=np.ascontiguousarray(filtered.A),
            B=np.ascontiguousarray(filtered.B[:, 0]),
            C=np.ascontiguousarray(filtered.C[0]),
            D=float(filtered.D[0, 0]) + of_y,
            X0=np.ascontiguousarray(filtered.steady[:, 0]),
            low=low,
            high=high,
            sign=math.copysign(1.0, loop.plant.input_gain),
            delay=split_delay(loop.delay, rate)[0],
        )
        self.size = HEADER_SIZE + len(filtered.A) + self._constants.delay
        self._run = _compile_law()

    def start(self) -> FloatArray:
        """Return the state before the first sample, shape (size,)."""
        return np.zeros(self.size)

    def run(self, state: FloatArray, u: FloatArray, y: FloatArray, restart: BoolArray) -> FloatArray:
        """Return u sqrt(1 - sign(u) p_L/p_s) of a block, delayed, shape (N,), and change `state` (size,) in place.

        It is NaN where u or y is. After a gap, axis and u are assumed to have been constant before.
        """
        if not self.size:
            return u
        out = np.empty(len(u))
        self._run(self._constants, state, u, y, restart, out)
        return out


def _square_root(
    c: ValveConstants, s: FloatArray, u: FloatArray, y: FloatArray, restart: BoolArray, out: FloatArray
) -> None:
    n = len(c.X0)
    x, past = s[HEADER_SIZE : HEADER_SIZE + n], s[HEADER_SIZE + n :]
    new = np.empty(n)
    for k in range(len(u)):
        if not (abs(u[k]) < MAX_PHYSICAL and abs(y[k]) < MAX_PHYSICAL):
            s[ARMED] = 0.0
            out[k] = np.nan
            continue
        now = min(max(u[k], c.low), c.high)
        if restart[k] or s[ARMED] == 0.0:
            s[ARMED] = 1.0
            for i in range(n):
                x[i] = c.X0[i] * y[k]
            past[:] = now
        pressure = c.D * y[k]
        for i in range(n):
            pressure += c.C[i] * x[i]
        for i in range(n):
            new[i] = c.B[i] * y[k]
            for j in range(n):
                new[i] += c.A[i, j] * x[j]
        for i in range(n):
            x[i] = new[i]
        for i in range(c.delay):
            now, past[i] = past[i], now
        left = 1.0 - pressure if c.sign * now > 0.0 else 1.0 + pressure
        out[k] = now * np.sqrt(max(left, 0.0))


@functools.cache
def _compile_law() -> Callable[..., None]:
    from servoscope.core.jit import kernel  # late: it imports Numba

    return kernel(_square_root)
