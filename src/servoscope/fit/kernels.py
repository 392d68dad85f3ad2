"""The compiled loops of the exact predictor: innovations through changing plants."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import BoolArray, IntArray
from servoscope.core.jit import kernel, subroutine

Array = npt.NDArray[Any]  # float64, or complex128 for complex-step derivatives


@kernel
def innovations(
    A: Array, b: Array, b_late: Array, c: Array, K: Array, S: Array, plants: IntArray, onset: int, duration: int,
    u: Array, y: Array, restart: BoolArray,
) -> Array:  # fmt: skip
    """Return e(k) = y(k) - y_hat(k | k-1) in standard deviations, shape (V, N), through changes of the plant.

    A (P, n, n), b, late and c (P, n), gains K (P, L, n) and variances S (P, L) are those of P plants. Variant v goes
    through ``plants[v]`` of `plants` (V, p): the first one holds up to sample `onset` and the last one from `duration`
    samples later on; in between it goes through the others, evenly and in straight lines. The state goes on. All are
    multiplied by one factor, the geometric mean of the deviations relative to the first plant's, so that the sum of
    squares ranks hypotheses as the likelihood does whose noise is known but for a common factor.
    """
    N, V, last = len(y), plants.shape[0], plants.shape[1] - 1
    e, age = np.empty((V, N), A.dtype), samples_since_restart(restart, S.shape[1])
    x, x_next = np.zeros((V, A.shape[1]), A.dtype), np.zeros(A.shape[1], A.dtype)
    begin, end = min(onset, N), min(onset + duration, N)
    if last == 0:
        begin = N
    by, log_S = 1.0 / np.sqrt(S), np.log(S)
    for v in range(V):
        if v > 0 and plants[v, 0] == plants[v - 1, 0]:  # up to the change it is the variant before
            e[v, :begin], x[v] = e[v - 1, :begin], x[v - 1]
            continue
        run_constant_plant(A, b, b_late, c, K, by, plants, 0, v, v + 1, 0, begin, age, u, y, restart, x, x_next, e, 0)
    run_drifting_plant(
        A, b, b_late, c, K, by, plants, V, onset, duration, begin, end, age, u, y, restart, x, x_next, e, 0
    )
    end = max(begin, end)
    run_constant_plant(A, b, b_late, c, K, by, plants, last, 0, V, end, N, age, u, y, restart, x, x_next, e, 0)
    for v in range(V):
        volume, first = 0.0 * A[0, 0, 0], plants[v, 0]
        for k in range(begin, N):
            p = plants[v, last if k >= end else (k - onset) * last // duration]
            volume += log_S[p, age[k]] - log_S[first, age[k]]
        e[v] *= np.exp(0.5 * volume / N)
    return e


@kernel
def samples_since_restart(restart: BoolArray, L: int) -> IntArray:
    """Return the samples since a restart, as far as the gains change with them, shape (N,)."""
    age = np.empty(len(restart), np.int64)
    j = L - 1
    for k in range(len(restart)):
        j = 0 if restart[k] else min(j + 1, L - 1)
        age[k] = j
    return age


@subroutine
def restart_state(c: Array, v: int, p: int, y: float, x: Array) -> None:
    """Put the state x[v] where y says at once; the first covariance knows that the rest is open."""
    reach = 0.0 * x[v, 0]
    for i in range(x.shape[1]):
        reach += c[p, i] * c[p, i]
    for i in range(x.shape[1]):
        x[v, i] = c[p, i] * y / reach


@subroutine
def run_constant_plant(
    A: Array, b: Array, b_late: Array, c: Array, K: Array, by: Array, plants: IntArray, column: int, v_begin: int,
    v_end: int, begin: int, end: int, age: IntArray, u: Array, y: Array, restart: BoolArray, x: Array, x_next: Array,
    e: Array, first: int,
) -> None:  # fmt: skip
    """Take variants through samples begin to end by ``plants[v, column]``: states x[v], innovations e[v, k - first]."""
    n = x.shape[1]
    for k in range(begin, end):
        j, before = age[k], u[k] if restart[k] else u[max(k - 1, 0)]
        for v in range(v_begin, v_end):  # side by side: the processor does one while another waits for its state
            p = plants[v, column]
            if restart[k]:
                restart_state(c, v, p, y[k], x)
            error = y[k] - 0.0 * x[v, 0]
            for i in range(n):
                error -= c[p, i] * x[v, i]
            for i in range(n):
                total = b[p, i] * u[k] + b_late[p, i] * before
                for o in range(n):
                    total += A[p, i, o] * x[v, o]
                x_next[i] = total + K[p, j, i] * error  # the error last: nothing else has to wait for it
            for i in range(n):
                x[v, i] = x_next[i]
            e[v, k - first] = error * by[p, j]


@subroutine
def run_drifting_plant(
    A: Array, b: Array, b_late: Array, c: Array, K: Array, by: Array, plants: IntArray, V: int, onset: int,
    duration: int, begin: int, end: int, age: IntArray, u: Array, y: Array, restart: BoolArray, x: Array,
    x_next: Array, e: Array, first: int,
) -> None:  # fmt: skip
    """Do as `run_constant_plant` while the plants drift through all of ``plants[v]`` from sample `onset` on."""
    n, last = x.shape[1], plants.shape[1] - 1
    for k in range(begin, end):
        place = (k - onset + 0.5) / duration * last
        w = place - int(place)
        j, before = age[k], u[k] if restart[k] else u[max(k - 1, 0)]
        for v in range(V):
            p, q = plants[v, int(place)], plants[v, int(place) + 1]
            if restart[k]:
                restart_state(c, v, p, y[k], x)
            error = y[k] - 0.0 * x[v, 0]
            for i in range(n):
                error -= (c[p, i] + w * (c[q, i] - c[p, i])) * x[v, i]
            for i in range(n):
                total = (b[p, i] + w * (b[q, i] - b[p, i])) * u[k]
                total += (b_late[p, i] + w * (b_late[q, i] - b_late[p, i])) * before
                for o in range(n):
                    total += (A[p, i, o] + w * (A[q, i, o] - A[p, i, o])) * x[v, o]
                x_next[i] = total + (K[p, j, i] + w * (K[q, j, i] - K[p, j, i])) * error
            for i in range(n):
                x[v, i] = x_next[i]
            e[v, k - first] = error * (by[p, j] + w * (by[q, j] - by[p, j]))
