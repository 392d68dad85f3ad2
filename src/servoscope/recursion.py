"""The compiled heart: constant arrays, state and a block of samples -> new state and evaluations.

One sample, a log and a fleet run through the same lines (`servoscope.chain`), compiled for the sizes at hand. The state
of an asset is one row of floats; `Recursion.slices` says what stands where. Splitting a recording anywhere changes
nothing, because everything that is carried from sample to sample stands in that row.
"""

from __future__ import annotations

import functools
import itertools
import os
from collections import namedtuple
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from servoscope import drive, estimators
from servoscope.chain import HEAD, SAMPLE, TILE, Chain, Plan, Sizes
from servoscope.compiled import filled, inlined, kernel, traced
from servoscope.cusum import LAGS, Watch
from servoscope.linear import Linear
from servoscope.plants import FloatArray
from servoscope.straight import coefficients, pattern

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

LANES = {"float64": 16, "float32": 32}  # assets side by side: state and constants stay in the first-level cache
WIDTH = {"float64": 8, "float32": 16}  # numbers in a vector
WATCHED = 8  # CUSUMs are counted in such steps, so that few codes serve many baselines
STEPS = ("tick", "advance", "used", "learn", "prick", "listen", "alarm", "evaluate", "respond", "tell")
ALONE = ("begin", "advance", "learn", "follow", "forget")  # where neighbours may do something else
NOTHING = 1e-12  # of the first coefficient of a filter
WORTH = 200_000  # samples from which a second core pays


class View(NamedTuple):
    """What complete evaluations take; `response` holds Re and Im of E(f).

    `covariance` is that of the baseline (n, n), `origin` (n,) what is said where theta is the baseline's, both in
    physical units, and `response` has shape (2 F, n).
    """

    covariance: FloatArray
    origin: FloatArray
    response: FloatArray


class Constants(NamedTuple):
    """Everything that a loop and a baseline say, as arrays.

    The recursion's coordinates: phi is `basis`' times the physical one, theta what is left when the baseline's is taken
    off and the rest divided by `basis` (n, n). With `steady` they are chosen so that P_d is the identity, and P stays
    there. `theta` is the baseline's in these coordinates, `origin` the same in physical units.

    `bank` and `velocity` are filters, `codes` the non-linear inputs, `limits` and `deadzone` of u; `a` (lags,) and
    `heads` (lags,) are the noise's model as `servoscope.propagation.spread` takes it, `variance` that of v, in updates:
    of every `stride`-th sample; `extra` is the size of the estimator's private state, and `watch` is the sequential
    test.
    """

    estimator: str
    steady: bool
    bank: Linear
    velocity: Linear
    v_of_r: bool
    codes: tuple[int, ...]
    limits: tuple[float, float]
    deadzone: tuple[float, float]
    sign_speed: float
    rest_speed: float
    still_speed: float
    only_moving: bool
    wait: int
    stride: int
    every: int
    scale: FloatArray
    basis: FloatArray
    theta: FloatArray
    origin: FloatArray
    P_d: FloatArray
    R: float
    a: FloatArray
    heads: FloatArray
    variance: float
    memory: float
    extra: int
    watch: Watch | None
    view: View | None = None


def _places(sizes: dict[str, int], begin: int = 0) -> dict[str, int]:
    ends = begin + np.cumsum(list(sizes.values()))
    return {name: int(end) - size for (name, size), end in zip(sizes.items(), ends, strict=True)} | {
        "end": int(ends[-1])
    }


def _shadow(c: Constants) -> Linear:
    """Return r -> [what the healthy loop has as residual, phi], ready for the sequential test."""
    w = c.watch
    assert w is not None
    first = np.concatenate([[1.0], -w.theta])[None, :]
    return Linear(w.A, w.B, np.vstack([first @ w.C, w.C[1:]]), np.vstack([first @ w.D, w.D[1:]]))


def _order(test: Watch) -> int:
    """Return the order of the whitening filter, without coefficients that are zero but for rounding."""
    size = np.maximum(np.abs(test.numerator), np.abs(test.denominator))
    return int(np.flatnonzero(size > NOTHING)[-1])


