"""Sums over innovations by which onsets are compared, compiled."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.core.jit import kernel, subroutine
from servoscope.fit.kernels import (
    Array,
    run_constant_plant,
    run_drifting_plant,
    samples_since_restart,
)
from servoscope.fit.predictor import PlantVariants

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
    signals = (u, y, restart, Q)
    constant = sum_constant_plants(*predictor, stepping, step, *signals)

    def sums(onsets: IntArray, overs: IntArray) -> tuple[FloatArray, FloatArray]:
        plants = drifting if overs.any() else stepping
        return sum_over_onsets(*predictor, plants, step, onsets, overs, settle, *signals, *constant)

    return sums


@kernel
def sum_constant_plants(
    A: Array, b: Array, b_late: Array, c: Array, K: Array, S: Array, plants: IntArray, step: float,
    u: Array, y: Array, restart: BoolArray, Q: Array,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Return what `sum_over_onsets` needs of the healthy plant all the way, and of the changed one.

    Arguments are those of `sum_over_onsets`. Returns states of the healthy plant, shape (N + 1, V, n); products of its
    innovations up to each sample, and of the changed plant's, both (N + 1, V, V + m); and the sum of log S of the
    changed plant relative to the healthy one's from each sample on, (N + 1,).
    """
    V, last, n, L = plants.shape[0], plants.shape[1] - 1, A.shape[1], K.shape[1]
    N, m = len(y), Q.shape[1]
    age = samples_since_restart(restart, L)
    x, x_next, e = np.zeros((V, n)), np.zeros(n), np.zeros((V, N))
    states = np.zeros((N + 1, V, n))
    before, after = np.zeros((N + 1, V, V + m)), np.zeros((N + 1, V, V + m))
    log_S, by = np.log(S), 1.0 / np.sqrt(S)
    for k in range(N):
        run_constant_plant(A, b, b_late, c, K, by, plants, 0, 0, V, k, k + 1, age, u, y, restart, x, x_next, e, 0)
        states[k + 1], before[k + 1] = x, before[k]
        add_products(before[k + 1], e, 0, k, k + 1, 0.0, Q)
    x[:] = 0.0
    run_constant_plant(A, b, b_late, c, K, by, plants, last, 0, V, 0, N, age, u, y, restart, x, x_next, e, 0)
    for k in range(N):
        after[k + 1] = after[k]
        add_products(after[k + 1], e, 0, k, k + 1, 1.0 / step, Q)
    volume_after = np.zeros(N + 1)
    for k in range(N - 1, -1, -1):
        volume_after[k] = volume_after[k + 1] + log_S[plants[0, last], age[k]] - log_S[plants[0, 0], age[k]]
    return states, before, after, volume_after


@kernel
def sum_over_onsets(
    A: Array, b: Array, b_late: Array, c: Array, K: Array, S: Array, plants: IntArray, step: float,
    onsets: IntArray, durations: IntArray, settle: int, u: Array, y: Array, restart: BoolArray,
    Q: Array, states: Array, before: Array, after: Array, volume_after: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Sum up innovations for changes that come at many times, and for their derivatives by the sizes.

    Before a change they are those of the healthy plant, and once the predictor has forgotten when it came, those of the
    changed one: only what lies in between is computed for each.

    `A, b, b_late, c, K, S, plants`: as for `innovations`, variant 0 being as it is and variant i with size i moved by
    `step`; `onsets, durations`: first changed sample and duration of each change, shapes (M,); `settle`: samples after
    which the predictor has forgotten; `Q`: orthonormal columns, shape (N, m); `states, before, after, volume_after`: as
    `sum_constant_plants` returns them. Returns sums: shape (M, V, V + m): products of [e, its derivatives by the sizes]
    with themselves and with Q; and volume: sum of log S relative to the healthy plant's, shape (M,).
    """
    V, last, N, M = plants.shape[0], plants.shape[1] - 1, len(y), len(onsets)
    log_S, by, age = np.log(S), 1.0 / np.sqrt(S), samples_since_restart(restart, K.shape[1])
    sums, volume = np.zeros((M, V, V + Q.shape[1])), np.zeros(M)
    x, x_next, e = np.zeros((V, A.shape[1])), np.zeros(A.shape[1]), np.zeros((V, N))
    for i in range(M):
        onset, duration = onsets[i], durations[i]
        end = min(onset + duration, N)
        stop = min(end + settle, N)
        x[:] = states[onset]
        run_drifting_plant(
            A, b, b_late, c, K, by, plants, V, onset, duration, onset, end, age, u, y, restart, x, x_next, e, onset
        )
        run_constant_plant(
            A, b, b_late, c, K, by, plants, last, 0, V, end, stop, age, u, y, restart, x, x_next, e, onset
        )
        sums[i], volume[i] = before[onset] + after[N] - after[stop], volume_after[end]
        add_products(sums[i], e, onset, onset, stop, 1.0 / step, Q)
        for k in range(onset, end):
            volume[i] += log_S[plants[0, (k - onset) * last // duration], age[k]] - log_S[plants[0, 0], age[k]]
    return sums, volume


@subroutine
def add_products(total: Array, e: Array, first: int, begin: int, end: int, by: float, Q: Array) -> None:
    """Add products of innovations, their derivatives and Q over samples begin to end; ``e[v, k - first]`` are at k."""
    V = e.shape[0]
    for k in range(begin, end):
        for v in range(V):
            row = e[v, k - first] if v == 0 else (e[v, k - first] - e[0, k - first]) * by
            for o in range(V):
                total[v, o] += row * (e[o, k - first] if o == 0 else (e[o, k - first] - e[0, k - first]) * by)
            for o in range(Q.shape[1]):
                total[v, V + o] += row * Q[k, o]
