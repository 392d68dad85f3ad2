"""The compiled loops of the exact predictor: innovations through changing plants, and their sums."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import BoolArray, IntArray
from servoscope.core.jit import kernel, subroutine

Array = npt.NDArray[Any]  # float64, or complex128 for complex-step derivatives


@kernel
def innovations(
    A: Array, b: Array, b_late: Array, c: Array, K: Array, S: Array, onset: int, duration: int,
    u: Array, y: Array, restart: BoolArray,
) -> Array:  # fmt: skip
    """Return e(k) = y(k) - y_hat(k | k-1) in standard deviations, shape (N,), through a change of the plant.

    The first plant holds up to sample `onset` and the last one from `duration` samples later on; in between it goes
    through the others, evenly and in straight lines. A (1, p, n, n), b, late and c (1, p, n), gains K (1, p, L, n) and
    variances S (1, p, L); the state goes on. All are multiplied by one factor, the geometric mean of the deviations
    relative to the first plant's, so that the sum of squares ranks hypotheses as the likelihood does whose noise is
    known but for a common factor.
    """
    N, last = len(y), A.shape[1] - 1
    e, age, by = np.empty((1, N), A.dtype), samples_since_restart(restart, S.shape[2]), inverse_std(S)
    x, x_next = np.zeros((1, A.shape[2]), A.dtype), np.zeros(A.shape[2], A.dtype)
    begin, end = min(onset, N), min(onset + duration, N)
    if last == 0:
        begin = N
    for changed in range(2):  # a loop, for each call is compiled into its place
        if changed:
            run_drifting_plant(
                A, b, b_late, c, K, by, 0, onset, duration, begin, end, age, u, y, restart, x, x_next, e, 0
            )
        first, stop = (max(begin, end), N) if changed else (0, begin)
        run_constant_plant(A, b, b_late, c, K, by, 0, changed * last, first, stop, age, u, y, restart, x, x_next, e, 0)
    log_ratios, volume = log_variance_ratios(S), 0.0 * A[0, 0, 0, 0]
    for k in range(begin, N):
        volume += log_ratios[last if k >= end else (k - onset) * last // duration, age[k]]
    scaled: Array = e[0] * np.exp(0.5 * volume / N)
    return scaled


@kernel
def samples_since_restart(restart: BoolArray, L: int) -> IntArray:
    """Return the samples since a restart, as far as the gains change with them, shape (N,)."""
    age = np.empty(len(restart), np.int64)
    j = L - 1
    for k in range(len(restart)):
        j = 0 if restart[k] else min(j + 1, L - 1)
        age[k] = j
    return age


@functools.partial(subroutine, heap=True)
def inverse_std(S: Array) -> Array:
    """Return 1/sqrt(S), shape (v, p, L); most of a settled gain's are the same."""
    by: Array = np.empty_like(S)
    for v in range(S.shape[0]):
        for p in range(S.shape[1]):
            for j in range(S.shape[2]):
                by[v, p, j] = by[v, p, j - 1] if j > 0 and S[v, p, j] == S[v, p, j - 1] else 1.0 / np.sqrt(S[v, p, j])
    return by


@functools.partial(subroutine, heap=True)
def log_variance_ratios(S: Array) -> Array:
    """Return log S of the plants of variant 0 relative to the first one's, shape (p, L)."""
    log_ratios: Array = np.zeros_like(S[0])
    for p in range(1, S.shape[1]):
        for j in range(S.shape[2]):
            if j > 0 and S[0, p, j] == S[0, p, j - 1] and S[0, 0, j] == S[0, 0, j - 1]:
                log_ratios[p, j] = log_ratios[p, j - 1]
            else:
                log_ratios[p, j] = np.log(S[0, p, j] / S[0, 0, j])
    return log_ratios


@subroutine
def restart_state(c: Array, v: int, p: int, y: float, x: Array) -> None:
    """Put the state x[v] where y says at once; the first covariance knows that the rest is open."""
    reach = 0.0 * x[v, 0]
    for i in range(x.shape[1]):
        reach += c[v, p, i] * c[v, p, i]
    for i in range(x.shape[1]):
        x[v, i] = c[v, p, i] * y / reach


@subroutine
def run_constant_plant(
    A: Array, b: Array, b_late: Array, c: Array, K: Array, by: Array, v: int, p: int, begin: int, end: int,
    age: IntArray, u: Array, y: Array, restart: BoolArray, x: Array, x_next: Array, e: Array, first: int,
) -> None:  # fmt: skip
    """Take variant v through samples begin to end by plant p: its state x[v], its innovations into e[v, k - first]."""
    n = x.shape[1]
    for k in range(begin, end):
        if restart[k]:
            restart_state(c, v, p, y[k], x)
        j, before = age[k], u[k] if restart[k] else u[max(k - 1, 0)]
        error = y[k] - 0.0 * x[v, 0]
        for i in range(n):
            error -= c[v, p, i] * x[v, i]
        for i in range(n):
            total = K[v, p, j, i] * error + b[v, p, i] * u[k] + b_late[v, p, i] * before
            for o in range(n):
                total += A[v, p, i, o] * x[v, o]
            x_next[i] = total
        for i in range(n):
            x[v, i] = x_next[i]
        e[v, k - first] = error * by[v, p, j]


