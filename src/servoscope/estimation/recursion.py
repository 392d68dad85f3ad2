"""The compiled recursion: from constants, state and a block of samples to a new state and evaluations.

One sample, a log and a fleet run through the same lines (`kernel.sample_steps`), compiled for the sizes at hand. The
state of an asset is one row of floats, whose names are those of `Recursion.state_type`. A recording may be split
anywhere, because all that is carried from sample to sample is in that row.
"""

from __future__ import annotations

import contextlib
import copy
import itertools
import math
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.core.jit.native import address
from servoscope.estimation.kernel import threads
from servoscope.estimation.kernel.buffers import BufferPool
from servoscope.estimation.kernel.cusum import LAGS, CusumConstants, evaluation_weights
from servoscope.estimation.kernel.run import compile_function
from servoscope.estimation.kernel.sample_steps import CUSUM_BATCH, HEADER_SIZE, SAMPLE
from servoscope.estimation.kernel.sparse_lti import pack_coefficients, pad_system, pairs_structure, sparsity_pattern
from servoscope.estimation.kernel.spec import KernelSizes, KernelSpec
from servoscope.models.lti import LinearSystem
from servoscope.models.plants import Column

LANE_COUNT = {"float64": 8, "float32": 16}  # assets side by side: one vector; twice as many leave the first-level cache
ZERO_TOLERANCE = 1e-12  # of the first coefficient of a filter
MIN_PARALLEL_SAMPLES = 200_000  # samples from which a second core pays
PARTS_PER_CORE = 12  # taken in turn, so that a core that is held up leaves its share to the others


_SPECS: dict[KernelSpec, KernelSpec] = {}


class EvaluationConstants(NamedTuple):
    """Constants of complete evaluations; `response` holds Re and Im of E(f).

    `covariance` (n, n) and `origin` (n,) are the baseline's covariance and coefficients in physical units, `response`
    has shape (2 F, n), and `rate` is that of the samples [Hz]. After `settled` updates the covariance is
    `settled_covariance`, where that is another one.
    """

    covariance: FloatArray
    origin: FloatArray
    response: FloatArray
    rate: float
    settled_covariance: FloatArray | None = None
    settled: float = np.inf

    @property
    def fades(self) -> bool:
        """Whether the covariance is another one once the estimate has settled."""
        return self.settled_covariance is not None and not np.array_equal(self.covariance, self.settled_covariance)


class RecursionConstants(NamedTuple):
    """The numbers of a loop and its baseline.

    The recursion's coordinates: phi is `basis`' times the physical one, theta what is left when the baseline's is taken
    off and the rest divided by `basis` (n, n). With `steady` they are chosen so that P_d is the identity, and P stays
    there. `theta` is the baseline's in these coordinates, `origin` the same in physical units.

    `bank` and `velocity` are filters, `nonlinear` the columns of friction and offset, `shapes` two numbers for each
    with a shape, `limits` and `deadzone` of u; `a` (lags,) and `heads` (lags,) are the noise's model as
    `moments.propagate_covariance` takes it, `variance` that of v, in updates: of every `stride`-th sample; `extra` is
    the size of the estimator's private state, and `watch` is the sequential test.
    """

    estimator: str
    steady: bool
    bank: LinearSystem
    velocity: LinearSystem
    v_of_r: bool
    nonlinear: tuple[Column, ...]
    shapes: tuple[float, ...]
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
    watch: CusumConstants | None
    view: EvaluationConstants | None = None


def _offsets(sizes: dict[str, int]) -> dict[str, int]:
    ends = list(itertools.accumulate(sizes.values(), initial=0))
    return dict(zip((*sizes, "end"), ends, strict=True))


def _whitening_order(test: CusumConstants) -> int:
    """Return the order of the whitening filter, without coefficients that are zero but for rounding."""
    size = np.maximum(np.abs(test.numerator), np.abs(test.denominator))
    return int(np.flatnonzero(size > ZERO_TOLERANCE)[-1])


