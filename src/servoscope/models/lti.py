"""Discrete linear systems x(k+1) = A x + B w, v = C x + D w: the bricks of every filter bank, and how to join them."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.models.discretise import DiscretePlant, discretise
from servoscope.models.plants import StateSpace

MAX_RICCATI_ITERATIONS = 20_000  # of a Riccati equation, at most
RICCATI_TOLERANCE = 1e-12  # relative change of its solution at which it has settled
ROUNDING_TOLERANCE = 1e-12  # relative: smaller parts of a sum do not show


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """One discrete linear time-invariant system."""

    A: FloatArray  # A, B, C, D: shapes (n, n), (n, m), (p, n) and (p, m)
    B: FloatArray
    C: FloatArray
    D: FloatArray

    @property
    def steady(self) -> FloatArray:
        """State reached under a constant input of one, shape (n, m): ``(I - A)^-1 B``."""
        return np.asarray(np.linalg.solve(np.eye(len(self.A)) - self.A, self.B), dtype=np.float64)

    def then(self, after: LinearSystem) -> LinearSystem:
        """Return the series connection: the outputs of this one are the inputs of `after`."""
        n, m = len(self.A), len(after.A)
        A = np.block([[self.A, np.zeros((n, m))], [after.B @ self.C, after.A]])
        B = np.vstack([self.B, after.B @ self.D])
        C = np.hstack([after.D @ self.C, after.C])
        return LinearSystem(A, B, C, after.D @ self.D)

    def input(self, matrix: FloatArray) -> LinearSystem:
        """Return the same system with inputs of its own before it, ``w = matrix @ inputs``."""
        return LinearSystem(self.A, self.B @ matrix, self.C, self.D @ matrix)

    def output(self, matrix: FloatArray) -> LinearSystem:
        """Return the same system with outputs ``matrix @ v``."""
        return LinearSystem(self.A, self.B, matrix @ self.C, matrix @ self.D)

    def simulate(self, w: FloatArray) -> FloatArray:
        """Run the system from its steady state at ``w[0]``; slow and obvious, for oracles and small jobs.

        `w`: inputs, shape (N, m); returns numpy.ndarray: outputs, shape (N, p).
        """
        x = self.steady @ w[0]
        v = np.empty((len(w), len(self.C)))
        for k, w_k in enumerate(w):
            v[k] = self.C @ x + self.D @ w_k
            x = self.A @ x + self.B @ w_k
        return v


def autocovariances(system: LinearSystem, lags: int, stride: int = 1) -> FloatArray:
    """Return the output autocovariances E[v(k + lag stride) v(k)'] under unit white noise at every input.

    `lags`: number of lags beyond 0; returns numpy.ndarray: shape (lags + 1, p, p).
    """
    from scipy.linalg import matrix_balance, solve_discrete_lyapunov

    A, B, C, D = system.A, system.B, system.C, system.D
    if not len(A):
        return np.concatenate([(D @ D.T)[None], np.zeros((lags, len(D), len(D)))])
    # states of very different units would spoil the solution
    balanced, T = matrix_balance(A, permute=False)
    A, B, C = np.asarray(balanced, dtype=np.float64), np.asarray(np.linalg.solve(T, B), dtype=np.float64), C @ T
    X = solve_discrete_lyapunov(A, B @ B.T)
    with_output = A @ X @ C.T + B @ D.T  # E[x(k + 1) v(k)']
    covariances = [C @ X @ C.T + D @ D.T]
    power = np.linalg.matrix_power(A, stride - 1)
    step = np.linalg.matrix_power(A, stride)
    for _ in range(lags):
        covariances.append(C @ power @ with_output)
        power = power @ step
    return np.array(covariances)


def scale_to_noise(system: LinearSystem) -> LinearSystem:
    """Return the same system in states of unit variance under unit white noise at every input; it is stable."""
    from scipy.linalg import matrix_balance, solve_discrete_lyapunov

    balanced, T = matrix_balance(system.A, permute=False)
    A, B, C = np.asarray(balanced), np.linalg.solve(T, system.B), system.C @ T
    d = np.sqrt(np.diag(solve_discrete_lyapunov(A, B @ B.T)))
    d = np.where(d > 0.0, d, 1.0)  # what the noise does not reach
    return LinearSystem(A * d / d[:, None], B / d[:, None], C * d, system.D)


def decimate_noise(system: LinearSystem, stride: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return A, Q, S and R of every `stride`-th output under unit white noise at every input.

    ``x+ = A x + w, v = C x + e`` with the covariances Q of w, S of w with e, and R of e.
    """
    A, B = system.A, system.B
    Q = B @ B.T
    for _ in range(stride - 1):
        Q = A @ Q @ A.T + B @ B.T
    # only the first input of a stride reaches the output that stands at its beginning
    S = np.linalg.matrix_power(A, stride - 1) @ B @ system.D.T
    return np.linalg.matrix_power(A, stride), Q, S, system.D @ system.D.T


def innovation_gain(
    A: FloatArray, C: FloatArray, Q: FloatArray, S: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return gain K (n, p) and variance (p, p) of the steady Kalman predictor ``x+ = A x + K (v - C x)``."""
    from scipy.linalg import solve_discrete_are

    try:
        P = np.asarray(solve_discrete_are(A.T, C.T, Q, R, s=S))
    except np.linalg.LinAlgError:  # a zero at the unit circle: the recursion itself, which needs no spectrum
        P = Q
        for _ in range(MAX_RICCATI_ITERATIONS):
            K = np.linalg.solve(C @ P @ C.T + R, (A @ P @ C.T + S).T).T
            following = A @ P @ A.T + Q - K @ (A @ P @ C.T + S).T
            change, P = np.abs(following - P).max(), (following + following.T) / 2.0
            if change <= RICCATI_TOLERANCE * np.abs(P).max():
                break
    variance = C @ P @ C.T + R
    return np.asarray(np.linalg.solve(variance, (A @ P @ C.T + S).T).T), np.asarray(variance)


def block_diagonal(systems: Sequence[LinearSystem]) -> LinearSystem:
    """Put systems side by side: inputs and outputs one after the other, nothing shared."""
    from scipy.linalg import block_diag

    A, B, C, D = (block_diag(*(getattr(system, name) for system in systems)) for name in "ABCD")
    return LinearSystem(A, B, C, D)


def tapped_delay_line(weights: Sequence[float] | FloatArray) -> LinearSystem:
    """Tapped delay line: output i is ``sum_j weights[i, j] w(k - j)``; one row of weights gives one output."""
    W = np.atleast_2d(np.asarray(weights, dtype=np.float64))
    n = W.shape[1] - 1
    A = np.eye(n, k=-1)
    B = np.zeros((n, 1))
    if n:
        B[0, 0] = 1.0
    return LinearSystem(A, B, W[:, 1:], W[:, :1])


def stretched_filter(numerator: FloatArray, denominator: FloatArray, stride: int) -> LinearSystem:
    """Return the filter ``numerator(z^-stride) / denominator(z^-stride)``: of one length, the latter begins with 1."""
    n = (len(numerator) - 1) * stride
    a, b = np.zeros(n), np.zeros(n)
    a[stride - 1 :: stride], b[stride - 1 :: stride] = denominator[1:], numerator[1:] - numerator[0] * denominator[1:]
    A = np.eye(n, k=-1)
    A[:1] = -a
    return LinearSystem(A, np.eye(n, 1), b[None, :], np.array([[numerator[0]]]))


def unit_states(system: LinearSystem, pole: float) -> LinearSystem:
    """Return the same system in states of about unit variance under white noise through ``1/(z - pole)``."""
    d = np.linalg.norm(_reach(system, pole)[:-1], axis=1)
    d = np.where(d > 0.0, d, 1.0)
    return LinearSystem(system.A * d / d[:, None], system.B / d[:, None], system.C * d, system.D)


def output_deviations(system: LinearSystem, pole: float) -> FloatArray:
    """Return the standard deviation of each output when unit white noise comes through ``1/(z - pole)``, shape (p,)."""
    return np.asarray(np.linalg.norm(np.hstack([system.C, system.D]) @ _reach(system, pole), axis=1))


def truncate_states(system: LinearSystem, rows: FloatArray, pole: float, tolerance: float) -> LinearSystem:
    """Return a system with one input that does nearly the same with few states (balanced truncation, Moore, 1981).

    The combinations ``rows @ v`` of its outputs, shape (p', p), err by at most `tolerance` in standard deviations under
    white noise through ``1/(z - pole)``, if any number of states can do that; constant inputs lead to the same outputs.
    Its own states are `unit_states`, the new ones those of `companion_pairs`.
    """
    reached, seen = _reach(system, pole)[:-1], _gramian_factor(system.A.T, (rows @ system.C).T)
    left, singular, right = np.linalg.svd(seen.T @ reached)
    least, best = np.inf, system
    for count in range(2, len(singular) + 1, 2):
        root = np.sqrt(singular[:count])
        T, back = reached @ right[:count].T / root, (seen @ left[:, :count] / root).T
        A = back @ system.A @ T
        if np.abs(np.linalg.eigvals(A)).max() >= 1.0:  # more states than the system has but for rounding
            break
        smaller = companion_pairs(LinearSystem(A, back @ system.B, system.C @ T, 0.0 * system.D))
        D = system.D + system.C @ system.steady - smaller.C @ smaller.steady
        smaller = LinearSystem(smaller.A, smaller.B, smaller.C, D)
        difference = block_diagonal([system, smaller]).input(np.ones((2, 1))).output(np.hstack([rows, -rows]))
        error = float(output_deviations(difference, pole).max())
        if error < least:
            least, best = error, smaller
        if error <= tolerance:
            break
    return best


def _reach(system: LinearSystem, pole: float) -> FloatArray:
    """Return a factor of the covariance of states and input, the last row, under noise through ``1/(z - pole)``."""
    n = len(system.A)
    A = np.block([[system.A, system.B], [np.zeros((1, n)), np.array([[pole]])]])
    return _gramian_factor(A, np.eye(n + 1, 1, -n))


def _gramian_factor(A: FloatArray, B: FloatArray) -> FloatArray:
    """Return L with ``L L' = sum_i A^i B B' A'^i``, by doubling (Smith, 1968): small parts keep their digits."""
    L, power = B, A
    while True:
        increment = power @ L
        U, s, _ = np.linalg.svd(np.hstack([L, increment]), full_matrices=False)
        L, power = np.asarray(U * s, dtype=np.float64), power @ power
        if np.all(np.abs(increment).max(axis=1) <= ROUNDING_TOLERANCE * np.abs(L).max(axis=1)):
            return L


def companion_pairs(system: LinearSystem) -> LinearSystem:
    """Return the same system, of one input, in pairs of states ``x1+ = a1 x1 + a2 x2 + w, x2+ = x1``.

    Its poles must be distinct. Real ones are paired largest with smallest, so that no state becomes large.
    """
    poles, V = np.linalg.eig(system.A)
    gains = (system.C @ V) * np.linalg.solve(V, system.B.astype(np.complex128))[:, 0]
    parts = sorted(zip(poles, gains.T, strict=True), key=lambda part: abs(part[0]))
    real = [part for part in parts if part[0].imag == 0.0]
    if len(real) % 2:
        real.insert(0, (np.complex128(0.0), np.zeros(len(gains))))
    pairs = [(part, (part[0].conjugate(), part[1].conj())) for part in parts if part[0].imag > 0.0]
    pairs += list(zip(real[: len(real) // 2], real[: len(real) // 2 - 1 : -1], strict=True))
    A, C = np.zeros((2 * len(pairs), 2 * len(pairs))), np.zeros((len(gains), 2 * len(pairs)))
    for k, ((p, g), (q, h)) in enumerate(pairs):
        A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[(p + q).real, -(p * q).real], [1.0, 0.0]]
        C[:, 2 * k], C[:, 2 * k + 1] = (g + h).real, -(g * q + h * p).real
    return LinearSystem(A, np.tile([[1.0], [0.0]], (len(pairs), 1)), C, system.D)


def sample_system(
    continuous: StateSpace, sample_rate: float, hold: Literal["zoh", "foh"], late: float = 0.0
) -> LinearSystem:
    """Discretise a strictly proper system exactly for an input that is held or runs in straight lines.

    `continuous`: a (n, n), B (n, 1), C (p, n) of the continuous system; `sample_rate`: in Hz; `hold`: what the
    input does between samples; `late`: delay of the input [s], any fraction of a sample; returns Linear: from the
    input as logged to the outputs ``C x`` at the sample times.
    """
    A, B, C = continuous
    return input_to_output(discretise((A, B, C[:1]), sample_rate, hold=hold, delay=late), C)


def input_to_output(d: DiscretePlant, C: FloatArray | None = None) -> LinearSystem:
    """Return a discrete plant as a system from the input as logged to its output, or to ``C x``."""
    C = d.c[None] if C is None else C
    # x(k+1) needs w(k+1) under a first-order hold: the state xi = x - b_next w carries that sample into D
    now = (d.A @ d.b_next + d.b_now)[:, None]
    if np.any(d.b_late):
        both = LinearSystem(d.A, np.hstack([now, d.b_late[:, None]]), C, np.column_stack([C @ d.b_next, 0.0 * C[:, 0]]))
        system = tapped_delay_line(np.eye(2)).then(both)
    else:
        system = LinearSystem(d.A, now, C, (C @ d.b_next)[:, None])
    return (
        tapped_delay_line(np.eye(1, d.delay_samples + 1, d.delay_samples)).then(system) if d.delay_samples else system
    )


def state_variable_filter(cutoff: float, order: int) -> StateSpace:
    """Build the continuous state-variable filter: outputs ``s^i F(s) w`` for i < order, F = (1 + s/lambda)^-order.

    Source: Young, Garnier and Gilson, direct continuous-time identification; how-it-works, "Filter bank".

    `cutoff`: lambda / (2 pi) [Hz]; `order`: number of outputs, one more than the highest derivative; returns tuple
    of numpy.ndarray: a, B, C; the state is kept in powers of s/lambda so that all of it is of one size.
    """
    rate = 2.0 * math.pi * cutoff
    A = np.eye(order, k=1)
    A[-1] = [-math.comb(order, i) for i in range(order)]
    B = np.zeros((order, 1))
    B[-1, 0] = 1.0
    return rate * A, rate * B, np.diag(rate ** np.arange(order, dtype=np.float64))


def settling_samples(cutoff: float, order: int, dt: float, tolerance: float = 1e-3) -> int:
    """Count the samples after which a step's transient in a state-variable filter is below `tolerance`."""
    return math.ceil(_settling_time(order, tolerance) / (2.0 * math.pi * cutoff * dt))


@functools.cache
def _settling_time(order: int, tolerance: float) -> float:
    """Return the same in time constants of the filter."""
    x = 0.0
    while sum(x**j / math.factorial(j) for j in range(order)) * math.exp(-x) > tolerance:
        x += 0.01
    return x


def solve_scaled(A: FloatArray, b: FloatArray) -> FloatArray:
    """Solve A x = b for a matrix whose rows and columns have very different units."""
    s = 1.0 / np.sqrt(np.abs(np.diag(A)))
    scaled = np.linalg.lstsq(A * np.outer(s, s), (b.T * s).T, rcond=None)[0]
    return np.asarray((scaled.T * s).T, dtype=np.float64)
