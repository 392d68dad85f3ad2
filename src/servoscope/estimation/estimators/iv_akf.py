"""Instrumental-variable adaptive Kalman filter: the instrument z keeps the noise of phi out of the gain."""

from __future__ import annotations

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.jit import kernel

NAME = "iv-akf"
NEEDS_INSTRUMENT = True


@kernel
def update(
    theta: FloatArray, P: FloatArray, P_d: FloatArray, R: float, memory: float, eta: float,
    phi: FloatArray, z: FloatArray, K: FloatArray, extra: FloatArray,
) -> int:  # fmt: skip
    """Take one step with the symmetric instrumental gain (Young, 2011): phi is in e alone.

    K = P z/(R + z' P z), P by (11) with z. No noise of phi is in gain or covariance: to skip samples by the sign of
    phi' P z would be to choose them by their noise, which is a bias. A residual out of all proportion is refused
    (status 1).
    """
    n = len(theta)
    e = eta
    denominator = R
    denominator_d = R
    g = np.empty_like(theta)
    g_d = np.empty_like(theta)
    for i in range(n):
        g[i] = 0.0
        g_d[i] = 0.0
        for j in range(n):
            g[i] += P[i, j] * z[j]
            g_d[i] += P_d[i, j] * z[j]
        e -= phi[i] * theta[i]
        denominator += z[i] * g[i]
        denominator_d += z[i] * g_d[i]
    # no signal reaches this: where z points away from phi, theta would grow until it overflows
    if e * e > 1e12 * R:
        for i in range(n):
            K[i] = 0.0
        return 1
    for i in range(n):
        K[i] = g[i] / denominator
        theta[i] += K[i] * e
    for i in range(n):
        for j in range(i + 1):
            # computed once and mirrored: P stays symmetric to the last bit
            P[i, j] += g_d[i] * g_d[j] / denominator_d - g[i] * g[j] / denominator
            P[j, i] = P[i, j]
    return 0
