"""Recursive least squares with covariance resetting: no forgetting, but a fresh start once per memory."""

from __future__ import annotations

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.jit import kernel

NAME = "rls-reset"
NEEDS_INSTRUMENT = False
EXCEPTIONS = {
    "contracts": "P is a sawtooth: it shrinks like 1/k and is reset to (e - 1) P_d",
    "mean": "its gain is a sawtooth: the expectation is good where theta_hat has converged",
}


def extra_state_size(n: int, memory: float) -> int:
    """Return the size of the private state: the number of excited updates since P was reset."""
    return 1


@kernel
def update(
    theta: FloatArray, P: FloatArray, P_d: FloatArray, R: float, memory: float, eta: float,
    phi: FloatArray, z: FloatArray, K: FloatArray, extra: FloatArray,
) -> int:  # fmt: skip
    """Take one step of RLS without forgetting (l = 1); after every `memory` excited updates P becomes (e - 1) P_d.

    P_d = (R/N) R_phi^-1 is worth N samples, so (e - 1) P_d is worth N/(e - 1) of them, and N further ones leave the
    old estimate a share of 1/e: one cycle is one memory. The first cycle starts at P_d and leaves 1/2. At phi = 0
    nothing moves, and the cycle does not age.

    **The statistic** is good where theta_hat has converged. S is right anywhere, but the expectation follows the gain
    at P_d, not the sawtooth: a healthy recording of another reference may alarm.

    Source: Goodwin and Sin, Adaptive Filtering Prediction and Control (1984), section 3.3.
    """
    n = len(theta)
    e = eta
    strength = 0.0  # phi' P phi
    g = np.empty_like(theta)  # P phi
    for i in range(n):
        g[i] = 0.0
        for j in range(n):
            g[i] += P[i, j] * phi[j]
        e -= phi[i] * theta[i]
        strength += phi[i] * g[i]
    for i in range(n):
        K[i] = g[i] / (R + strength)
        theta[i] += K[i] * e
    if strength > 0.0:
        extra[0] += 1.0
    again = extra[0] >= memory
    if again:
        extra[0] = 0.0
    for i in range(n):
        for j in range(i + 1):
            P[i, j] = (np.e - 1.0) * P_d[i, j] if again else P[i, j] - g[i] * g[j] / (R + strength)
            P[j, i] = P[i, j]
    return 0
