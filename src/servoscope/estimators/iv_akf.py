"""Instrumental-variable adaptive Kalman filter: the instrument z keeps the noise of phi out of the gain."""

from __future__ import annotations

import numpy as np

from servoscope.compiled import kernel
from servoscope.plants import FloatArray

NAME = "iv-akf"
NEEDS_INSTRUMENT = True
EXCEPTIONS = {"positive": "phi and z differ, so P is not symmetric; it stays bounded and the guard keeps phi' P z >= 0"}


@kernel
def update(
    theta: FloatArray,
    P: FloatArray,
    P_d: FloatArray,
    R: float,
    memory: float,
    eta: float,
    phi: FloatArray,
    z: FloatArray,
    K: FloatArray,
    extra: FloatArray,
) -> int:
    """Take one guarded step of THEORY section 5; P is not symmetric here.

    K = P z/(R + phi' P z), P <- P - K phi' P + (P_d z)(phi' P_d)/(R + phi' P_d z). A negative phi' P z means that
    the instrument points away from the regressor, and the step would move theta away: it is skipped (status 1).
    """
    n = len(theta)
    e = eta
    strength = 0.0
    strength_d = 0.0
    g = np.empty_like(theta)  # P z
    h = np.empty_like(theta)  # phi' P
    g_d = np.empty_like(theta)
    h_d = np.empty_like(theta)
    for i in range(n):
        g[i] = 0.0
        h[i] = 0.0
        g_d[i] = 0.0
        h_d[i] = 0.0
        for j in range(n):
            g[i] += P[i, j] * z[j]
            h[i] += phi[j] * P[j, i]
            g_d[i] += P_d[i, j] * z[j]
            h_d[i] += phi[j] * P_d[j, i]
        e -= phi[i] * theta[i]
    for i in range(n):
        strength += phi[i] * g[i]
        strength_d += phi[i] * g_d[i]
    if strength < 0.0 or strength_d < 0.0:
        for i in range(n):
            K[i] = 0.0
        return 1
    for i in range(n):
        K[i] = g[i] / (R + strength)
        theta[i] += K[i] * e
    for i in range(n):
        for j in range(n):
            P[i, j] += g_d[i] * h_d[j] / (R + strength_d) - K[i] * h[j]
    return 0
