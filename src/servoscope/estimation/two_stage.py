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
from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.errors import NotEnoughError
from servoscope.core.jit import Float, dot, fma, maximum, minimum
from servoscope.core.jit.array_function import ArrayFunction
from servoscope.core.jit.arrays import Array
from servoscope.core.jit.memory import Memory, apply
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
        P_d, n = np.array(tuning.P_d, dtype=np.float64), len(tuning.theta)
        padded = np.pad(P_d, (0, _vector_count(n) * VECTOR_WIDTH - n))  # with zeros, to whole vectors
        name, memory = loop.monitor.estimator, loop.monitor.memory * loop.sample_rate
        estimator, pattern = estimators.load_estimator(name), sparse_lti.sparsity_pattern([system])
        self._compiled: dict[str, Any] = {"estimator": estimator, "pattern": pattern}
        functions = sparse_lti.pack_coefficients(pattern, system)
        self._constants = functions, np.ascontiguousarray(system.steady[:, 0]), padded.ravel()
        self._numbers = tuning.R, memory, float(basis_settling_samples(system)), *map(float, limits)
        own_P = np.zeros(0) if hasattr(estimator, "steady_gain") else P_d.ravel()
        private = np.zeros(estimators.extra_state_size(name, n, memory))
        parts = np.zeros(HEADER_SIZE), np.zeros(len(system.A)), np.array(tuning.theta), own_P, private
        self._start, self._cuts = np.concatenate(parts), np.cumsum([len(part) for part in parts])[:-1]
        self.size = len(self._start)

    def start(self) -> FloatArray:
        """Return the state before the first sample, shape (size,)."""
        return self._start.copy() if self.size else np.zeros(0)

    def run(self, state: FloatArray, r: FloatArray, u: FloatArray, restart: BoolArray) -> FloatArray:
        """Return u_a of a block, shape (N,), and change `state` (size,) in place.

        u_a(k) follows from the estimate of sample k - 1, so that the noise of u(k) has no share in it. It is NaN where
        r or u is, and after a gap until the functions have settled: stage 2 waits there too.
        """
        if not self.size:
            return u
        u_a, signals = np.empty(len(r)), [np.asarray(x, dtype=np.float64) for x in (r, u)]
        parts = np.split(state, self._cuts)
        run_stage_one(*parts, *self._constants, *signals, restart, u_a, *self._numbers, **self._compiled)
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


@ArrayFunction
def run_stage_one(
    printer: Any, head: Any, x: Any, weights: Any, P: Any, extra: Any, functions: Any, X0: Any, P_d: Any, r: Any,
    u: Any, restart: Any, u_a: Any, R: Any, memory: Any, wait: Any, low: Any, high: Any, *,
    estimator: ModuleType, pattern: sparse_lti.SparsityPattern,
) -> None:  # fmt: skip
    """Run stage 1 around one estimator and the functions of r; head, x, weights, P and `extra` are its state.

    Products of long vectors are summed up in `VECTOR_WIDTH` lanes.
    """
    n, steady = len(pattern[0]), hasattr(estimator, "steady_gain")
    rows, size = _vector_count(n), _vector_count(n) * VECTOR_WIDTH
    phi, theta, K, sums = (Array.scratch(printer, "double", max(size, 2 * VECTOR_WIDTH)) for _ in range(4))
    wide = [Memory(printer, array.base, "double", VECTOR_WIDTH) for array in (phi, theta, K, sums)]

    def multiply(P_d: Any, phi: Any, K: Any) -> None:
        """Put P_d phi into K, column by column."""
        totals = [Float(printer, printer.constant(0.0, K.kind), K.kind)] * rows
        for k in range(size):
            totals = [fma(P_d[k * rows + i], phi[k], total) for i, total in enumerate(totals)]
        for i, total in enumerate(totals):
            K[i] = total

    def products(phi: Any, theta: Any, K: Any, sums: Any) -> None:
        """Write the products phi' theta and phi' K, each as the lanes of a vector that sum up to it."""
        for place, other in enumerate((theta, K)):
            sums[place] = dot([phi[i] for i in range(rows)], [other[i] for i in range(rows)])

    def update_steady(entering: Any) -> None:
        """Update theta where P stays at P_d: K = P_d phi/(R + phi' P_d phi)."""
        residual, denominator = entering, R
        for i in range(VECTOR_WIDTH):
            residual, denominator = residual - sums[i], denominator + sums[VECTOR_WIDTH + i]
        for i in range(n):
            theta[i] = theta[i] + K[i] * (residual / denominator)

    def update_general(entering: Any) -> None:
        """Update theta and P by any estimator."""
        signals, matrices = [phi[i] for i in range(n)], (read_matrix(P, n), read_matrix(P_d, n, apart=size))
        new = estimator.update([theta[i] for i in range(n)], *matrices, R, memory, entering, signals, signals, extra)
        for i in range(n):
            theta[i] = new.theta[i]
        write_matrix(P, new.P)

    for i in printer.loop(0, size):
        phi[i] = theta[i] = K[i] = 0.0
    for i in printer.loop(0, n):
        theta[i] = weights[i]
    for k in printer.loop(0, r.shape[0]):
        u_a[k] = math.nan
        finite = (abs(r[k]) < math.inf) & (abs(u[k]) < math.inf)
        with printer.when(finite):
            with printer.when((restart[k] > 0) | (head[ARMED] <= 0.0)):
                head[ARMED], head[WAIT] = 1.0, wait
                for i in range(len(pattern[1])):
                    x[i] = X0[i] * r[k]
            for i, number in enumerate(sparse_lti.advance_system(pattern, functions, 0, x, 0, [r[k]])):
                phi[i] = number
            waiting = head[WAIT]
            with printer.when(waiting > 0.0):
                head[WAIT] = waiting - 1.0
            with printer.when(waiting <= 0.0):
                if steady:
                    columns = Memory(printer, P_d.base, "double", VECTOR_WIDTH)
                    apply(multiply, columns, replace(wide[0], shared=True), wide[2])
                apply(products, *wide)
                u_a[k] = functools.reduce(operator.add, [sums[i] for i in range(VECTOR_WIDTH)], 0.0)
                (update_steady if steady else update_general)(minimum(maximum(u[k], low), high))
        with printer.when(~finite):
            head[ARMED] = 0.0
    for i in printer.loop(0, n):
        weights[i] = theta[i]


def _vector_count(n: int) -> int:
    """Return how many vectors n numbers take."""
    return -(-n // VECTOR_WIDTH)