class Recursion:
    """The recursion of one asset, or of several of one structure; with `single`, in single precision."""

    def __init__(self, constants: Sequence[RecursionConstants], *, single: bool = False) -> None:
        self.constants = tuple(constants)
        first = self.constants[0]
        self._spec = _kernel_spec(self.constants)
        self.sizes = self._spec.sizes
        self._type = np.dtype(np.float32 if single else np.float64)
        fields = [(name, end - begin) for (name, begin), (_, end) in itertools.pairwise(self._spec.to)]
        numbers = [("counters", HEADER_SIZE), *fields, ("cusum", self.sizes.watched), ("extra", first.extra)]
        self.state_type = np.dtype([(name, np.float64, (count,)) for name, count in numbers])
        self.size = self.state_type.itemsize // 8
        self._buffers = BufferPool()
        self._per_asset = len({id(c) for c in self.constants}) > 1
        table = np.array([_pack_constants(c, self._spec) for c in (self.constants if self._per_asset else (first,))])
        self._table = table
        self._lanes = 1 if (len(self.constants) == 1 and not single) or first.extra else LANE_COUNT[self._type.name]
        self._blocks = -(-len(self.constants) // self._lanes)
        self._block_constants = self._arrange_constants()

    @property
    def layout(self) -> Hashable:
        """What decides how a state is laid out, and which code runs."""
        return self._spec

    @property
    def has_lanes(self) -> bool:
        """Whether assets run side by side; one with a private state of its estimator runs alone."""
        return not self.constants[0].extra

    def select(self, assets: npt.NDArray[np.intp]) -> Self:
        """Return the recursion of some of the assets, in this order."""
        part = copy.copy(self)
        part.constants = tuple(map(self.constants.__getitem__, assets.tolist()))
        part._blocks = -(-len(assets) // self._lanes)
        if self._per_asset:
            part._table = self._table[assets]
            part._block_constants = part._arrange_constants()
        return part

    def phase(self, samples: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
        """Return where between two evaluations assets are that have processed so many samples."""
        return samples.astype(np.int64) % math.lcm(self.constants[0].every, self.constants[0].stride)

    @property
    def number(self) -> np.dtype[Any]:
        """The type of signals and evaluations."""
        return self._type

    def _arrange_constants(self) -> npt.NDArray[Any]:
        """Return the constants as the compiled blocks take them, (blocks, rows times lanes)."""
        if not self._per_asset:
            return np.ascontiguousarray(self._table, dtype=self._type)
        lanes = np.minimum(np.arange(self._blocks * self._lanes), len(self._table) - 1)
        table = self._table[lanes].reshape(self._blocks, self._lanes, -1).swapaxes(1, 2)
        return np.ascontiguousarray(table.reshape(self._blocks, -1), dtype=self._type)

    def start(self) -> FloatArray:
        """Return the states before the first sample, shape (assets, size): theta at the baseline, P = P_d."""
        state = np.zeros((len(self.constants), self.size))
        for row, c in zip(self.named(state), self.constants, strict=True):
            row["power"] = c.variance
            if not self.sizes.steady:
                row["P"] = c.P_d.ravel()
            if self.sizes.start:
                row["Psi"] = np.eye(self.sizes.n).ravel()
        return state

    def named(self, state: FloatArray) -> npt.NDArray[Any]:
        """Return a view of states (assets, size) as records of `state_type`, shape (assets,)."""
        return state.view(self.state_type)[:, 0]

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
        new = self._buffers.empty(state.shape, state.dtype)
        out = self._buffers.empty((len(state), len(self.rows(state, r.shape[1])), self.sizes.row), self._type)
        flags = np.zeros((0, 0), dtype=np.bool_) if restart is None else restart
        run_blocks = compile_function("run_blocks", self._spec, self._lanes, self._type == np.float32, self._per_asset)
        signals = [np.ascontiguousarray(x, dtype=self._type) for x in (r, u, y)]
        arrays = [self._block_constants, state, new, *signals, np.ascontiguousarray(flags), out]
        step = self._block_constants.shape[1] if self._per_asset else 0
        sizes = step, *r.shape, len(flags), c.every, c.stride, out.shape[1] * out.shape[2]
        places = [address(array) for array in arrays]

        workers = min(threads.core_count(), self._blocks) if r.size >= MIN_PARALLEL_SAMPLES else 1
        edges = np.linspace(0, self._blocks, PARTS_PER_CORE * workers + 1 if workers > 1 else 2).astype(int).tolist()
        parts = deque(itertools.pairwise(edges))

        def work() -> None:
            with contextlib.suppress(IndexError):  # there is no part left
                while True:
                    run_blocks(*places, *sizes, *parts.popleft())

        if workers == 1:
            work()
        else:  # this thread works as well: waking another one takes time
            others = [threads.thread_pool(workers - 1).submit(work) for _ in range(workers - 1)]
            work()
            for other in others:
                if not other.cancel():
                    other.result()
        return new, out

    @property
    def stepper(self) -> Callable[[FloatArray, float, float, float], bool]:
        """The function that takes one sample of the first asset; the state (size,) is changed in place."""
        function, constants = compile_function("run_sample", self._spec), np.ascontiguousarray(self._table[0])
        last, places = constants, (address(constants), 0)

        def step(state: FloatArray, r: float, u: float, y: float) -> bool:
            nonlocal last, places
            if state is not last:  # to ask where an array lies takes as long as a step
                last, places = state, (address(constants), address(state))
            return function(*places, r, u, y)  # type: ignore[no-any-return]

        return step

    def evaluate(self, state: FloatArray) -> FloatArray:
        """Return the evaluations of states as they are, shape (assets, row)."""
        out, rows = np.empty((len(state), self.sizes.row)), np.ascontiguousarray(state, dtype=np.float64)
        table = np.ascontiguousarray(self._table, dtype=np.float64)
        step = table.shape[1] if self._per_asset else 0
        compile_function("evaluate_states", self._spec)(address(table), address(rows), address(out), step, len(rows))
        return out

    def regressors(
        self, state: FloatArray, r: FloatArray, u: FloatArray, y: FloatArray, restart: BoolArray
    ) -> tuple[FloatArray, IntArray]:
        """Return [eta, phi, z] of every sample of the first asset (N, rows) and its status (N,); change the state."""
        out = np.zeros((len(r), self.sizes.rows))  # a missing sample writes nothing
        ok = np.empty(len(r), dtype=np.int64)
        signals = [np.ascontiguousarray(x, dtype=np.float64) for x in (self._table[0], r, u, y)]
        arrays = [signals[0], state, *signals[1:], np.ascontiguousarray(restart), out, ok]
        function = compile_function("write_regressors", self._spec)
        function(*(address(array) for array in arrays), len(r), self.constants[0].stride)
        return out, ok


def structure_key(c: RecursionConstants) -> Hashable:
    """Return the sizes and settings that assets of one fleet must have in common."""
    spec = _kernel_spec([c])
    together = spec.sizes.directions > 0
    sizes = spec.sizes._replace(lags=0, memory=0, watched=0, floats=0, directions=0, fades=False)
    if together:  # their shadows are filled up to one size
        sizes = sizes._replace(shadow=0)
    return spec.estimator, sizes, together, spec.bank, c.stride, c.every, c.memory


def _kernel_spec(constants: Sequence[RecursionConstants]) -> KernelSpec:
    first = constants[0]
    tests = [c.watch for c in constants if c.watch is not None]
    n, rows = len(first.basis), len(first.bank.C)
    memory = max(map(_whitening_order, tests), default=0)
    lengths = [(len(x.shadow.A), len(x.shadow.C), len(x.limits), len(x.directions)) for x in tests]
    nxs, columns, count, q = map(max, zip(*lengths, strict=True)) if tests else (0, 0, 0, 0)
    shadows = [pad_system(test.shadow, nxs, columns) for test in tests]
    if q:
        shadows.append(pairs_structure(nxs, columns))  # like loops share machine code
    lags = max(len(c.a) for c in constants)
    speed = 0
    if first.nonlinear or first.only_moving or first.still_speed > 0.0:
        speed = 2 if first.v_of_r else 1
    start = first.view is None
    frequencies = 0 if first.view is None else len(first.view.response) // 2
    fades = any(c.view is not None and c.view.fades for c in constants)
    to = _offsets(
        {
            **{"power": 1, "drift": 1, "level": 1, "peak": 1, "x": len(first.bank.A), "velocity": 2 * bool(speed)},
            **{"theta": n, "P": 0 if first.steady else n * n, "S": n * (n + 1) // 2, "M": n * lags},
            **{"Psi": n * n * start, "shadow": nxs, "white": memory if q else (n + 1) * memory},
            **({"sums": q * (q + 3) // 2} if q else {"psi": (n + LAGS) * bool(nxs)}),
        }
    )
    bank, shadow = sparsity_pattern([c.bank for c in constants]), sparsity_pattern(shadows) if shadows else ((), ())
    entries = [sum(len(row) for part in p for row in part) for p in (bank, shadow)]
    names = ("low", "high", "dead_low", "dead_high", "sign_speed", "rest_speed", "still_speed", "wait", "forget")
    at = _offsets(
        {
            **dict.fromkeys(("every", "stride", *names, "memory", "share", "R", "warm"), 1),
            **{"velocity": 11, "bank": entries[0], "steady": len(first.bank.A) * first.bank.B.shape[1]},
            **{"P_d": 0 if first.steady else n * n, "noise": 1 + 2 * lags, "shadow": entries[1], "shadow_steady": nxs},
            **{"apart": n, "white": 1 + 2 * memory, "prior": 0 if start else n * n, "origin": 0 if start else n},
            **{
                "basis": 0 if start else n * n,
                "rate": 0 if start else 1,
                "response": frequencies * 2 * (n + 1),
                "shapes": len(first.shapes),
                "settled_prior": fades * n * n,
                "settled": fades,
            },
        }
    )
    sizes = KernelSizes(
        n=n,
        rows=rows,
        inputs=first.bank.B.shape[1],
        states=len(first.bank.A),
        speed=speed,
        gated=first.only_moving,
        nonlinear=first.nonlinear,
        lags=lags,
        shadow=nxs,
        memory=memory,
        watched=-(-count // CUSUM_BATCH) * CUSUM_BATCH,
        steady=first.steady,
        extra=first.extra,
        frequencies=frequencies,
        start=start,
        row=5 + n + 2 * n * n if start else 4 + n + n * n + 6 * frequencies,
        floats=to["end"],
        directions=q,
        fades=fades,
    )
    spec = KernelSpec(
        first.estimator, sizes, tuple(to.items()), tuple((*at.items(), ("tail", at["end"]))), bank, shadow
    )
    return _SPECS.setdefault(spec, spec)  # ten kilobytes that all loops of one structure share


def _pack_constants(c: RecursionConstants, spec: KernelSpec) -> FloatArray:
    """Return the constants of one asset as one row, each in its place; what an asset lacks is zero."""
    n, lags, memory, v, places = spec.sizes.n, spec.sizes.lags, spec.sizes.memory, c.velocity, dict(spec.at)
    test, view = c.watch, c.view

    def pad(x: FloatArray, size: int) -> FloatArray:
        return np.pad(x, (0, size - len(x)))

    members = np.zeros((spec.sums or n + LAGS + 1, spec.sizes.watched))
    values: dict[str, Any] = {
        **{"every": c.every, "stride": c.stride, "low": c.limits[0], "high": c.limits[1], "wait": c.wait},
        **{"dead_low": c.deadzone[0], "dead_high": c.deadzone[1], "sign_speed": c.sign_speed},
        **{"rest_speed": c.rest_speed, "still_speed": c.still_speed, "forget": 1.0 / c.wait, "R": c.R},
        **{"memory": c.memory, "share": 1.0 / c.memory, "steady": c.bank.steady, "shapes": c.shapes},
        "velocity": np.concatenate([v.A.ravel(), v.B[:, 0], v.C[0], v.D[0], v.steady[:, 0]]),
        "bank": pack_coefficients(spec.bank, c.bank),
        "P_d": np.zeros(0) if c.steady else c.P_d,
        "noise": np.concatenate([[c.variance], pad(c.a, lags), pad(c.heads, lags)]),
        "tail": members,
    }
    if test is not None:
        system = pad_system(test.shadow, spec.sizes.shadow, len(spec.shadow[0]))
        filters = (pad(x[1 : 1 + memory], memory) for x in (test.numerator, test.denominator))
        values |= {
            "warm": test.warm,
            "shadow": pack_coefficients(spec.shadow, system),
            "shadow_steady": test.shadow.steady[:, 0],
            "apart": np.linalg.solve(c.basis, test.theta / c.scale) - c.theta,
            "white": np.concatenate([[test.gain], *filters]),
        }
        if spec.sums:
            directions = np.pad(test.directions, ((0, spec.sizes.directions - len(test.directions)), (0, 0)))
            members[:, : len(test.limits)] = evaluation_weights(test.changes, directions, test.limits)
        else:
            members[:, : len(test.limits)] = np.vstack([test.changes.T / test.limits, -0.5 * test.limits])
    if view is not None:
        E = view.response.reshape(-1, 2, n)
        back = np.linalg.inv(c.basis)
        values |= {
            **{"prior": back @ view.covariance @ back.T, "origin": view.origin, "basis": c.basis, "rate": view.rate},
            "response": [np.concatenate([(e @ c.basis).ravel(), e @ view.origin]) for e in E],
        }
        if spec.sizes.fades:
            settled = view.covariance if view.settled_covariance is None else view.settled_covariance
            values |= {"settled_prior": back @ settled @ back.T, "settled": view.settled}
    row = np.zeros(places["tail"] + members.size)
    for name, value in values.items():
        row[places[name] : places[name] + np.size(value)] = np.ravel(value)
    return row
