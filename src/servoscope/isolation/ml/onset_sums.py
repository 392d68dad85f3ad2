"""Sums over innovations by which onsets are compared, compiled: changes of one duration go side by side."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.core.jit import kernel, subroutine
from servoscope.isolation.ml.kernels import (
    Array,
    inverse_std,
    log_variances,
    run_constant_plant,
    samples_since_restart,
)
from servoscope.isolation.ml.predictor import PlantVariants

MAX_REMAINING_SHARE = 1e-3  # share of its state from before a change that a predictor may still hold
LANES = 32  # changes side by side
VECTOR = 8  # lanes that the processor takes at once; their number is rounded up to it


def prepare_sums(
    variants: PlantVariants, step: float, u: FloatArray, y: FloatArray, restart: BoolArray, Q: FloatArray
) -> Callable[[IntArray, IntArray], tuple[FloatArray, FloatArray]]:
    """Return the function from onsets and durations, all of them zero or none, to what `sum_over_onsets` returns."""
    each, drifting, _ = variants
    stepping = np.ascontiguousarray(drifting[:, [0, -1]])
    A, K, c = each.A[stepping[0]], each.K[stepping[0], -1], each.c[stepping[0]]
    slowest = float(np.abs(np.linalg.eigvals(A - K[:, :, None] * c[:, None, :])).max())
    settle = min(int(np.ceil(np.log(MAX_REMAINING_SHARE) / np.log(max(min(slowest, 0.9999), 1e-3)))), len(y))
    signals = (u, y, restart, Q)
    constant = sum_constant_plants(*each, stepping, step, *signals)

    def sums(onsets: IntArray, overs: IntArray) -> tuple[FloatArray, FloatArray]:
        plants, order = drifting if overs.any() else stepping, np.lexsort((onsets, overs))
        return sum_over_onsets(*each, plants, step, onsets, overs, order, settle, *signals, *constant)

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
    log_S, by = log_variances(S, 0), inverse_std(S, 0)
    for k in range(N):
        run_constant_plant(A, b, b_late, c, K, by, plants, 0, 0, V, k, k + 1, age, u, y, restart, x, x_next, e, 0)
        states[k + 1] = x
    accumulate_products(before, e, 0.0, Q)
    x[:] = 0.0
    run_constant_plant(A, b, b_late, c, K, by, plants, last, 0, V, 0, N, age, u, y, restart, x, x_next, e, 0)
    accumulate_products(after, e, 1.0 / step, Q)
    volume_after = np.zeros(N + 1)
    for k in range(N - 1, -1, -1):
        volume_after[k] = volume_after[k + 1] + log_S[plants[0, last], age[k]] - log_S[plants[0, 0], age[k]]
    return states, before, after, volume_after


@kernel
def sum_over_onsets(
    A: Array, b: Array, b_late: Array, c: Array, K: Array, S: Array, plants: IntArray, step: float,
    onsets: IntArray, durations: IntArray, order: IntArray, settle: int, u: Array, y: Array, restart: BoolArray,
    Q: Array, states: Array, before: Array, after: Array, volume_after: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Sum up innovations for changes that come at many times, and for their derivatives by the sizes.

    Before a change they are those of the healthy plant, and once the predictor has forgotten when it came, those of the
    changed one: only what lies in between is computed for each. Changes of one duration go through the same plants
    sample by sample from their onsets on, so the plants between healthy and changed are interpolated once for all.

    `A, b, b_late, c, K, S, plants`: as for `innovations`, variant 0 being as it is and variant i with size i moved by
    `step`; `onsets, durations`: first changed sample and duration of each change, shapes (M,); `order`: their order by
    duration, then by onset; `settle`: samples after which the predictor has forgotten; `Q`: orthonormal columns, shape
    (N, m); `states, before, after, volume_after`: as `sum_constant_plants` returns them. Returns sums: shape
    (M, V, V + m): products of [e, its derivatives by the sizes] with themselves and with Q; and volume: sum of log S
    relative to the healthy plant's, shape (M,).
    """
    V, last, n = plants.shape[0], plants.shape[1] - 1, A.shape[1]
    N, m, M = len(y), Q.shape[1], len(onsets)
    log_S, by = log_variances(S, 0), inverse_std(S, 0)
    age, youngest = samples_since_restart(restart, K.shape[1]), settled_age(K, S)
    u_before, unsettled = np.zeros(N), np.zeros(N + 1, np.int64)
    for k in range(N):
        u_before[k] = u[k] if restart[k] else u[max(k - 1, 0)]
        unsettled[k + 1] = unsettled[k] + (age[k] < youngest)
    sums, volume = np.zeros((M, V, V + m)), np.zeros(M)
    # a lane for each change; those beyond the last one repeat it
    x, x_next, e = np.zeros((V, n, LANES)), np.zeros((n, LANES)), np.zeros((V, LANES))
    total, columns = np.zeros((V, V + m, LANES)), np.zeros((m, LANES))
    now, late, measured = np.zeros(LANES), np.zeros(LANES), np.zeros(LANES)
    first, at = np.zeros(LANES, np.int64), np.zeros(LANES, np.int64)
    i = 0
    while i < M:
        count, duration = 1, durations[order[i]]
        while count < LANES and i + count < M and durations[order[i + count]] == duration:
            count += 1
        for lane in range((count + VECTOR - 1) // VECTOR * VECTOR):
            one = order[i + min(lane, count - 1)]
            onset = first[lane] = onsets[one]
            stop = min(onset + duration + settle, N)
            for v in range(V):
                for o in range(n):
                    x[v, o, lane] = states[onset, v, o]
                for o in range(V + m):
                    total[v, o, lane] = before[onset, v, o] + after[N, v, o] - after[stop, v, o]
            volume[one] = volume_after[min(onset + duration, N)]
        left = count
        for since in range(duration + settle):
            width, drifting = (left + VECTOR - 1) // VECTOR * VECTOR, since < duration
            for a in range(width):
                at[a] = min(first[a] + since, N - 1)
            for a in range(width):
                now[a], late[a], measured[a] = u[at[a]], u_before[at[a]], y[at[a]]
            for o in range(m):
                for a in range(width):
                    columns[o, a] = Q[at[a], o]
            settled = unsettled[at[left - 1] + 1] == unsettled[at[0]]
            old = age[at[0]]
            piece, w = last - 1, 1.0
            if drifting:
                place = (since + 0.5) / duration * last
                piece = int(place)
                w = place - piece
                p = plants[0, since * last // duration]
                for a in range(left):
                    j = old if settled else age[at[a]]
                    volume[order[i + a]] += log_S[p, j] - log_S[plants[0, 0], j]
            for v in range(V):
                q = plants[v, piece + 1]
                p = plants[v, piece] if drifting else q
                for a in range(width):
                    e[v, a] = measured[a]
                if not settled:
                    restart_lanes(c, p, v, width, at, measured, restart, x)
                for o in range(n):
                    weight = c[p, o] + w * (c[q, o] - c[p, o])
                    for a in range(width):
                        e[v, a] -= weight * x[v, o, a]
                for o in range(n):
                    weight = b[p, o] + w * (b[q, o] - b[p, o])
                    weight_late = b_late[p, o] + w * (b_late[q, o] - b_late[p, o])
                    for a in range(width):
                        x_next[o, a] = weight * now[a] + weight_late * late[a]
                    for k in range(n):
                        weight = A[p, o, k] + w * (A[q, o, k] - A[p, o, k])
                        for a in range(width):
                            x_next[o, a] += weight * x[v, k, a]
                    if settled:
                        weight = K[p, old, o] + w * (K[q, old, o] - K[p, old, o])
                        for a in range(width):
                            x_next[o, a] += weight * e[v, a]
                    else:
                        for a in range(width):
                            j = age[at[a]]
                            x_next[o, a] += (K[p, j, o] + w * (K[q, j, o] - K[p, j, o])) * e[v, a]
                for o in range(n):
                    for a in range(width):
                        x[v, o, a] = x_next[o, a]
                if settled:
                    weight = by[p, old] + w * (by[q, old] - by[p, old])
                    for a in range(width):
                        e[v, a] *= weight
                else:
                    for a in range(width):
                        j = age[at[a]]
                        e[v, a] *= by[p, j] + w * (by[q, j] - by[p, j])
                if v > 0:
                    for a in range(width):
                        e[v, a] = (e[v, a] - e[0, a]) * (1.0 / step)
            for v in range(V):
                for o in range(v, V):
                    for a in range(width):
                        total[v, o, a] += e[v, a] * e[o, a]
                for o in range(m):
                    for a in range(width):
                        total[v, V + o, a] += e[v, a] * columns[o, a]
            while left > 0 and (at[left - 1] == N - 1 or since == duration + settle - 1):  # the latest end first
                left -= 1
                for v in range(V):
                    for o in range(V + m):
                        sums[order[i + left], v, o] = total[min(v, o), max(v, o), left]
            if left == 0:
                break
        i += count
    return sums, volume


@subroutine
def restart_lanes(
    c: Array, p: int, v: int, width: int, at: IntArray, measured: Array, restart: BoolArray, x: Array
) -> None:
    """Put the states x[v] of lanes in which a run begins where y says at once."""
    for a in range(width):
        if restart[at[a]]:
            reach = 0.0
            for o in range(x.shape[1]):
                reach += c[p, o] * c[p, o]
            for o in range(x.shape[1]):
                x[v, o, a] = c[p, o] * measured[a] / reach


@subroutine
def settled_age(K: Array, S: Array) -> int:
    """Return the samples after a restart from which the gains of all plants stay as they are."""
    youngest = 0
    for p in range(K.shape[0]):
        j, same = K.shape[1] - 1, True
        while same and j > youngest:
            same = S[p, j - 1] == S[p, j]
            for o in range(K.shape[2]):
                same = same and K[p, j - 1, o] == K[p, j, o]
            if same:
                j -= 1
        youngest = max(youngest, j)
    return youngest


@functools.partial(subroutine, heap=True)
def accumulate_products(sums: Array, e: Array, by: float, Q: Array) -> None:
    """Sum up products of innovations, their derivatives and Q: sums[k + 1] is what they are up to sample k.

    The derivatives are the differences of the variants e[v] times `by`.
    """
    V, N, m, row = e.shape[0], e.shape[1], Q.shape[1], np.zeros(e.shape[0])
    for k in range(N):
        row[0] = e[0, k]
        for v in range(1, V):
            row[v] = (e[v, k] - row[0]) * by
        for v in range(V):
            for o in range(V):
                sums[k + 1, v, o] = sums[k, v, o] + row[v] * row[o]
            for o in range(m):
                sums[k + 1, v, V + o] = sums[k, v, V + o] + row[v] * Q[k, o]
