"""The compiled loops of the exact predictor: Kalman gains after a restart, and innovations through changing plants."""

from __future__ import annotations

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
    N, P, L = len(y), A.shape[1], S.shape[2]
    e = np.empty(N, A.dtype)
    x, following = np.zeros((1, A.shape[2]), A.dtype), np.zeros(A.shape[2], A.dtype)
    j, volume = L - 1, 0.0 * A[0, 0, 0, 0]
    for k in range(N):
        if restart[k]:
            j = 0
        p, q, w = _plant(k, since, over, P)
        e[k] = _advance(A, b, late, c, K, S, 0, p, q, w, j, k, u, y, restart, x, following)
        volume += np.log(S[0, p, j] / S[0, 0, j])
        j = min(j + 1, L - 1)
    scaled: Array = e * np.exp(0.5 * volume / N)
    return scaled


@kernel
def _plant(k: int, since: int, over: int, P: int) -> tuple[int, int, float]:
    """Return the plants p and q between which that of sample k lies, and its share of q."""
    if k < since:
        return 0, 0, 0.0
    if k >= since + over:
        return P - 1, P - 1, 0.0
    place = (k - since + 0.5) / over * (P - 1)
    p = int(place)
    return p, p + 1, place - p


@kernel
def _advance(
    A: Array, b: Array, late: Array, c: Array, K: Array, S: Array, v: int, p: int, q: int, w: float, j: int, k: int,
    u: Array, y: Array, restart: BoolArray, x: Array, following: Array,
) -> Any:  # fmt: skip
    """Take variant v through sample k, by plants p and q mixed; returns its innovation in standard deviations."""
    n = x.shape[1]
    if restart[k]:
        reach = 0.0 * x[v, 0]
        for i in range(n):
            reach += c[v, p, i] * c[v, p, i]
        for i in range(n):  # what y says at once; the first covariance knows that the rest is open
            x[v, i] = c[v, p, i] * y[k] / reach
    error = y[k] - 0.0 * x[v, 0]
    before = u[k] if restart[k] else u[max(k - 1, 0)]
    variance = _mixed(S[v, p, j], S[v, q, j], w)
    if w == 0.0:
        for i in range(n):
            error -= c[v, p, i] * x[v, i]
        for i in range(n):
            total = K[v, p, j, i] * error + b[v, p, i] * u[k] + late[v, p, i] * before
            for o in range(n):
                total += A[v, p, i, o] * x[v, o]
            following[i] = total
    else:
        for i in range(n):
            error -= _mixed(c[v, p, i], c[v, q, i], w) * x[v, i]
        for i in range(n):
            total = _mixed(K[v, p, j, i], K[v, q, j, i], w) * error
            total += _mixed(b[v, p, i], b[v, q, i], w) * u[k] + _mixed(late[v, p, i], late[v, q, i], w) * before
            for o in range(n):
                total += _mixed(A[v, p, i, o], A[v, q, i, o], w) * x[v, o]
            following[i] = total
    for i in range(n):
        x[v, i] = following[i]
    return error / np.sqrt(variance)


@kernel
def _mixed(one: Any, other: Any, share: float) -> Any:
    return one + share * (other - one)


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
    V, P, n, L = A.shape[0], A.shape[1], A.shape[2], K.shape[2]
    N, m, M = len(y), Q.shape[1], len(onsets)
    W = V + m
    age = np.zeros(N, np.int64)  # samples since a restart, as far as the gains change
    j = L - 1
    for k in range(N):
        j = 0 if restart[k] else min(j + 1, L - 1)
        age[k] = j
    row, x, following = np.zeros(W), np.zeros((V, n)), np.zeros(n)
    states, changed = np.zeros((N + 1, V, n)), np.zeros((N, V))
    before, after, volume_after = np.zeros((N + 1, V, W)), np.zeros((N + 1, V, W)), np.zeros(N + 1)
    for k in range(N):  # the healthy plant all the way
        for v in range(V):
            row[v] = _advance(A, b, late, c, K, S, v, 0, 0, 0.0, age[k], k, u, y, restart, x, following)
            for i in range(n):
                states[k + 1, v, i] = x[v, i]
        _add(before[k], before[k + 1], row, 0.0, Q, k, V)
    for v in range(V):
        for i in range(n):
            x[v, i] = 0.0
    for k in range(N):  # and the changed one
        for v in range(V):
            changed[k, v] = _advance(A, b, late, c, K, S, v, P - 1, P - 1, 0.0, age[k], k, u, y, restart, x, following)
    for k in range(N - 1, -1, -1):
        for v in range(V):
            row[v] = changed[k, v]
        _add(after[k + 1], after[k], row, 1.0 / step, Q, k, V)
        volume_after[k] = volume_after[k + 1] + np.log(S[0, P - 1, age[k]] / S[0, 0, age[k]])
    sums, volume = np.zeros((M, V, W)), np.zeros(M)
    for i in range(M):
        onset, over = onsets[i], overs[i]
        stop = min(onset + over + settle, N)
        volume[i] = volume_after[stop]
        for v in range(V):
            for o in range(n):
                x[v, o] = states[onset, v, o]
            for o in range(W):
                sums[i, v, o] = before[onset, v, o] + after[stop, v, o]
        for k in range(onset, stop):
            p, q, w = _plant(k, onset, over, P)
            for v in range(V):
                row[v] = _advance(A, b, late, c, K, S, v, p, q, w, age[k], k, u, y, restart, x, following)
            _add(sums[i], sums[i], row, 1.0 / step, Q, k, V)
            volume[i] += np.log(S[0, p, age[k]] / S[0, 0, age[k]])
    return sums, volume


@kernel
def _add(old: Array, new: Array, row: Array, by: float, Q: Array, k: int, V: int) -> None:
    """Add to sums the products of [e, its derivatives] with themselves and with Q's row k.

    `row` holds the innovations of the variants, and afterwards their derivatives: differences times `by`.
    """
    for v in range(1, V):
        row[v] = (row[v] - row[0]) * by
    for v in range(V):
        for other in range(V):
            new[v, other] = old[v, other] + row[v] * row[other]
        for q in range(Q.shape[1]):
            new[v, V + q] = old[v, V + q] + row[v] * Q[k, q]