class Recursion:
    """The recursion of one asset, or of several that share its structure.

    Parameters
    ----------
    constants
        One per asset; all of one structure.
    single
        In single precision.
    """

    def __init__(self, constants: Sequence[Constants], *, single: bool = False) -> None:
        self.constants = tuple(constants)
        first = self.constants[0]
        self._plan = _plan(self.constants)
        self.sizes = self._plan.sizes
        self._type = np.dtype(np.float32 if single else np.float64)
        to = dict(self._plan.to)
        names = list(to)
        spans = {a: slice(HEAD + to[a], HEAD + to[b]) for a, b in itertools.pairwise(names)}
        lowest = HEAD + to["end"]
        self.size = lowest + self.sizes.watched + first.extra
        self.slices = {
            **spans,
            "cusum": slice(lowest, lowest + self.sizes.watched),
            "extra": slice(lowest + self.sizes.watched, self.size),
        }
        self._own = len({id(c) for c in self.constants}) > 1
        table = np.array([_packed(c, self._plan) for c in (self.constants if self._own else (first,))])
        self._table = table
        self._lanes = 1 if (len(self.constants) == 1 and not single) or first.extra else LANES[self._type.name]
        self._blocks = -(-len(self.constants) // self._lanes)
        self._laid = self._layer()
        self._code = machine(self._plan, self._lanes, min(self._lanes, WIDTH[self._type.name]), int(self._own))

    def _layer(self) -> npt.NDArray[Any]:
        """Return the constants as the compiled blocks take them, (blocks, rows times lanes)."""
        if not self._own:
            return np.ascontiguousarray(self._table, dtype=self._type)
        lanes = np.minimum(np.arange(self._blocks * self._lanes), len(self._table) - 1)
        table = self._table[lanes].reshape(self._blocks, self._lanes, -1).swapaxes(1, 2)
        return np.ascontiguousarray(table.reshape(self._blocks, -1), dtype=self._type)

    def start(self) -> FloatArray:
        """Return the states before the first sample, shape (assets, size): theta at the baseline, P = P_d."""
        state = np.zeros((len(self.constants), self.size))
        n, at = self.sizes.n, self.slices
        for row, c in zip(state, self.constants, strict=True):
            row[at["power"]] = c.variance
            if not self.sizes.steady:
                row[at["P"]] = c.P_d.ravel()
        if self.sizes.start:
            state[:, at["Psi"]] = np.eye(n).ravel()
        return state

    def rows(self, state: FloatArray, samples: int) -> IntArray:
        """Return the samples, counted from 0 since the start, at whose end a block of so many evaluates."""
        number, every = int(state[0, SAMPLE]), self.constants[0].every
        return np.arange(number // every + 1, (number + samples) // every + 1) * every - 1

    def run(
        self,
        state: FloatArray,
        r: npt.NDArray[Any],
        u: npt.NDArray[Any],
        y: npt.NDArray[Any],
        restart: BoolArray | None = None,
    ) -> tuple[FloatArray, npt.NDArray[Any]]:
        """Feed a block of samples, shape (assets, N); return the new states and evaluations (assets, K, row)."""
        c = self.constants[0]
        state = np.ascontiguousarray(state)
        new = np.empty_like(state)
        out = np.empty((len(state), len(self.rows(state, r.shape[1])), self.sizes.row), dtype=self._type)
        flags = np.zeros((0, 0), dtype=np.bool_) if restart is None else restart
        signals = state, new, r, u, y, flags, c.every, c.stride

        def part(begin: int, end: int) -> None:
            self._code.block(self._laid, *signals, out, begin, end)

        workers = min(_cores(), self._blocks) if r.size >= WORTH else 1
        if workers == 1:
            part(0, self._blocks)
        else:
            edges = np.linspace(0, self._blocks, 4 * workers + 1).astype(int).tolist()
            with ThreadPoolExecutor(workers) as pool:
                list(pool.map(part, edges[:-1], edges[1:]))
        return new, out

    @property
    def stepper(self) -> tuple[Callable[[FloatArray, FloatArray, float, float, float], bool], FloatArray]:
        """What takes one sample of the first asset, and its first argument; the second is the state (size,)."""
        return machine(self._plan, 1, 1, 1).step, np.ascontiguousarray(self._table[0])

    def look(self, state: FloatArray) -> FloatArray:
        """Return the evaluations of states as they are, shape (assets, row)."""
        out = np.empty((len(state), self.sizes.row))
        machine(self._plan, 1, 1, int(self._own)).look(self._table, np.ascontiguousarray(state), out)
        return out

    def regressors(
        self, state: FloatArray, r: FloatArray, u: FloatArray, y: FloatArray, restart: BoolArray
    ) -> tuple[FloatArray, IntArray]:
        """Return [eta, phi, z] of every sample of the first asset (N, rows), and what it is good for (N,).

        Of the state (size,) the filters are carried on in place.
        """
        out = np.zeros((len(r), self.sizes.rows))  # a missing sample writes nothing
        ok = np.empty(len(r), dtype=np.int64)
        machine(self._plan, 1, 1, 1).regress(self._table[0], state, r, u, y, restart, self.constants[0].stride, out, ok)
        return out, ok


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def structure(c: Constants) -> Hashable:
    """Return what assets must have in common to be followed side by side."""
    plan = _plan([c])
    sizes = plan.sizes._replace(lags=0, memory=0, watched=0, floats=0)
    return plan.estimator, sizes, plan.bank, c.stride, c.every, c.memory


def _plan(constants: Sequence[Constants]) -> Plan:
    first = constants[0]
    watched = [c for c in constants if c.watch is not None]
    shadows = [_shadow(c) for c in watched]
    n, rows = len(first.basis), len(first.bank.C)
    nxs = len(shadows[0].A) if shadows else 0
    memory = max((_order(c.watch) for c in watched if c.watch), default=0)
    heard = max((len(c.watch.limits) for c in watched if c.watch), default=0)
    lags = max(len(c.a) for c in constants)
    speed = 0
    if first.codes or first.only_moving or first.still_speed > 0.0:
        speed = 2 if first.v_of_r else 1
    start = first.view is None
    frequencies = 0 if first.view is None else len(first.view.response) // 2
    to = _places(
        {
            **{"power": 1, "drift": 1, "level": 1, "peak": 1, "x": len(first.bank.A), "velocity": 2 * bool(speed)},
            **{"theta": n, "P": 0 if first.steady else n * n, "S": n * (n + 1) // 2, "M": n * lags},
            **{"Psi": n * n * start, "shadow": nxs, "white": (n + 1) * memory, "psi": (n + LAGS) * bool(nxs)},
        }
    )
    found, seen = pattern([c.bank for c in constants]), pattern(shadows) if shadows else ((), ())
    entries = [sum(len(row) for part in p for row in part) for p in (found, seen)]
    names = ("low", "high", "dead_low", "dead_high", "sign_speed", "rest_speed", "still_speed", "wait", "forget")
    at = _places(
        {
            **dict.fromkeys(("every", "stride", *names, "memory", "share", "R", "warm"), 1),
            **{"velocity": 11, "bank": entries[0], "steady": len(first.bank.A) * first.bank.B.shape[1]},
            **{"P_d": 0 if first.steady else n * n, "noise": 1 + 2 * lags, "shadow": entries[1], "shadow_steady": nxs},
            **{"apart": n, "white": 1 + 2 * memory, "prior": 0 if start else n * n, "origin": 0 if start else n},
            **{"basis": 0 if start else n * n, "response": frequencies * 2 * (n + 1)},
        }
    )
    sizes = Sizes(
        n=n,
        rows=rows,
        inputs=first.bank.B.shape[1],
        states=len(first.bank.A),
        speed=speed,
        gated=first.only_moving,
        codes=first.codes,
        lags=lags,
        shadow=nxs,
        memory=memory,
        watched=-(-heard // WATCHED) * WATCHED,
        steady=first.steady,
        extra=first.extra,
        frequencies=frequencies,
        start=start,
        row=5 + n + 2 * n * n if start else 4 + n + n * n + 6 * frequencies,
        floats=to["end"],
    )
    return Plan(first.estimator, sizes, tuple(to.items()), tuple((*at.items(), ("tail", at["end"]))), found, seen)


def _packed(c: Constants, plan: Plan) -> FloatArray:
    """Return the constants of one asset as one row."""
    n, lags, memory, watched, v = plan.sizes.n, plan.sizes.lags, plan.sizes.memory, plan.sizes.watched, c.velocity
    test, view = c.watch, c.view

    def wide(x: FloatArray, size: int) -> FloatArray:
        return np.pad(x, (0, size - len(x)))

    shadow = wide(np.zeros(0), dict(plan.at)["white"] - dict(plan.at)["shadow"] + 1 + 2 * memory)
    members = np.concatenate([np.zeros((n + LAGS) * watched), np.full(watched, np.inf), np.zeros(watched)])
    if test is not None:
        system = _shadow(c)
        apart = np.linalg.solve(c.basis, test.theta / c.scale) - c.theta
        shadow = np.concatenate(
            [
                *(coefficients(plan.shadow, system), test.X0[:, 0], apart, [test.gain]),
                *(wide(test.numerator[1 : 1 + memory], memory), wide(test.denominator[1 : 1 + memory], memory)),
            ]
        )
        heard = len(test.limits)
        table = np.zeros((n + LAGS + 2, watched))
        table[n + LAGS] = np.inf
        table[:, :heard] = np.vstack([test.changes.T, test.limits, 1.0 / test.limits])
        members = table.ravel()
    seen: list[FloatArray] = []
    if view is not None:
        E = view.response.reshape(-1, 2, n)
        parts = [np.concatenate([(e @ c.basis).ravel(), e @ view.origin]) for e in E]
        back = np.linalg.inv(c.basis)
        seen = [(back @ view.covariance @ back.T).ravel(), view.origin, c.basis.ravel(), *parts]
    counts = [c.every, c.stride]
    gates = [*c.limits, *c.deadzone, c.sign_speed, c.rest_speed, c.still_speed, c.wait, 1.0 / c.wait]
    return np.concatenate(
        [
            *([float(x) for x in (*counts, *gates, c.memory, 1.0 / c.memory, c.R, test.warm if test else 0)],),
            *(v.A.ravel(), v.B[:, 0], v.C[0], v.D[0], v.steady[:, 0]),
            *(coefficients(plan.bank, c.bank), c.bank.steady.ravel(), np.zeros(0) if c.steady else c.P_d.ravel()),
            *([c.variance], wide(c.a, lags), wide(c.heads, lags), shadow, *seen, members),
        ]
    )


@functools.cache
def machine(plan: Plan, lanes: int, width: int, own: int) -> SimpleNamespace:
    """Return the drivers of `servoscope.drive` for a plan, by name; each compiles when it is first called."""
    estimator, sizes = estimators.load(plan.estimator), plan.sizes
    steps = Chain(plan, getattr(estimator, "steady", None))
    to, at = dict(plan.to), dict(plan.at)
    literals = {x: getattr(sizes, x) for x in ("n", "rows", "row", "floats", "frequencies", "extra", "watched")}
    literals |= {"columns": sizes.n + 1, "room": sizes.n + 2, "tile": 4 * TILE}
    literals |= {"lanes": lanes, "width": width, "own": own}
    names: dict[str, object] = {f"_{name}": number for name, number in literals.items()}
    names |= {"_to": namedtuple("To", to)(**to), "_at": namedtuple("At", at)(**at), "_update": estimator.update}
    for step in STEPS:
        names[f"_{step}"] = traced(getattr(steps, step), width, "" if own else "c")
    for step in ALONE:
        names[f"_{step}_one"] = traced(getattr(steps, step))
    heap = not sizes.steady  # estimators with a P of their own allocate
    for template in drive.PARTS:
        names[f"_{template.__name__}"] = inlined(filled(template, names), heap)
        names["_take"] = names.get("_settled" if sizes.steady else "_refreshed")
        names["_take_all"] = names.get("_together" if sizes.steady else "_apart")
        names["_write"] = names.get("_plain" if sizes.start else "_complete")
    what = repr((plan, lanes, width, own))
    return SimpleNamespace(**{driver.__name__: kernel(filled(driver, names, what), heap) for driver in drive.DRIVERS})
