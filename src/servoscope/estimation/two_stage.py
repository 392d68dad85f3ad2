"""Stage 1 of the closed-loop identification: r -> u estimated recursively, u_a = S_hat r simulated with it.

In a closed loop the measured u carries the noise of y through the controller. Van den Hof and Schrama (1993) first
estimate the sensitivity r -> u, which r alone excites, and put its noise-free output u_a in the place of u. Here the
map is a sum of FIR taps or Laguerre functions of r, and its weights are estimated by the same estimators as the
inverse model's.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.errors import NotEnoughError
from servoscope.core.jit import Bool, Float, dot, fma, maximum, minimum
from servoscope.core.jit.llvm_text import LlvmPrinter
from servoscope.core.jit.memory import Memory, apply
from servoscope.core.jit.native import address, native_function
from servoscope.core.jit.symbolic import Int
from servoscope.estimation import estimators
from servoscope.estimation.kernel import sparse_lti
from servoscope.estimation.update import read_matrix, write_matrix
from servoscope.models.loop import Loop
from servoscope.models.lti import LinearSystem, tapped_delay_line
from servoscope.signals import Recording

LENGTHS = {"fir": 40, "laguerre": 12}  # functions, where a loop file does not say
RIDGE = 1e-4  # of the mean excitation: what r excites less is not learned, and adds no noise to u_a
TRANSIENT_SHARE = 1e-3  # share of a start-up transient that is let through
VECTOR_WIDTH = 8  # numbers in a vector
ARMED, WAIT = range(2)  # counters at the head of the state row
HEADER_SIZE = 2


@dataclass(frozen=True)
class StageOneTuning:
    """Start and tuning of stage 1, from healthy recordings."""

    theta: tuple[float, ...]  # weights of the functions, shape (n,)
    P_d: tuple[tuple[float, ...], ...]  # desired covariance, shape (n, n)
    R: float  # variance of u - u_a


class StageOneConstants(NamedTuple):
    """What the compiled stage takes: the functions of r as a linear system, and the tuning.

    `functions` are the packed coefficients of the system, X0 its steady state; P_d is filled up with zeros to whole
    vectors.
    """

    functions: FloatArray
    X0: FloatArray
    limits: tuple[float, float]
    wait: int
    theta: FloatArray
    P_d: FloatArray
    R: float
    memory: float


def basis_functions(loop: Loop) -> LinearSystem:
    """Return the functions of r that stage 1 weighs, as one system from r to n outputs.

    FIR: r(k), r(k-1), ...; Laguerre (Wahlberg, 1991), orthonormal, of pole a and with feedthrough, for u answers r
    within the sample: ``L_0 = sqrt(1 - a^2)/(1 - a q)``, ``L_i = L_(i-1) (q - a)/(1 - a q)``.
    """
    settings = loop.monitor
    n = settings.stage_one_length or LENGTHS[settings.stage_one]
    if settings.stage_one == "fir":
        return tapped_delay_line(np.eye(n))
    return laguerre_functions(n, settings.stage_one_pole)


def laguerre_functions(n: int, a: float) -> LinearSystem:
    """Return n Laguerre functions of pole a with feedthrough, as one system from r to their values."""
    # the states are the outputs one sample ago: l_i(k) = a l_i(k-1) + l_(i-1)(k-1) - a l_(i-1)(k)
    M, m = np.zeros((n, n)), np.zeros((n, 1))
    M[0, 0], m[0, 0] = a, np.sqrt(1.0 - a * a)
    for i in range(1, n):
        M[i], m[i] = -a * M[i - 1], -a * m[i - 1]
        M[i, i] += a
        M[i, i - 1] += 1.0
    return LinearSystem(M, m, M, m)


def basis_settling_samples(system: LinearSystem) -> int:
    """Count the samples until a start-up transient has decayed to `TRANSIENT_SHARE`."""
    power, count = np.eye(len(system.A)), 0
    while np.abs(power).max(initial=0.0) > TRANSIENT_SHARE:
        power, count = system.A @ power, count + 1
    return count


class StageOneRunner:
    """Stage 1 of one loop, ready to run; without a tuning it lets u pass and has no state."""

    def __init__(self, loop: Loop, tuning: StageOneTuning | None) -> None:
        self.size = 0
        if tuning is None:
            return
        system = basis_functions(loop)
        infinite = (-np.inf, np.inf)
        limits = (loop.input_limits or infinite) if loop.input_logged == "before_limiter" else infinite
        pattern, P_d = sparse_lti.sparsity_pattern([system]), np.array(tuning.P_d, dtype=np.float64)
        padding = 0, _vector_count(len(P_d)) * VECTOR_WIDTH - len(P_d)
        self._constants = StageOneConstants(
            functions=sparse_lti.pack_coefficients(pattern, system),
            X0=np.ascontiguousarray(system.steady[:, 0]),
            limits=limits,
            wait=basis_settling_samples(system),
            theta=np.array(tuning.theta, dtype=np.float64),
            P_d=np.pad(P_d, padding),
            R=tuning.R,
            memory=loop.monitor.memory * loop.sample_rate,
        )
        n, name = len(tuning.theta), loop.monitor.estimator
        self._steady = hasattr(estimators.load_estimator(name), "steady_gain")
        own_P = 0 if self._steady else n * n
        extra = estimators.extra_state_size(name, n, self._constants.memory)
        self.size = HEADER_SIZE + len(system.A) + n + own_P + extra
        self._block = compile_stage_one(name, pattern)

    def start(self) -> FloatArray:
        """Return the state before the first sample, shape (size,)."""
        if not self.size:
            return np.zeros(0)
        c = self._constants
        P = np.zeros(0) if self._steady else c.P_d[: len(c.theta), : len(c.theta)].ravel()
        used = np.concatenate([np.zeros(HEADER_SIZE + len(c.X0)), c.theta, P])
        return np.pad(used, (0, self.size - len(used)))

    def run(self, state: FloatArray, r: FloatArray, u: FloatArray, restart: BoolArray) -> FloatArray:
        """Return u_a of a block, shape (N,), and change `state` (size,) in place.

        u_a(k) follows from the estimate of sample k - 1, so that the noise of u(k) has no share in it. It is NaN where
        r or u is, and after a gap until the functions have settled: stage 2 waits there too.
        """
        if not self.size:
            return u
        u_a = np.empty(len(r))
        c = self._constants
        signals = (np.ascontiguousarray(x, dtype=np.float64) for x in (r, u))
        arrays = [state, c.functions, c.X0, c.P_d, *signals, np.ascontiguousarray(restart), u_a]
        self._block(*map(address, arrays), c.R, c.memory, float(c.wait), *c.limits, len(r))
        return u_a


def tune_stage_one(loop: Loop, recordings: Sequence[Recording]) -> StageOneTuning | None:
    """Tune stage 1 on healthy recordings as stage 2 is: start at least squares, P_d = (R/N) R_phi^-1.

    R_phi gets a small ridge: r excites some combinations of its own past hardly at all. None for a loop with
    ``two_stage = "none"``.

    Raises NotEnoughError if r does not move, or too few samples are left once the functions have settled.
    """
    if loop.monitor.two_stage == "none":
        return None
    system = basis_functions(loop)
    wait, n = basis_settling_samples(system), len(system.C)
    phi, u = [], []
    for recording in recordings:
        ends = [*np.flatnonzero(recording.restart)[1:], recording.samples]
        for begin, end in zip(np.flatnonzero(recording.restart), ends, strict=True):
            phi.append(system.simulate(recording.r[begin:end, None])[wait:])
            u.append(recording.u[begin + wait : end])
    Phi, eta = np.vstack(phi), np.concatenate(u)
    if len(eta) < 2 * n:
        raise NotEnoughError(
            f"only {len(eta)} usable samples for the {n} functions of stage 1: record longer, or lower "
            "[monitor] stage_one_length"
        )
    R_phi = Phi.T @ Phi / len(eta)
    excitation = float(np.trace(R_phi)) / n
    if not excitation > 0.0:
        raise NotEnoughError("stage 1 learns nothing: the reference is zero throughout the healthy recordings")
    R_phi = R_phi + RIDGE * excitation * np.eye(n)
    theta = np.linalg.solve(R_phi, Phi.T @ eta / len(eta))
    R = max(float(np.mean((eta - Phi @ theta) ** 2)), 1e-12 * float(np.mean(eta**2)))
    P_d = R / (loop.monitor.memory * loop.sample_rate) * np.linalg.inv(R_phi)
    P_d = (P_d + P_d.T) / 2.0
    return StageOneTuning(tuple(theta.tolist()), tuple(tuple(row) for row in P_d.tolist()), R)


ARGUMENTS = (
    *((name, "ptr") for name in ("state", "functions", "X0", "P_d", "r", "u", "restart", "u_a")),
    *((name, "double") for name in ("R", "memory", "wait", "low", "high")),
    ("samples", "i64"),
)


@functools.cache
def compile_stage_one(estimator: str, pattern: sparse_lti.SparsityPattern) -> Callable[..., None]:
    """Compile stage 1 around one estimator and the functions of r; its arguments are `ARGUMENTS`.

    Products of long vectors are summed up in `VECTOR_WIDTH` lanes.
    """
    p, module = LlvmPrinter(ARGUMENTS), estimators.load_estimator(estimator)
    n, states, steady = len(pattern[0]), len(pattern[1]), hasattr(module, "steady_gain")
    rows, size = _vector_count(n), _vector_count(n) * VECTOR_WIDTH
    R, memory, wait, low, high = (Float(p, f"%{name}", "double") for name in ("R", "memory", "wait", "low", "high"))
    head, functions, X0, P_d = (Memory(p, f"%{name}", "double") for name in ("state", "functions", "X0", "P_d"))
    x = head.behind(HEADER_SIZE)
    weights, private = x.behind(states), x.behind(states + n + n * n)
    phi, theta, K, sums = (Memory(p, p.stack("double", max(size, 2 * VECTOR_WIDTH)), "double") for _ in range(4))

    def begin(s: Any, x: Any, X0: Any, r: Any) -> None:
        s[ARMED], s[WAIT] = 1.0, wait
        for i in range(states):
            x[i] = X0[i] * r[0]

    def evaluate_functions(c: Any, x: Any, r: Any, phi: Any) -> None:
        for i, number in enumerate(sparse_lti.advance_system(pattern, c, 0, x, 0, [r[0]])):
            phi[i] = number

    def multiply(P_d: Any, phi: Any, K: Any) -> None:
        """Put P_d phi into K, column by column."""
        totals = [Float(p, p.constant(0.0, K.kind), K.kind)] * rows
        for k in range(size):
            totals = [fma(P_d[k * rows + i], phi[k], total) for i, total in enumerate(totals)]
        for i, total in enumerate(totals):
            K[i] = total

    def products(phi: Any, theta: Any, K: Any, sums: Any) -> None:
        """Write the products phi' theta and phi' K, each as the lanes of a vector that sum up to it."""
        for place, other in enumerate((theta, K)):
            sums[place] = dot([phi[i] for i in range(rows)], [other[i] for i in range(rows)])

    def output(sums: Any, u_a: Any) -> None:
        u_a[0] = functools.reduce(operator.add, [sums[i] for i in range(VECTOR_WIDTH)], 0.0)

    def update_steady(theta: Any, K: Any, sums: Any, u: Any) -> None:
        """Update theta where P stays at P_d: K = P_d phi/(R + phi' P_d phi)."""
        residual, denominator = minimum(maximum(u[0], low), high), R
        for i in range(VECTOR_WIDTH):
            residual, denominator = residual - sums[i], denominator + sums[VECTOR_WIDTH + i]
        for i in range(n):
            theta[i] = theta[i] + K[i] * (residual / denominator)

    def update_general(theta: Any, phi: Any, P: Any, P_d: Any, u: Any, extra: Any) -> None:
        """Update theta and P by any estimator."""
        signals, w = [phi[i] for i in range(n)], minimum(maximum(u[0], low), high)
        matrices = read_matrix(P, n), read_matrix(P_d, n, apart=size)
        new = module.update([theta[i] for i in range(n)], *matrices, R, memory, w, signals, signals, extra)
        for i in range(n):
            theta[i] = new.theta[i]
        write_matrix(P, new.P)

    def process(r: Memory, u: Memory, u_a: Memory, k: Int) -> None:
        flag = p.compare_whole(">", p.assign(f"zext i8 {p.load('i8', p.place('i8', '%restart', k))} to i64"), "0")
        with p.when(Bool(p, flag, "i1") | (Float(p, head.load(ARMED), "double") <= 0.0)):
            apply(begin, head, x, X0, r)
        apply(evaluate_functions, functions, x, r, phi)
        waiting = Float(p, head.load(WAIT), "double")
        with p.when(waiting > 0.0):
            head.store(WAIT, (waiting - 1.0).text)
        with p.when(waiting <= 0.0):
            wide = [memory.regrouped(VECTOR_WIDTH) for memory in (phi, theta, K, sums)]
            if steady:
                apply(multiply, P_d.regrouped(VECTOR_WIDTH), phi.regrouped(VECTOR_WIDTH, shared=True), wide[2])
            apply(products, *wide)
            apply(output, sums, u_a)
            if steady:
                apply(update_steady, theta, K, sums, u)
            else:
                apply(update_general, theta, phi, weights.behind(n), P_d, u, private)

    for i in p.loop(0, size):
        for row in (phi, theta, K):
            row.store(i, p.constant(0.0, "double"))
    for i in p.loop(0, n):
        theta.store(i, weights.load(i))
    for k in p.loop(0, p.argument("samples")):
        r, u, u_a = (Memory(p, p.place("double", f"%{name}", k), "double") for name in ("r", "u", "u_a"))
        u_a.store(0, p.constant(math.nan, "double"))
        finite = (abs(Float(p, r.load(0), "double")) < math.inf) & (abs(Float(p, u.load(0), "double")) < math.inf)
        with p.when(finite):
            process(r, u, u_a, k)
        with p.when(~finite):
            head.store(ARMED, p.constant(0.0, "double"))
    for i in p.loop(0, n):
        weights.store(i, theta.load(i))
    p.write("ret void")
    return native_function(p.text(), ARGUMENTS)


def _vector_count(n: int) -> int:
    """Return how many vectors n numbers take."""
    return -(-n // VECTOR_WIDTH)
