"""Backlash between actuator and sensor: a predictor whose sensor follows the actuator only across a gap."""

from __future__ import annotations

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.core.jit import kernel
from servoscope.fit.kernels import Array, samples_since_restart
from servoscope.isolation.ml.least_squares import minimise_from_grid
from servoscope.isolation.ml.window import RefitWindow

GAP_COUNT = 33  # gaps, in even ratios, before the best is refined


@kernel
def backlash_innovations(
    A: Array, b: Array, b_late: Array, c: Array, K: Array, by: Array, age: IntArray,
    half: float, onset: int, u: Array, y: Array, restart: BoolArray,
) -> Array:  # fmt: skip
    """Return the innovations (in standard deviations), (N,), of a plant whose sensor lags by half a gap.

    From sample `onset` on the sensor stands where the actuator last pushed it, ``|c x - y| <= half``. While it stands
    still y says nothing about the plant, and the state is not corrected.
    """
    n = len(c)
    x, x_next = np.zeros(n), np.zeros(n)
    e, sensor, reach = np.empty(len(y)), 0.0, 0.0
    for i in range(n):
        reach += c[i] * c[i]
    for k in range(len(y)):
        if restart[k]:
            sensor = y[k]
            for i in range(n):
                x[i] = c[i] * y[k] / reach
        moved = 0.0
        for i in range(n):
            moved += c[i] * x[i]
        gap = half if k >= onset else 0.0
        pushed = min(max(sensor, moved - gap), moved + gap)
        seen = 1.0 if gap == 0.0 or pushed != sensor else 0.0
        sensor = pushed
        j, before = age[k], u[k] if restart[k] else u[max(k - 1, 0)]
        error = y[k] - sensor
        for i in range(n):
            x_next[i] = seen * K[j, i] * error + b[i] * u[k] + b_late[i] * before
            for o in range(n):
                x_next[i] += A[i, o] * x[o]
        for i in range(n):
            x[i] = x_next[i]
        e[k] = error * by[j]
    return e


def backlash_of_width(window: RefitWindow, onset: int, width: float) -> FloatArray:
    """Return the innovations (N,) with a gap, in the unit of y, from a sample on; healthy parameters as learned."""
    A, b, b_late, c, K, S = (part[0] for part in window.healthy)
    age, by, half = samples_since_restart(window.restart, len(S)), 1.0 / np.sqrt(S), 0.5 * width
    return backlash_innovations(A, b, b_late, c, K, by, age, half, onset, window.u, window.y, window.restart)


def fit_backlash(window: RefitWindow, onset: int) -> float:
    """Return the width of the gap that explains a window best, in the unit of y."""

    def cost(log_half: float) -> float:
        e = backlash_of_width(window, onset, 2.0 * float(np.exp(log_half)))
        return float(e @ e)

    smallest, largest = 0.1 * window.factory.noise.y_std, 0.5 * float(np.ptp(window.y))
    tried: FloatArray = np.linspace(np.log(smallest), np.log(max(largest, 2.0 * smallest)), GAP_COUNT)
    return 2.0 * float(np.exp(minimise_from_grid(cost, tried, 1e-3)))
