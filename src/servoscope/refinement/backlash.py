"""Backlash between actuator and sensor: a predictor whose sensor follows the actuator only across a gap."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servoscope.compiled import kernel
from servoscope.plants import FloatArray
from servoscope.refinement.kernels import Array, BoolArray, IntArray, ages
from servoscope.refinement.window import Growth, Window

TRIED = 33  # gaps, in even ratios, before the best is refined


@kernel
def follow(
    A: Array, b: Array, late: Array, c: Array, K: Array, by: Array, age: IntArray,
    half: float, since: int, u: Array, y: Array, restart: BoolArray,
) -> float:  # fmt: skip
    """Return the sum of squared innovations (in standard deviations) of a plant whose sensor lags by half a gap.

    From sample `since` on the sensor stands where the actuator last pushed it, ``|c x - y| <= half``. While it stands
    still y says nothing about the plant, and the state is not corrected.
    """
    n = len(c)
    x, following = np.zeros(n), np.zeros(n)
    total, sensor, reach = 0.0, 0.0, 0.0
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
        gap = half if k >= since else 0.0
        pushed = min(max(sensor, moved - gap), moved + gap)
        seen = 1.0 if gap == 0.0 or pushed != sensor else 0.0
        sensor = pushed
        j, before = age[k], u[k] if restart[k] else u[max(k - 1, 0)]
        error = y[k] - sensor
        for i in range(n):
            following[i] = seen * K[j, i] * error + b[i] * u[k] + late[i] * before
            for o in range(n):
                following[i] += A[i, o] * x[o]
        for i in range(n):
            x[i] = following[i]
        total += (error * by[j]) ** 2
    return total


class Gap(NamedTuple):
    """Width of a gap, in the unit of y, and the sum of squares with it."""

    width: float
    J: float


def backlash(window: Window, growth: Growth) -> Gap:
    """Return the gap that explains a window best.

    The healthy parameters are taken as learned, and a change over some time as one in its middle.
    """
    from scipy.optimize import minimize_scalar

    A, b, late, c, K, S = (part[0] for part in window.healthy)
    age, by = ages(window.restart, len(S)), 1.0 / np.sqrt(S)
    since = growth.since + growth.over // 2

    def cost(log_half: float) -> float:
        half = float(np.exp(log_half))
        return float(follow(A, b, late, c, K, by, age, half, since, window.u, window.y, window.restart))

    smallest, largest = 0.1 * window.bench.noise.y_std, 0.5 * float(np.ptp(window.y))
    tried: FloatArray = np.linspace(np.log(smallest), np.log(max(largest, 2.0 * smallest)), TRIED)
    at = int(np.argmin([cost(x) for x in tried]))
    bracket = float(tried[max(at - 1, 0)]), float(tried[min(at + 1, TRIED - 1)])
    found = minimize_scalar(cost, bounds=bracket, method="bounded", options={"xatol": 1e-3})
    best = min((float(tried[at]), float(found.x)), key=cost)
    return Gap(2.0 * float(np.exp(best)), cost(best))
