"""Standard Kalman filter of a random walk: P grows by Q at every update, excited or not."""

from __future__ import annotations

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.jit import kernel

NAME = "kf"
NEEDS_INSTRUMENT = False
EXCEPTIONS = {
    "no windup": "Q is added whether or not phi says anything: at phi = 0, P grows by P_d every `memory` updates",
    "contracts": "P wavers around P_d, where the growth by Q and what the samples take away balance on average",
    "mean": "after a rest its gain is larger than the one the expectation follows; good where excitation stays alike",
}


@kernel
def update(
    theta: FloatArray, P: FloatArray, P_d: FloatArray, R: float, memory: float, eta: float,
    phi: FloatArray, z: FloatArray, K: FloatArray, extra: FloatArray,
) -> int:  # fmt: skip
    """Take one step of eqs. (7) to (10), with P(k-1) in the denominator of (10) as in (9), and Q = P_d / memory.

    With P_d = (R/N) R_phi^-1, the mean of (10) has the fixed point P R_phi P / R = Q = P_d / N, that is P = P_d: gain
    and memory are then those of the AKF and of RLS with l = 1 - 1/N.

    **The statistic** is good where excitation stays alike. S is right under any, but after a rest the gain is larger
    than the one that the expectation follows: a healthy recording full of rests, judged by a baseline without, alarms.

    Source: Gustafsson, Adaptive Filtering and Change Detection (2000), algorithm 8.1.
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
    for i in range(n):
        for j in range(i + 1):
            # computed once and mirrored: P stays symmetric to the last bit
            P[i, j] += P_d[i, j] / memory - g[i] * g[j] / (R + strength)
            P[j, i] = P[i, j]
    return 0
