"""Discrete linear systems x(k+1) = A x + B w, v = C x + D w: the bricks of every filter bank, and how to join them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from servoscope.plants import FloatArray, StateSpace
from servoscope.simulation.discretise import discretise


@dataclass(frozen=True, eq=False)
class Linear:
    """One discrete linear time-invariant system.

    Parameters
    ----------
    A, B, C, D
        Shapes (n, n), (n, m), (p, n) and (p, m).
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray

    @property
    def steady(self) -> FloatArray:
        """State reached under a constant input of one, shape (n, m): ``(I - A)^-1 B``."""
        return np.asarray(np.linalg.solve(np.eye(len(self.A)) - self.A, self.B), dtype=np.float64)

    def then(self, after: Linear) -> Linear:
        """Return the series connection: the outputs of this one are the inputs of `after`."""
        n, m = len(self.A), len(after.A)
        A = np.block([[self.A, np.zeros((n, m))], [after.B @ self.C, after.A]])
        B = np.vstack([self.B, after.B @ self.D])
        C = np.hstack([after.D @ self.C, after.C])
        return Linear(A, B, C, after.D @ self.D)

    def input(self, matrix: FloatArray) -> Linear:
        """Return the same system with inputs of its own before it, ``w = matrix @ inputs``."""
        return Linear(self.A, self.B @ matrix, self.C, self.D @ matrix)

    def output(self, matrix: FloatArray) -> Linear:
        """Return the same system with outputs ``matrix @ v``."""
        return Linear(self.A, self.B, matrix @ self.C, matrix @ self.D)

    def simulate(self, w: FloatArray) -> FloatArray:
        """Run the system from its steady state at ``w[0]``; slow and obvious, for oracles and small jobs.

        Parameters
        ----------
        w
            Inputs, shape (N, m).

        Returns
        -------
        numpy.ndarray
            Outputs, shape (N, p).
        """
        x = self.steady @ w[0]
        v = np.empty((len(w), len(self.C)))
        for k, w_k in enumerate(w):
            v[k] = self.C @ x + self.D @ w_k
            x = self.A @ x + self.B @ w_k
        return v


def autocovariances(system: Linear, lags: int, stride: int = 1) -> FloatArray:
    """Return the output autocovariances E[v(k + lag stride) v(k)'] under unit white noise at every input.

    Parameters
    ----------
    system
        A stable system.
    lags
        Number of lags beyond 0.
    stride
        Samples per lag.

    Returns
    -------
    numpy.ndarray
        Shape (lags + 1, p, p).
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


def stack(systems: Sequence[Linear]) -> Linear:
    """Put systems side by side: inputs and outputs one after the other, nothing shared."""

    def diagonal(blocks: Sequence[FloatArray]) -> FloatArray:
        whole = np.zeros((sum(b.shape[0] for b in blocks), sum(b.shape[1] for b in blocks)))
        row = column = 0
        for b in blocks:
            whole[row : row + b.shape[0], column : column + b.shape[1]] = b
            row, column = row + b.shape[0], column + b.shape[1]
        return whole

    return Linear(
        diagonal([s.A for s in systems]),
        diagonal([s.B for s in systems]),
        diagonal([s.C for s in systems]),
        diagonal([s.D for s in systems]),
    )


def taps(weights: Sequence[float] | FloatArray) -> Linear:
    """Tapped delay line: output i is ``sum_j weights[i, j] w(k - j)``; one row of weights gives one output."""
    W = np.atleast_2d(np.asarray(weights, dtype=np.float64))
    n = W.shape[1] - 1
    A = np.eye(n, k=-1)
    B = np.zeros((n, 1))
    if n:
        B[0, 0] = 1.0
    return Linear(A, B, W[:, 1:], W[:, :1])


def sampled(continuous: StateSpace, sample_rate: float, hold: Literal["zoh", "foh"], late: float = 0.0) -> Linear:
    """Discretise a strictly proper system exactly for an input that is held or runs in straight lines.

    Parameters
    ----------
    continuous
        A (n, n), B (n, 1), C (p, n) of the continuous system.
    sample_rate
        In Hz.
    hold
        What the input does between samples.
    late
        Delay of the input [s], any fraction of a sample.

    Returns
    -------
    Linear
        From the input as logged to the outputs ``C x`` at the sample times.
    """
    A, B, C = continuous
    d = discretise((A, B, C[:1]), sample_rate, hold=hold, delay=late)
    # x(k+1) needs w(k+1) under a first-order hold: the state xi = x - b_next w carries that sample into D
    now = (d.A @ d.b_next + d.b_now)[:, None]
    if np.any(d.b_late):
        both = Linear(d.A, np.hstack([now, d.b_late[:, None]]), C, np.column_stack([C @ d.b_next, 0.0 * C[:, 0]]))
        system = taps(np.eye(2)).then(both)
    else:
        system = Linear(d.A, now, C, (C @ d.b_next)[:, None])
    return taps(np.eye(1, d.m + 1, d.m)).then(system) if d.m else system


def state_variable_filter(cutoff: float, order: int) -> StateSpace:
    """Build the continuous state-variable filter: outputs ``s^i F(s) w`` for i < order, F = (1 + s/lambda)^-order.

    Source: Young, Garnier and Gilson, direct continuous-time identification; THEORY of this project, section 3.

    Parameters
    ----------
    cutoff
        lambda / (2 pi) [Hz].
    order
        Number of outputs, one more than the highest derivative.

    Returns
    -------
    tuple of numpy.ndarray
        A, B, C; the state is kept in powers of s/lambda so that all of it is of one size.
    """
    rate = 2.0 * math.pi * cutoff
    A = np.eye(order, k=1)
    A[-1] = [-math.comb(order, i) for i in range(order)]
    B = np.zeros((order, 1))
    B[-1, 0] = 1.0
    return rate * A, rate * B, np.diag(rate ** np.arange(order, dtype=np.float64))


def settling(cutoff: float, order: int, dt: float, rest: float = 1e-3) -> int:
    """Count the samples after which a step's transient in a state-variable filter is below `rest`."""
    x = 0.0
    while sum(x**j / math.factorial(j) for j in range(order)) * math.exp(-x) > rest:
        x += 0.01
    return math.ceil(x / (2.0 * math.pi * cutoff * dt))
