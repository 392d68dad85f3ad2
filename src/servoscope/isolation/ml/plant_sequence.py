"""The likeliest sequence of plants through a window, when each switch from one to another costs something."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from servoscope.core.arrays import FloatArray, IntArray
from servoscope.core.jit import where
from servoscope.core.jit.array_function import ArrayFunction
from servoscope.core.jit.arrays import Variable
from servoscope.fit.kernels import (
    Array,
    PlantArrays,
    advance_plant,
    constant_plant,
    input_before,
    restart_state,
    run_plants,
    samples_since_restart,
)
from servoscope.fit.predictor import Predictor
from servoscope.isolation.ml.window import RefitWindow


def likeliest_sequence(window: RefitWindow, predictors: Sequence[Predictor], prices: FloatArray) -> IntArray:
    """Return which of V plants, of which the first is healthy, holds at each sample, (N,); `prices` (V,) of switches.

    Dynamic programming over the plant of each sample (Viterbi, 1967). The state goes on through a switch, so each plant
    keeps that of the cheapest sequence that ends in it (per-survivor processing; Raheli, Polydoros and Tzou, 1995). A
    late switch may win at first, so that this is near the optimum, no more. Not to begin healthy is a switch too.
    """
    previous = np.empty((window.samples, len(predictors)), dtype=np.int64)
    plants_of, volume = _stack(predictors)
    V, n = plants_of.b.shape
    cost, x, age = np.array(prices, dtype=np.float64), np.zeros((V, n)), window_age(window, volume)
    cost[0] = 0.0
    signals = window.u, window.y, window.restart, age
    switching_costs(plants_of, volume, prices, *signals, x, cost, previous, n=n)
    at, plants = int(np.argmin(cost)), np.empty(window.samples, dtype=np.int64)
    for k in range(window.samples - 1, -1, -1):
        plants[k] = at
        at = int(previous[k, at])
    return plants


class SequenceCost:
    """-2 log likelihood, but for a constant, of plants that hold one after the other."""

    def __init__(self, window: RefitWindow, healthy: Predictor, predictors: Sequence[Predictor]) -> None:
        self.window, (self.plants, self.volume) = window, _stack([healthy, *predictors])

    def __call__(self, starts: Sequence[int]) -> float:
        """Return it for their first samples, (V,), of which the first is 0; the state goes on."""
        window, (V, n) = self.window, self.plants.b.shape
        age, x, e, cost = window_age(window, self.volume), np.zeros((1, n)), np.empty((1, window.samples)), 0.0
        signals = window.u, window.y, window.restart, age
        for v, (begin, end) in zip(range(1, V), itertools.pairwise([*starts, window.samples]), strict=True):
            run_plants(self.plants, np.array([[v]]), begin, end, 0, 0, *signals, x, e, False, n=n)
            cost += float(e[0, begin:end] @ e[0, begin:end] + self.volume[v, age[begin:end]].sum())
        return cost


def window_age(window: RefitWindow, volume: Array) -> IntArray:
    """Return the samples since a restart of a window, as far as the gains change with them."""
    return samples_since_restart(window.restart, volume.shape[1])


def _stack(predictors: Sequence[Predictor]) -> tuple[PlantArrays, Array]:
    """Return the last plant of each predictor, and log S relative to the first one's."""
    last = Predictor(*(np.stack([part[-1] for part in parts]) for parts in zip(*predictors, strict=True)))
    return PlantArrays.of(last), np.log(last.S / last.S[:1])


@ArrayFunction
def switching_costs(
    printer: Any, plants: PlantArrays, volume: Any, prices: Any, u: Any, y: Any, restart: Any, age: Any,
    x: Any, cost: Any, previous: Any, *, n: int,
) -> None:  # fmt: skip
    """Write the cost of the cheapest sequence that ends in each of V plants, shape (V,).

    `volume`: log S relative to the first plant's, shape (V, L); x (V, n): states, which are zero at first; `cost`
    begins with the prices, 0 for the first plant; `previous` (N, V) becomes the plant of the sample before, on the
    sequence that is in a plant at a sample.
    """
    V = cost.shape[0]
    for k in printer.loop(0, y.shape[0]):
        restarts = restart[k] > 0
        u_before, best = input_before(u, k, restarts), Variable(printer, 0)
        for v in printer.loop(1, V):
            best.value = where(cost[v] < cost[best.value], v, best.value)
        for v in printer.loop(0, V):
            previous[k, v] = v
            with printer.when(cost[best.value] + prices[v] < cost[v]):
                previous[k, v], cost[v] = best.value, cost[best.value] + prices[v]
                for i in range(n):
                    x[v, i] = x[best.value, i]
            with printer.when(restarts):
                restart_state(plants, v, x[v], y[k], n)
            e = advance_plant(plants, constant_plant(v), x[v], u[k], u_before, y[k], age[k], n)
            cost[v] = cost[v] + (e * e + volume[v, age[k]])
