"""The compiled loops of the exact predictor: Kalman gains after a restart, and innovations through changing plants."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.compiled import kernel

Array = npt.NDArray[Any]  # float64, or complex128 for complex-step derivatives
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

SETTLED = 1e-6  # relative change of the gain from which it stays as it is


@kernel
def gains(A: Array, Q: Array, c: Array, r: float, P: Array, K: Array, S: Array) -> None:
    """Fill Kalman gains K (L, n) and innovation variances S (L,) for the samples after a restart.

    ``S = c P c' + r,  K = A P c'/S,  P <- A P A' + Q - K S K'`` from the covariance P (n, n) of the first state, which
    is overwritten (Anderson and Moore, 1979, chapter 4). The last gain stands for all later samples.
    """
    n, L = len(c), len(S)
    zero = 0.0 * A[0, 0]
    Pc, AP = np.zeros_like(c), np.zeros_like(A)
    for j in range(L):
        s = zero + r
        for i in range(n):
            total = zero
            for k in range(n):
                total += P[i, k] * c[k]
            Pc[i] = total
            s += c[i] * total
        S[j] = s
        moved = 0.0
        for i in range(n):
            total = zero
            for k in range(n):
                total += A[i, k] * Pc[k]
            K[j, i] = total / s
            if j > 0:
                moved = max(moved, abs(K[j, i] - K[j - 1, i]) / (abs(K[j, i]) + 1e-300))
        if j > n and moved < SETTLED:
            for later in range(j + 1, L):
                S[later] = s
                for i in range(n):
                    K[later, i] = K[j, i]
            return
        for i in range(n):
            for k in range(n):
                total = zero
                for q in range(n):
                    total += A[i, q] * P[q, k]
                AP[i, k] = total
        for i in range(n):
            for k in range(n):
                total = Q[i, k] - K[j, i] * s * K[j, k]
                for q in range(n):
                    total += AP[i, q] * A[k, q]
                P[i, k] = total


@kernel
def innovations(
    A: Array, b: Array, late: Array, c: Array, K: Array, S: Array, since: int, over: int,
    u: Array, y: Array, restart: BoolArray,
) -> Array:  # fmt: skip
    """Return e(k) = y(k) - y_hat(k | k-1) in standard deviations, shape (N,), through a change of the plant.

    The first plant holds up to sample `since` and the last one from `over` samples later on; in between it goes
    through the others, evenly and in straight lines. A (1, p, n, n), b, late and c (1, p, n), gains K (1, p, L, n) and
    variances S (1, p, L); the state goes on. All are multiplied by one factor, the geometric mean of the deviations
    relative to the first plant's, so that the sum of squares ranks hypotheses as the likelihood does whose noise is
    known but for a common factor.
    """
    N, last = len(y), A.shape[1] - 1
    e, age = np.empty((1, N), A.dtype), ages(restart, S.shape[2])
    x, following = np.zeros((1, A.shape[2]), A.dtype), np.zeros(A.shape[2], A.dtype)
    begin, end = min(since, N), min(since + over, N)
    if last == 0:
        begin = N
    for changed in range(2):  # a loop, for each call is compiled into its place
        if changed:
            drift(A, b, late, c, K, S, 0, since, over, begin, end, age, u, y, restart, x, following, e, 0)
        first, stop = (max(begin, end), N) if changed else (0, begin)
        hold(A, b, late, c, K, S, 0, changed * last, first, stop, age, u, y, restart, x, following, e, 0)
    volume = 0.0 * A[0, 0, 0, 0]
    for k in range(begin, N):
        p = last if k >= end else (k - since) * last // over
        volume += np.log(S[0, p, age[k]] / S[0, 0, age[k]])
    scaled: Array = e[0] * np.exp(0.5 * volume / N)
    return scaled


@kernel
def ages(restart: BoolArray, L: int) -> IntArray:
    """Return the samples since a restart, as far as the gains change with them, shape (N,)."""
    age = np.empty(len(restart), np.int64)
    j = L - 1
    for k in range(len(restart)):
        j = 0 if restart[k] else min(j + 1, L - 1)
        age[k] = j
    return age


@functools.partial(kernel, heap=False)
def hold(
    A: Array, b: Array, late: Array, c: Array, K: Array, S: Array, v: int, p: int, begin: int, end: int,
    age: IntArray, u: Array, y: Array, restart: BoolArray, x: Array, following: Array, e: Array, first: int,
) -> None:  # fmt: skip
    """Take variant v through samples begin to end by plant p: its state x[v], its innovations into e[v, k - first]."""
    n = x.shape[1]
    for k in range(begin, end):
        if restart[k]:  # what y says at once; the first covariance knows that the rest is open
            reach = 0.0 * x[v, 0]
            for i in range(n):
                reach += c[v, p, i] * c[v, p, i]
            for i in range(n):
                x[v, i] = c[v, p, i] * y[k] / reach
        j, before = age[k], u[k] if restart[k] else u[max(k - 1, 0)]
        error = y[k] - 0.0 * x[v, 0]
        for i in range(n):
            error -= c[v, p, i] * x[v, i]
        for i in range(n):
            total = K[v, p, j, i] * error + b[v, p, i] * u[k] + late[v, p, i] * before
            for o in range(n):
                total += A[v, p, i, o] * x[v, o]
            following[i] = total
        for i in range(n):
            x[v, i] = following[i]
        e[v, k - first] = error / np.sqrt(S[v, p, j])


@functools.partial(kernel, heap=False)
def drift(
    A: Array, b: Array, late: Array, c: Array, K: Array, S: Array, v: int, since: int, over: int, begin: int, end: int,
    age: IntArray, u: Array, y: Array, restart: BoolArray, x: Array, following: Array, e: Array, first: int,
) -> None:  # fmt: skip
    """Do as `hold` while the plant drifts through all of them from sample `since` on, over so many samples."""
    n, last = x.shape[1], A.shape[1] - 1
    for k in range(begin, end):
        place = (k - since + 0.5) / over * last
        p = int(place)
        q, w = p + 1, place - p
        if restart[k]:
            reach = 0.0 * x[v, 0]
            for i in range(n):
                reach += c[v, p, i] * c[v, p, i]
            for i in range(n):
                x[v, i] = c[v, p, i] * y[k] / reach
        j, before = age[k], u[k] if restart[k] else u[max(k - 1, 0)]
        error = y[k] - 0.0 * x[v, 0]
        for i in range(n):
            error -= (c[v, p, i] + w * (c[v, q, i] - c[v, p, i])) * x[v, i]
        for i in range(n):
            total = (K[v, p, j, i] + w * (K[v, q, j, i] - K[v, p, j, i])) * error
            total += (b[v, p, i] + w * (b[v, q, i] - b[v, p, i])) * u[k]
            total += (late[v, p, i] + w * (late[v, q, i] - late[v, p, i])) * before
            for o in range(n):
                total += (A[v, p, i, o] + w * (A[v, q, i, o] - A[v, p, i, o])) * x[v, o]
            following[i] = total
        for i in range(n):
            x[v, i] = following[i]
        e[v, k - first] = error / np.sqrt(S[v, p, j] + w * (S[v, q, j] - S[v, p, j]))


@kernel
def sweep(
    A: Array, b: Array, late: Array, c: Array, K: Array, S: Array, step: float,
    onsets: IntArray, overs: IntArray, settle: int, u: Array, y: Array, restart: BoolArray, Q: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Sum up innovations for changes that come at many times, and for their derivatives by the sizes.

    Before a change they are those of the healthy plant, and once the predictor has forgotten when it came, those of the
    changed one: only what lies in between is computed for each.

    Parameters
    ----------
    A, b, late, c, K, S
        As for `innovations`, the first axis being variants v (0: as it is; i: size i moved by `step`).
    onsets, overs
        First changed sample and duration of each change, shapes (M,).
    settle
        Samples after which the predictor has forgotten.
    Q
        Orthonormal columns, shape (N, m).

    Returns
    -------
    sums
        Shape (M, v, v + m): products of [e, its derivatives by the sizes] with themselves and with Q.
    volume
        Sum of log S relative to the healthy plant's, shape (M,).
    """
    V, last, n, L = A.shape[0], A.shape[1] - 1, A.shape[2], K.shape[2]
    N, m, M = len(y), Q.shape[1], len(onsets)
    age = ages(restart, L)
    x, following, e = np.zeros((V, n)), np.zeros(n), np.zeros((V, N))
    states = np.zeros((N + 1, V, n))
    before, after = np.zeros((N + 1, V, V + m)), np.zeros((N + 1, V, V + m))
    louder = np.zeros((last + 1, L))
    for p in range(last + 1):
        for j in range(L):
            louder[p, j] = np.log(S[0, p, j] / S[0, 0, j])
    for k in range(N):  # the healthy plant all the way
        for v in range(V):
            hold(A, b, late, c, K, S, v, 0, k, k + 1, age, u, y, restart, x, following, e, 0)
            for i in range(n):
                states[k + 1, v, i] = x[v, i]
    add(before, e, 0, 0, N, 0.0, Q)
    for v in range(V):  # and the changed one
        for i in range(n):
            x[v, i] = 0.0
        hold(A, b, late, c, K, S, v, last, 0, N, age, u, y, restart, x, following, e, 0)
    add(after, e, 0, 0, N, 1.0 / step, Q)
    volume_after = np.zeros(N + 1)
    for k in range(N - 1, -1, -1):
        volume_after[k] = volume_after[k + 1] + louder[last, age[k]]
    sums, volume = np.zeros((M, V, V + m)), np.zeros(M)
    total = np.zeros((N + 1, V, V + m))
    for i in range(M):
        onset, over = onsets[i], overs[i]
        end, stop = min(onset + over, N), min(onset + over + settle, N)
        volume[i] = volume_after[end]
        for k in range(onset, end):
            volume[i] += louder[(k - onset) * last // over, age[k]]
        for v in range(V):
            for o in range(n):
                x[v, o] = states[onset, v, o]
            drift(A, b, late, c, K, S, v, onset, over, onset, end, age, u, y, restart, x, following, e, onset)
            hold(A, b, late, c, K, S, v, last, end, stop, age, u, y, restart, x, following, e, onset)
        for v in range(V):
            for o in range(V + m):
                total[0, v, o] = before[onset, v, o] + after[N, v, o] - after[stop, v, o]
        add(total, e, onset, onset, stop, 1.0 / step, Q)
        for v in range(V):
            for o in range(V + m):
                sums[i, v, o] = total[stop - onset, v, o]
    return sums, volume


@kernel
def add(sums: Array, e: Array, first: int, begin: int, end: int, by: float, Q: Array) -> None:
    """Sum up products of innovations, their derivatives and Q: sums[k - begin + 1] is what they are up to sample k.

    e[v, k - first] are the innovations of the variants; derivatives are their differences times `by`.
    """
    V, m = e.shape[0], Q.shape[1]
    row = np.zeros(V)
    for k in range(begin, end):
        row[0] = e[0, k - first]
        for v in range(1, V):
            row[v] = (e[v, k - first] - row[0]) * by
        for v in range(V):
            for o in range(V):
                sums[k - begin + 1, v, o] = sums[k - begin, v, o] + row[v] * row[o]
            for o in range(m):
                sums[k - begin + 1, v, V + o] = sums[k - begin, v, V + o] + row[v] * Q[k, o]
