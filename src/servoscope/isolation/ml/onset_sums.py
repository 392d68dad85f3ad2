"""Sums over innovations by which onsets are compared, compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.core.jit import minimum
from servoscope.core.jit.array_function import ArrayFunction
from servoscope.fit.kernels import (
    Array,
    PlantArrays,
    advance_plant,
    constant_plant,
    drift_place,
    drifting_plant,
    input_before,
    restart_state,
    run_plants,
    samples_since_restart,
)
from servoscope.fit.predictor import PlantVariants, Predictor

MAX_REMAINING_SHARE = 1e-3  # share of its state from before a change that a predictor may still hold


def prepare_sums(
    variants: PlantVariants, step: float, u: FloatArray, y: FloatArray, restart: BoolArray, Q: FloatArray
) -> Callable[[IntArray, IntArray], tuple[FloatArray, FloatArray]]:
    """Return the function from onsets and durations, all of them zero or none, to what `sum_over_onsets` returns."""
    predictor, drifting = variants
    stepping = np.ascontiguousarray(drifting[:, [0, -1]])
    A, K, c = predictor.A[stepping[0]], predictor.K[stepping[0], -1], predictor.c[stepping[0]]
    slowest = float(np.abs(np.linalg.eigvals(A - K[:, :, None] * c[:, None, :])).max())
    settle = min(int(np.ceil(np.log(MAX_REMAINING_SHARE) / np.log(max(min(slowest, 0.9999), 1e-3)))), len(y))
    constant = sum_constant_plants(predictor, stepping, step, u, y, restart, Q)
    age, n, V = samples_since_restart(restart, predictor.S.shape[1]), A.shape[1], len(stepping)
    every, log_S = PlantArrays.of(predictor), np.log(predictor.S)
    signals = u, y, restart, age, np.ascontiguousarray(Q), *constant, np.empty((V, n)), np.empty(V)

    def sums(onsets: IntArray, overs: IntArray) -> tuple[FloatArray, FloatArray]:
        plants = np.ascontiguousarray(drifting) if overs.any() else stepping
        costs, volume = np.empty((len(onsets), V, V + Q.shape[1])), np.empty(len(onsets))
        sum_over_onsets(every, log_S, plants, 1.0 / step, onsets, overs, settle, *signals, costs, volume, n=n)
        return costs, volume

    return sums


def sum_constant_plants(
    predictor: Predictor, plants: IntArray, step: float, u: Array, y: Array, restart: BoolArray, Q: Array
) -> tuple[Array, Array, Array, Array]:
    """Return what `sum_over_onsets` needs of the healthy plant all the way, and of the changed one.

    Returns states of the healthy plant, shape (N + 1, V, n); products of its innovations up to each sample, and of the
    changed plant's, both (N + 1, V, V + m); and the sum of log S of the changed plant relative to the healthy one's
    from each sample on, (N + 1,).
    """
    V, n, N = len(plants), predictor.A.shape[1], len(y)
    log_S, age = np.log(predictor.S), samples_since_restart(restart, predictor.S.shape[1])
    every, signals = PlantArrays.of(predictor), (u, y, restart, age)
    states, x, e = np.zeros((N + 1, V, n)), np.zeros((V, n)), np.empty((V, N))
    trace_states(every, plants, *signals, states, e, n=n)
    before = _cumulative_products(e, 0.0, Q)
    run_plants(every, plants, 0, N, plants.shape[1] - 1, 0, *signals, x, e, False, n=n)
    volume_after = np.zeros(N + 1)
    volume_after[:-1] = np.cumsum((log_S[plants[0, -1]] - log_S[plants[0, 0]])[age][::-1])[::-1]
    return states, before, _cumulative_products(e, 1.0 / step, Q), volume_after


def _cumulative_products(e: Array, by: float, Q: Array) -> Array:
    """Return the sums of products of innovations (V, N), their derivatives and Q, (N + 1, V, V + m), up to a sample."""
    rows = np.vstack([e[:1], (e[1:] - e[0]) * by]).T
    sums = np.zeros((len(rows) + 1, rows.shape[1], rows.shape[1] + Q.shape[1]))
    np.cumsum(rows[:, :, None] * np.hstack([rows, Q])[:, None], axis=0, out=sums[1:])
    return sums


@ArrayFunction
def trace_states(
    printer: Any, plants: PlantArrays, which: Any, u: Any, y: Any, restart: Any, age: Any, states: Any, e: Any, *,
    n: int,
) -> None:  # fmt: skip
    """Take variants through all samples by the first of their plants: states (N + 1, V, n), innovations e (V, N)."""
    for k in printer.loop(0, y.shape[0]):
        restarts = restart[k] > 0
        u_before = input_before(u, k, restarts)
        for v in printer.loop(0, which.shape[0]):
            x = states[k + 1, v]
            for i in range(n):
                x[i] = states[k, v, i]
            p = which[v, 0]
            with printer.when(restarts):
                restart_state(plants, p, x, y[k], n)
            e[v, k] = advance_plant(plants, constant_plant(p), x, u[k], u_before, y[k], age[k], n)


@ArrayFunction
def sum_over_onsets(
    printer: Any, plants: PlantArrays, log_S: Any, which: Any, by: Any, onsets: Any, durations: Any, settle: Any,
    u: Any, y: Any, restart: Any, age: Any, Q: Any, states: Any, before: Any, after: Any, volume_after: Any,
    x: Any, e: Any, sums: Any, volume: Any, *, n: int,
) -> None:  # fmt: skip
    """Sum up innovations for changes that come at many times, and for their derivatives by the sizes.

    Before a change they are those of the healthy plant, and once the predictor has forgotten when it came, those of the
    changed one: only what lies in between is computed for each.

    `which` (V, p): as for `innovations`, variant 0 being as it is and variant i with size i moved by 1/`by`; `onsets,
    durations`: first changed sample and duration of each change, shapes (M,); `settle`: samples after which the
    predictor has forgotten; `Q`: orthonormal columns, shape (N, m); `states, before, after, volume_after`: as
    `sum_constant_plants` returns them; x (V, n) and e (V,) are scratch memory. Writes sums: shape (M, V, V + m):
    products of [e, its derivatives by the sizes] with themselves and with Q; and volume: sum of log S relative to the
    healthy plant's, shape (M,).
    """
    (V, pieces), N = which.shape, y.shape[0]
    last = pieces - 1

    def add_sample(i: Any, k: Any, piece: Any, w: Any) -> None:
        restarts = restart[k] > 0
        u_before = input_before(u, k, restarts)
        for v in printer.loop(0, V):
            p = which[v, piece]
            weigh = constant_plant(p) if w is None else drifting_plant(p, which[v, piece + 1], w)
            with printer.when(restarts):
                restart_state(plants, p, x[v], y[k], n)
            e[v] = advance_plant(plants, weigh, x[v], u[k], u_before, y[k], age[k], n)
        for v in printer.loop(1, V):
            e[v] = (e[v] - e[0]) * by
        for v in printer.loop(0, V):
            for o in printer.loop(0, V):
                sums[i, v, o] = sums[i, v, o] + e[v] * e[o]
            for o in printer.loop(0, Q.shape[1]):
                sums[i, v, V + o] = sums[i, v, V + o] + e[v] * Q[k, o]

    for i in printer.loop(0, onsets.shape[0]):
        onset, duration = onsets[i], durations[i]
        end = minimum(onset + duration, N)
        stop = minimum(end + settle, N)
        for v in printer.loop(0, V):
            for o in range(n):
                x[v, o] = states[onset, v, o]
            for o in printer.loop(0, V + Q.shape[1]):
                sums[i, v, o] = before[onset, v, o] + after[N, v, o] - after[stop, v, o]
        volume[i] = volume_after[end]
        for k in printer.loop(onset, end):
            add_sample(i, k, *drift_place(printer, k - onset, duration, last))
            p = which[0, (k - onset) * last // duration]
            volume[i] = volume[i] + (log_S[p, age[k]] - log_S[which[0, 0], age[k]])
        for k in printer.loop(end, stop):
            add_sample(i, k, last, None)
