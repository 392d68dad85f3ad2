"""The compiled loops of the exact predictor: innovations through changing plants."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import BoolArray, IntArray
from servoscope.core.jit import maximum, where
from servoscope.core.jit.array_function import ArrayFunction

Array = npt.NDArray[Any]  # float64, or complex128 for complex-step derivatives


class PlantArrays(NamedTuple):
    """Predictors of P plants: A (P, n, n), b, b_late and c (P, n), gains K (P, L, n) and 1/sqrt(S) (P, L)."""

    A: Any
    b: Any
    b_late: Any
    c: Any
    K: Any
    inverse_std: Any

    @classmethod
    def of(cls, predictor: tuple[Array, ...]) -> Self:
        """Return the arrays of a predictor, or of several in a row, whose last one is S."""
        A, b, b_late, c, K, S = predictor
        return cls(A, b, b_late, c, K, 1.0 / np.sqrt(S))


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
    N, (V, pieces), n = len(y), plants.shape, A.shape[1]
    last, age = pieces - 1, samples_since_restart(restart, S.shape[1])
    e, x, plants = np.empty((V, N), A.dtype), np.zeros((V, n), A.dtype), np.ascontiguousarray(plants)
    begin = min(onset, N) if last else N
    end = max(begin, min(onset + duration, N))
    every, signals = PlantArrays.of((A, b, b_late, c, K, S)), (u, y, restart, age)
    run = functools.partial(run_plants, every, n=n)
    for v in range(V):
        if v > 0 and plants[v, 0] == plants[v - 1, 0]:  # up to the change it is the variant before
            e[v, :begin], x[v] = e[v - 1, :begin], x[v - 1]
        else:
            run(plants[v : v + 1], 0, begin, 0, 0, *signals, x[v : v + 1], e[v : v + 1], False)
    if end > begin:
        run(plants, begin, end, onset, duration, *signals, x, e, True)
    run(plants, end, N, last, 0, *signals, x, e, False)
    bounds = [min(onset - -piece * duration // last, N) for piece in range(last)] + [end, N]
    log_S, volume = np.log(S), np.zeros(V, A.dtype)
    for piece, (first, stop) in enumerate(itertools.pairwise(bounds if last else (N, N))):
        counts = np.bincount(age[first:stop], minlength=S.shape[1])
        volume += (log_S[plants[:, piece]] - log_S[plants[:, 0]]) @ counts
    return e * np.exp(0.5 * volume / N)[:, None]


def samples_since_restart(restart: BoolArray, L: int) -> IntArray:
    """Return the samples since a restart, as far as the gains change with them, shape (N,)."""
    k = np.arange(len(restart))
    return np.minimum(k - np.maximum.accumulate(np.where(restart, k, -L)), L - 1)


def advance_plant(
    plants: PlantArrays, weigh: Callable[..., Any], x: Any, u: Any, u_before: Any, y: Any, age: Any, n: int
) -> Any:
    """Write how one sample moves the state x (n,); return the innovation in standard deviations.

    `weigh` returns an element of an array of the plants, between two of them while they drift.
    """
    error = y
    state = [x[i] for i in range(n)]
    for i in range(n):
        error = error - weigh(plants.c, i) * state[i]
    for i in range(n):
        total = weigh(plants.b, i) * u + weigh(plants.b_late, i) * u_before
        for o in range(n):
            total = total + weigh(plants.A, i, o) * state[o]
        x[i] = total + weigh(plants.K, age, i) * error  # the error last: nothing else has to wait for it
    return error * weigh(plants.inverse_std, age)


def constant_plant(p: Any) -> Callable[..., Any]:
    """Return the elements of plant p."""
    return lambda part, *index: part[(p, *index)]


def drifting_plant(p: Any, q: Any, w: Any) -> Callable[..., Any]:
    """Return elements between plants p and q, by the weight w."""

    def weigh(part: Any, *index: Any) -> Any:
        value = part[(p, *index)]
        return value + (part[(q, *index)] - value) * w

    return weigh


def drift_place(printer: Any, since: Any, duration: Any, pieces: Any) -> tuple[Any, Any]:
    """Return the piece of a drift that a sample is in, and the weight of what it leads to."""
    place = (printer.number(since) + 0.5) / printer.number(duration) * printer.number(pieces)
    piece = printer.truncate(place)
    return piece, place - printer.number(piece)


def restart_state(plants: PlantArrays, p: Any, x: Any, y: Any, n: int) -> None:
    """Write how a state begins where y says at once; the first covariance knows that the rest is open."""
    reach = 0.0
    for i in range(n):
        reach = plants.c[p, i] * plants.c[p, i] + reach
    for i in range(n):
        x[i] = plants.c[p, i] * y / reach


def input_before(u: Any, k: Any, restarts: Any) -> Any:
    """Return u of the sample before, or of this one where a run begins."""
    return u[where(restarts, k, maximum(k - 1, 0))]


@ArrayFunction
def run_plants(
    printer: Any, plants: PlantArrays, which: Any, begin: Any, end: Any, onset: Any, duration: Any,
    u: Any, y: Any, restart: Any, age: Any, x: Any, e: Any, drifts: bool, *, n: int,
) -> None:  # fmt: skip
    """Take variants (V, p) from sample `begin` to `end`: states x (V, n), innovations e (V, N).

    While they drift, they go through all of ``which[v]`` in `duration` from sample `onset` on; else all stay at the
    column `onset`.
    """
    for k in printer.loop(begin, end):
        restarts = restart[k] > 0
        u_before, piece, w = input_before(u, k, restarts), onset, 0.0
        if drifts:
            piece, w = drift_place(printer, k - onset, duration, which.shape[1] - 1)
        for v in printer.loop(0, which.shape[0]):  # the processor does one while another waits for its state
            p = which[v, piece]
            weigh = drifting_plant(p, which[v, piece + 1], w) if drifts else constant_plant(p)
            with printer.when(restarts):
                restart_state(plants, p, x[v], y[k], n)
            e[v, k] = advance_plant(plants, weigh, x[v], u[k], u_before, y[k], age[k], n)
