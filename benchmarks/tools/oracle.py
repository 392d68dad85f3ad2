"""The chain of one log in NumPy, sample by sample from its matrices: slow, obvious, what the fast one must equal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from servoscope.core.arrays import FloatArray

if TYPE_CHECKING:
    from servoscope.estimation.recursion import RecursionConstants


def reference_recursion(
    c: RecursionConstants, r: FloatArray, u: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return theta and its covariance S in the recursion's coordinates after a log without gaps, by the AKF."""
    n, bank = len(c.basis), c.bank
    x = bank.steady @ np.array([r[0], u[0], y[0]])
    theta, P, S = np.zeros(n), c.P_d.copy(), np.zeros((n, n))
    A = np.eye(len(c.a), k=1)  # the noise's chain of delays
    A[:, 0] = c.a
    M = np.zeros((n, len(c.a)))
    for k in range(len(r)):
        w = np.array([r[k], u[k], y[k]])
        v = bank.C @ x + bank.D @ w
        x = bank.A @ x + bank.B @ w
        if k < c.wait:
            continue
        phi = v[1 : 1 + n]
        g, g_d = P @ phi, c.P_d @ phi
        K = g / (c.R + phi @ g)
        theta = theta + K * (v[0] - phi @ theta)
        P = P + np.outer(g_d, g_d) / (c.R + phi @ g_d) - np.outer(K, g)
        F = np.eye(n) - np.outer(K, phi)
        Fm = np.outer(F @ M[:, 0], K)
        S = F @ S @ F.T + Fm + Fm.T + c.variance * np.outer(K, K)
        M = F @ M @ A.T + np.outer(K, c.heads)
    return theta, S


def kalman_loop(eta: FloatArray, phi: FloatArray, P: FloatArray, Q: FloatArray, R: float) -> Any:
    """Return theta of the Kalman filter of a random walk, from zero."""
    theta = np.zeros(phi.shape[1])
    for k in range(len(eta)):
        g = P @ phi[k]
        K = g / (R + phi[k] @ g)
        theta = theta + K * (eta[k] - phi[k] @ theta)
        P = P - np.outer(K, g) + Q
    return theta