@subroutine
def run_drifting_plant(
    A: Array, b: Array, b_late: Array, c: Array, K: Array, by: Array, v: int, onset: int, duration: int, begin: int,
    end: int, age: IntArray, u: Array, y: Array, restart: BoolArray, x: Array, x_next: Array, e: Array, first: int,
) -> None:  # fmt: skip
    """Do as `run_constant_plant` while the plant drifts through all of them from sample `onset` on."""
    n, last = x.shape[1], A.shape[1] - 1
    for k in range(begin, end):
        place = (k - onset + 0.5) / duration * last
        p = int(place)
        q, w = p + 1, place - p
        if restart[k]:
            restart_state(c, v, p, y[k], x)
        j, before = age[k], u[k] if restart[k] else u[max(k - 1, 0)]
        error = y[k] - 0.0 * x[v, 0]
        for i in range(n):
            error -= (c[v, p, i] + w * (c[v, q, i] - c[v, p, i])) * x[v, i]
        for i in range(n):
            total = (K[v, p, j, i] + w * (K[v, q, j, i] - K[v, p, j, i])) * error
            total += (b[v, p, i] + w * (b[v, q, i] - b[v, p, i])) * u[k]
            total += (b_late[v, p, i] + w * (b_late[v, q, i] - b_late[v, p, i])) * before
            for o in range(n):
                total += (A[v, p, i, o] + w * (A[v, q, i, o] - A[v, p, i, o])) * x[v, o]
            x_next[i] = total
        for i in range(n):
            x[v, i] = x_next[i]
        e[v, k - first] = error * (by[v, p, j] + w * (by[v, q, j] - by[v, p, j]))


@kernel
def sum_over_onsets(
    A: Array, b: Array, b_late: Array, c: Array, K: Array, S: Array, step: float,
    onsets: IntArray, durations: IntArray, settle: int, u: Array, y: Array, restart: BoolArray, Q: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Sum up innovations for changes that come at many times, and for their derivatives by the sizes.

    Before a change they are those of the healthy plant, and once the predictor has forgotten when it came, those of the
    changed one: only what lies in between is computed for each.

    `A, b, b_late, c, K, S`: as for `innovations`, the first axis being variants v (0: as it is; i: size i moved by
    `step`); `onsets, durations`: first changed sample and duration of each change, shapes (M,); `settle`: samples after
    which the predictor has forgotten; `Q`: orthonormal columns, shape (N, m); returns sums: shape (M, v, v + m):
    products of [e, its derivatives by the sizes] with themselves and with Q; returns volume: sum of log S relative
    to the healthy plant's, shape (M,).
    """
    V, last, n, L = A.shape[0], A.shape[1] - 1, A.shape[2], K.shape[2]
    N, m, M = len(y), Q.shape[1], len(onsets)
    age = samples_since_restart(restart, L)
    x, x_next, e = np.zeros((V, n)), np.zeros(n), np.zeros((V, N))
    states = np.zeros((N + 1, V, n))
    before, after = np.zeros((N + 1, V, V + m)), np.zeros((N + 1, V, V + m))
    log_ratios, by = log_variance_ratios(S), inverse_std(S)
    for k in range(N):  # the healthy plant all the way
        for v in range(V):
            run_constant_plant(A, b, b_late, c, K, by, v, 0, k, k + 1, age, u, y, restart, x, x_next, e, 0)
            for i in range(n):
                states[k + 1, v, i] = x[v, i]
    accumulate_products(before, e, 0.0, Q)
    for v in range(V):  # and the changed one
        for i in range(n):
            x[v, i] = 0.0
        run_constant_plant(A, b, b_late, c, K, by, v, last, 0, N, age, u, y, restart, x, x_next, e, 0)
    accumulate_products(after, e, 1.0 / step, Q)
    volume_after = np.zeros(N + 1)
    for k in range(N - 1, -1, -1):
        volume_after[k] = volume_after[k + 1] + log_ratios[last, age[k]]
    sums, volume = np.zeros((M, V, V + m)), np.zeros(M)
    row = np.zeros(V)
    for i in range(M):
        onset, duration = onsets[i], durations[i]
        end, stop = min(onset + duration, N), min(onset + duration + settle, N)
        volume[i] = volume_after[end]
        for k in range(onset, end):
            volume[i] += log_ratios[(k - onset) * last // duration, age[k]]
        for v in range(V):
            for o in range(n):
                x[v, o] = states[onset, v, o]
            run_drifting_plant(
                A, b, b_late, c, K, by, v, onset, duration, onset, end, age, u, y, restart, x, x_next, e, onset
            )
            run_constant_plant(A, b, b_late, c, K, by, v, last, end, stop, age, u, y, restart, x, x_next, e, onset)
        for v in range(V):
            for o in range(V + m):
                sums[i, v, o] = before[onset, v, o] + after[N, v, o] - after[stop, v, o]
        for k in range(onset, stop):
            fill_row(row, e, k - onset, 1.0 / step)
            for v in range(V):
                for o in range(V):
                    sums[i, v, o] += row[v] * row[o]
                for o in range(m):
                    sums[i, v, V + o] += row[v] * Q[k, o]
    return sums, volume


@functools.partial(subroutine, heap=True)
def accumulate_products(sums: Array, e: Array, by: float, Q: Array) -> None:
    """Sum up products of innovations, their derivatives and Q: sums[k + 1] is what they are up to sample k."""
    V, N, m, row = e.shape[0], e.shape[1], Q.shape[1], np.zeros(e.shape[0])
    for k in range(N):
        fill_row(row, e, k, by)
        for v in range(V):
            for o in range(V):
                sums[k + 1, v, o] = sums[k, v, o] + row[v] * row[o]
            for o in range(m):
                sums[k + 1, v, V + o] = sums[k, v, V + o] + row[v] * Q[k, o]


@subroutine
def fill_row(row: Array, e: Array, k: int, by: float) -> None:
    """Put the innovations of a sample and their derivatives, the differences of the variants e[v, k] times `by`."""
    row[0] = e[0, k]
    for v in range(1, len(row)):
        row[v] = (e[v, k] - row[0]) * by
