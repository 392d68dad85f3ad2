"""Adaptive Kalman filter of Stenlund and Gustafsson: P forgets towards P_d along excited directions only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.jit import dot, kernel

NAME = "akf"
NEEDS_INSTRUMENT = False


def steady_gain(R: Any, phi: Sequence[Any]) -> list[Any]:
    """Return the gain of a filter that began at P = P_d, for a phi (n) scaled so that P_d is I.

    (11) leaves P = P_d where it is, exactly: what is left of `update` is K = P_d phi/(R + phi' P_d phi).
    """
    factor = 1.0 / (R + dot(phi, phi))
    return [x * factor for x in phi]


@kernel
def update(
    theta: FloatArray, P: FloatArray, P_d: FloatArray, R: float, memory: float, eta: float,
    phi: FloatArray, z: FloatArray, K: FloatArray, extra: FloatArray,
) -> int:  # fmt: skip
    """Take one step of eqs. (7) to (9) and (11); the erratum of (10), P(k-1) in the denominator, is mended.

    Source: Stenlund and Gustafsson (2002); Medvedev (2003). At phi = 0 nothing moves: no covariance windup.
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
            g[i] += P[i, j] * phi[j]
            g_d[i] += P_d[i, j] * phi[j]
        e -= phi[i] * theta[i]
        denominator += phi[i] * g[i]
        denominator_d += phi[i] * g_d[i]
    for i in range(n):
        K[i] = g[i] / denominator
        theta[i] += K[i] * e
    for i in range(n):
        for j in range(i + 1):
            # computed once and mirrored: P stays symmetric to the last bit
            P[i, j] += g_d[i] * g_d[j] / denominator_d - g[i] * g[j] / denominator
            P[j, i] = P[i, j]
    return 0
