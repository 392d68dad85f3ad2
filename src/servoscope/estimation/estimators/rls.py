"""Recursive least squares with exponential forgetting, l = 1 - 1/memory: it forgets what nothing replaces."""

from __future__ import annotations

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.jit import kernel

NAME = "rls"
NEEDS_INSTRUMENT = False
EXCEPTIONS = {
    "no windup": "P is divided by l, excited or not: at phi = 0 it grows e-fold every `memory` updates",
    "contracts": "P wavers around P_d, where forgetting and what the samples bring balance on average",
    "mean": "after a rest its gain is larger than the one the expectation follows; good where excitation stays alike",
}


@kernel
def update(
    theta: FloatArray, P: FloatArray, P_d: FloatArray, R: float, memory: float, eta: float,
    phi: FloatArray, z: FloatArray, K: FloatArray, extra: FloatArray,
) -> int:  # fmt: skip
    """Take one step: K = P phi/(l R + phi' P phi), P <- (P - K phi' P)/l, with l = 1 - 1/memory.

    P carries R: with the textbook's p = P/R these are K = p phi/(l + phi' p phi) and p <- (p - K phi' p)/l. Tuned with
    P_d = (R/N) R_phi^-1, P wavers around P_d.

    Windup ends in overflow after about 700 memories without excitation, and P is no longer positive when excitation
    comes back after some 30. So a step from a P that is not positive along phi, or to one that is no number, is
    refused (status 1): theta stays finite. The AKF is the cure, not this guard.

    **The statistic** is good where excitation stays alike. S is right under any, but after a rest the gain is larger
    than the one that the expectation follows: a healthy recording full of rests, judged by a baseline without, alarms.

    Source: Ljung, System Identification (1999), section 11.2.
    """
    l = 1.0 - 1.0 / max(memory, 2.0)
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
    largest = 0.0
    for i in range(n):
        largest = max(largest, P[i, i])
    if not (0.0 <= strength < np.inf and largest < 0.5 * l * np.finfo(P.dtype).max):
        for i in range(n):
            K[i] = 0.0
        return 1
    denominator = l * R + strength
    for i in range(n):
        K[i] = g[i] / denominator
        theta[i] += K[i] * e
    for i in range(n):
        for j in range(i + 1):
            P[i, j] = (P[i, j] - g[i] * K[j]) / l
            P[j, i] = P[i, j]
    return 0
