"""The likeliest sequence of plants through a window, when each switch from one to another costs something."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.core.jit import kernel
from servoscope.fit.kernels import Array, run_constant_plant, samples_since_restart
from servoscope.fit.predictor import Predictor
from servoscope.isolation.ml.window import RefitWindow


def likeliest_sequence(window: RefitWindow, predictors: Sequence[Predictor], prices: FloatArray) -> IntArray:
    """Return which of V plants, of which the first is healthy, holds at each sample, (N,); `prices` (V,) of switches.

    Dynamic programming over the plant of each sample (Viterbi, 1967). The state goes on through a switch, so each plant
    keeps that of the cheapest sequence that ends in it (per-survivor processing; Raheli, Polydoros and Tzou, 1995). A
    late switch may win at first, so that this is near the optimum, no more. Not to begin healthy is a switch too.
    """
    previous = np.empty((window.samples, len(predictors)), dtype=np.int64)
    A, b, late, c, K, S, volume = _stack(predictors)
    cost = switching_costs(A, b, late, c, K, S, volume, prices, window.u, window.y, window.restart, previous)
    at, plants = int(np.argmin(cost)), np.empty(window.samples, dtype=np.int64)
    for k in range(window.samples - 1, -1, -1):
        plants[k] = at
        at = int(previous[k, at])
    return plants


class SequenceCost:
    """-2 log likelihood, but for a constant, of plants that hold one after the other."""

    def __init__(self, window: RefitWindow, healthy: Predictor, predictors: Sequence[Predictor]) -> None:
        self.window, self.plants = window, _stack([healthy, *predictors])

    def __call__(self, starts: Sequence[int]) -> float:
        """Return it for their first samples, (V,), of which the first is 0; the state goes on."""
        window = self.window
        A, b, late, c, K, S, volume = self.plants
        bounds = np.array([*starts, window.samples])
        return float(sequence_cost(A, b, late, c, K, S, volume, bounds, window.u, window.y, window.restart))


def _stack(predictors: Sequence[Predictor]) -> tuple[Array, Array, Array, Array, Array, Array, Array]:
    """Return the last plant of each predictor, and log S relative to the first one's."""
    A, b, late, c, K, S = (np.stack([part[-1] for part in parts]) for parts in zip(*predictors, strict=True))
    return A, b, late, c, K, S, np.log(S / S[:1])


@kernel
def sequence_cost(
    A: Array, b: Array, b_late: Array, c: Array, K: Array, S: Array, volume: Array, bounds: IntArray,
    u: Array, y: Array, restart: BoolArray,
) -> float:  # fmt: skip
    """Return what `SequenceCost` does: plant v, from 1 on, holds from sample bounds[v - 1] to bounds[v]."""
    V, n = b.shape
    age, by = samples_since_restart(restart, S.shape[1]), 1.0 / np.sqrt(S)
    plants = np.arange(V).reshape(V, 1)
    x, x_next, e = np.zeros((V, n)), np.zeros(n), np.zeros((V, len(y)))
    cost = 0.0
    for v in range(1, V):
        for i in range(n):
            x[v, i] = x[v - 1, i]
        begin, end = bounds[v - 1], bounds[v]
        run_constant_plant(A, b, b_late, c, K, by, plants, 0, v, v + 1, begin, end, age, u, y, restart, x, x_next, e, 0)
        for k in range(begin, end):
            cost += e[v, k] * e[v, k] + volume[v, age[k]]
    return cost


@kernel
def switching_costs(
    A: Array, b: Array, b_late: Array, c: Array, K: Array, S: Array, volume: Array, prices: FloatArray,
    u: Array, y: Array, restart: BoolArray, previous: IntArray,
) -> Array:  # fmt: skip
    """Return the cost of the cheapest sequence that ends in each of V plants, shape (V,).

    `A, b, b_late, c, K, S`: the plants, shapes (V, ...), as for `innovations`; `volume`: log S relative to the
    first plant's, shape (V, L); `previous` (N, V) becomes the plant of the sample before, on the sequence that is in a
    plant at a sample.
    """
    V, n, N = b.shape[0], b.shape[1], len(y)
    age, by = samples_since_restart(restart, S.shape[1]), 1.0 / np.sqrt(S)
    plants = np.arange(V).reshape(V, 1)
    x, x_next, e = np.zeros((V, n)), np.zeros(n), np.zeros((V, 1))
    cost: Array = prices.copy()
    cost[0] = 0.0
    for k in range(N):
        best = int(np.argmin(cost))
        for v in range(V):
            previous[k, v] = v
            if cost[best] + prices[v] < cost[v]:
                previous[k, v], cost[v] = best, cost[best] + prices[v]
                for i in range(n):
                    x[v, i] = x[best, i]
            run_constant_plant(
                A, b, b_late, c, K, by, plants, 0, v, v + 1, k, k + 1, age, u, y, restart, x, x_next, e, k
            )
            cost[v] += e[v, 0] * e[v, 0] + volume[v, age[k]]
    return cost
