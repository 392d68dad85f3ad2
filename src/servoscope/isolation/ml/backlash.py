"""Backlash between actuator and sensor: a predictor whose sensor follows the actuator only across a gap."""

from __future__ import annotations

from typing import Any

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.jit import maximum, minimum, where
from servoscope.core.jit.array_function import ArrayFunction
from servoscope.core.jit.arrays import Variable
from servoscope.fit.kernels import PlantArrays, input_before, restart_state, samples_since_restart
from servoscope.fit.predictor import Predictor
from servoscope.fit.search import minimise_from_grid
from servoscope.isolation.ml.window import RefitWindow

GAP_COUNT = 33  # gaps, in even ratios, before the best is refined


@ArrayFunction
def backlash_innovations(
    printer: Any, plants: PlantArrays, half: Any, onset: Any, u: Any, y: Any, restart: Any, age: Any,
    x: Any, e: Any, *, n: int,
) -> None:  # fmt: skip
    """Write the innovations e (N,), in standard deviations, of a plant whose sensor lags by half a gap.

    From sample `onset` on the sensor stands where the actuator last pushed it, ``|c x - y| <= half``. While it stands
    still y says nothing about the plant, and the state x (n,) is not corrected.
    """
    A, b, b_late, c, K, inverse_std = (part[0] for part in plants)
    sensor = Variable(printer, 0.0)
    for k in printer.loop(0, y.shape[0]):
        restarts = restart[k] > 0
        with printer.when(restarts):
            sensor.value = y[k]
            restart_state(plants, 0, x, y[k], n)
        state, moved = [x[i] for i in range(n)], 0.0
        for i in range(n):
            moved = c[i] * state[i] + moved
        gap = where(k >= onset, half, 0.0)
        pushed = minimum(maximum(sensor.value, moved - gap), moved + gap)
        seen = where(gap.is_equal(0.0) | ~pushed.is_equal(sensor.value), 1.0, 0.0)
        sensor.value = pushed
        error = y[k] - pushed
        for i in range(n):
            total = seen * K[age[k], i] * error + b[i] * u[k] + b_late[i] * input_before(u, k, restarts)
            for o in range(n):
                total = total + A[i, o] * state[o]
            x[i] = total
        e[k] = error * inverse_std[age[k]]


def backlash_of_width(window: RefitWindow, onset: int, width: float) -> FloatArray:
    """Return the innovations (N,) with a gap, in the unit of y, from a sample on; healthy parameters as learned."""
    healthy = Predictor(*(np.ascontiguousarray(part[:1]) for part in window.healthy))
    age, n, e = samples_since_restart(window.restart, healthy.S.shape[1]), healthy.A.shape[1], np.empty(window.samples)
    plants, signals = PlantArrays.of(healthy), (window.u, window.y, window.restart, age)
    backlash_innovations(plants, 0.5 * width, onset, *signals, np.zeros(n), e, n=n)
    return e


def fit_backlash(window: RefitWindow, onset: int) -> float:
    """Return the width of the gap that explains a window best, in the unit of y."""

    def cost(log_half: float) -> float:
        e = backlash_of_width(window, onset, 2.0 * float(np.exp(log_half)))
        return float(e @ e)

    smallest, largest = 0.1 * window.factory.noise.y_std, 0.5 * float(np.ptp(window.y))
    tried: FloatArray = np.linspace(np.log(smallest), np.log(max(largest, 2.0 * smallest)), GAP_COUNT)
    return 2.0 * float(np.exp(minimise_from_grid(cost, tried, 1e-3)))
