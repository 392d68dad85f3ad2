"""Stage 1 of the closed-loop identification: r -> u estimated recursively, u_a = S_hat r simulated with it.

In a closed loop the measured u carries the noise of y through the controller. Van den Hof and Schrama (1993) first
estimate the sensitivity r -> u, which r alone excites, and put its noise-free output u_a in the place of u. Here the
map is a sum of FIR taps or Laguerre functions of r, and its weights are estimated by the same estimators as the
inverse model's.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.errors import NotEnoughError
from servoscope.core.jit import dot, fma
from servoscope.estimation import estimators
from servoscope.estimation.kernel import sparse_lti
from servoscope.models.lti import LinearSystem, tapped_delay_line
from servoscope.signals import Recording

if TYPE_CHECKING:
    from servoscope.models.loop import Loop

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
    limits: FloatArray
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
            limits=np.array(limits, dtype=np.float64),
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
        self._block(self._constants, state, r, u, restart, u_a)
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


# what the templates are filled with
_UNFILLED: Any = None
_states = _padded = _lane_view = _functions = _products = _column = _steady = _update_theta = _update = _UNFILLED


def update_steady(
    c: StageOneConstants, s: FloatArray, theta: FloatArray, phi: FloatArray, K: FloatArray, sums: FloatArray, eta: float
) -> None:
    """Update theta where P stays at P_d: K = P_d phi/(R + phi' P_d phi)."""
    denominator, residual = c.R, eta
    for i in range(VECTOR_WIDTH):
        residual -= sums[i]
        denominator += sums[VECTOR_WIDTH + i]
    step = residual / denominator
    for i in range(len(theta)):
        theta[i] += K[i] * step


def update_general(
    c: StageOneConstants, s: FloatArray, theta: FloatArray, phi: FloatArray, K: FloatArray, sums: FloatArray, eta: float
) -> None:
    """Update theta and P by any estimator."""
    n = len(c.theta)
    P = s[HEADER_SIZE + _states + n : HEADER_SIZE + _states + n + n * n].reshape((n, n))
    extra = s[HEADER_SIZE + _states + n + n * n :]
    _update(theta[:n], P, c.P_d[:n, :n], c.R, c.memory, eta, phi[:n], phi[:n], K[:n], extra)


def run_stage_one(
    c: StageOneConstants, s: FloatArray, r: FloatArray, u: FloatArray, restart: BoolArray, u_a: FloatArray
) -> None:
    """Write u_a of a block."""
    n = len(c.theta)
    x = _lane_view(s[HEADER_SIZE : HEADER_SIZE + _states], 1, 1)
    weights, P_d = _lane_view(c.functions, 1, 1), _lane_view(c.P_d.reshape(c.P_d.size), VECTOR_WIDTH, 1)
    w, sums = np.empty((1, 1)), np.zeros(2 * VECTOR_WIDTH)
    phi, K, theta = np.zeros(_padded), np.zeros(_padded), np.zeros(_padded)
    theta[:n] = s[HEADER_SIZE + _states : HEADER_SIZE + _states + n]
    one, wide = _lane_view(phi, 1, 1), _lane_view(phi, VECTOR_WIDTH, 1)
    weight, gain = _lane_view(theta, VECTOR_WIDTH, 1), _lane_view(K, VECTOR_WIDTH, 1)
    parts = _lane_view(sums, VECTOR_WIDTH, 1)
    for k in range(len(r)):
        u_a[k] = np.nan
        if not (np.isfinite(r[k]) and np.isfinite(u[k])):
            s[ARMED] = 0.0
            continue
        if restart[k] or s[ARMED] == 0.0:
            s[ARMED] = 1.0
            s[WAIT] = c.wait
            for i in range(_states):
                x[i, 0] = c.X0[i] * r[k]
        w[0, 0] = r[k]
        _functions(0, weights, x, w, one)
        if s[WAIT] > 0.0:
            s[WAIT] -= 1.0
            continue
        if _steady:
            K[:] = 0.0
            for j in range(0, _padded, VECTOR_WIDTH):
                _column(0, P_d, one, gain, j)
        _products(0, wide, weight, gain, parts)
        total = 0.0
        for i in range(VECTOR_WIDTH):
            total += sums[i]
        u_a[k] = total
        _update_theta(c, s, theta, phi, K, sums, min(max(u[k], c.limits[0]), c.limits[1]))
    s[HEADER_SIZE + _states : HEADER_SIZE + _states + n] = theta[:n]


@functools.cache
def compile_stage_one(estimator: str, pattern: sparse_lti.SparsityPattern) -> Callable[..., None]:
    """Compile stage 1 around one estimator and the functions of r: ``block(c, state, r, u, restart, u_a)``."""
    from servoscope.core.jit import inline, kernel, lane_view, specialise, trace_function

    module, n = estimators.load_estimator(estimator), len(pattern[0])
    steady, rows = hasattr(module, "steady_gain"), _vector_count(n)

    def functions(c: Any, s: Any, w: Any, v: Any) -> None:
        for i, number in enumerate(sparse_lti.advance_system(pattern, c, 0, s, 0, [w[0]])):
            v[i] = number

    def column(P_d: Any, one: Any, K: Any, j: Any) -> None:
        """Add the columns of P_d from j on, as many as fit a vector, each times its phi, to K."""
        for i in range(rows):
            total = K[i]
            for k in range(VECTOR_WIDTH):
                total = fma(P_d[j * rows + (k * rows + i)], one[j + k], total)
            K[i] = total

    def products(phi: Any, theta: Any, K: Any, sums: Any) -> None:
        """Write the products phi' theta and phi' K, each as the lanes of a vector that sum up to it."""
        for place, other in enumerate((theta, K)):
            sums[place] = dot([phi[i] for i in range(rows)], [other[i] for i in range(rows)])

    names: dict[str, object] = {
        "_states": len(pattern[1]),
        "_padded": rows * VECTOR_WIDTH,
        "_update": module.update,
        "_lane_view": lane_view,
        "_steady": steady,
    }
    names |= {
        "_functions": trace_function(functions),
        "_products": trace_function(products, VECTOR_WIDTH),
        "_column": trace_function(column, VECTOR_WIDTH, "one"),
    }
    names["_update_theta"] = inline(specialise(update_steady if steady else update_general, names), heap=True)
    return kernel(specialise(run_stage_one, names, repr((estimator, pattern))))


def _vector_count(n: int) -> int:
    """Return how many vectors n numbers take."""
    return -(-n // VECTOR_WIDTH)
