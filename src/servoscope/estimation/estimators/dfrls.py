"""Recursive least squares with directional forgetting: only what a sample speaks of is forgotten."""

from __future__ import annotations

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.jit import kernel

NAME = "dfrls"
NEEDS_INSTRUMENT = False
EXCEPTIONS = {
    "contracts": "P has no P_d to go to: along excited directions it wavers around a level of its own",
    "mean": "P wanders from P_d, and the gain with it: the expectation is good where theta_hat has converged",
}


@kernel
def update(
    theta: FloatArray, P: FloatArray, P_d: FloatArray, R: float, memory: float, eta: float,
    phi: FloatArray, z: FloatArray, K: FloatArray, extra: FloatArray,
) -> int:  # fmt: skip
    """Take one step of Kulhavy and Karny's recursion, with l = N/(N + n) for a memory of N updates.

    With s = phi' P phi/R (their z, P carries R here) and eps = l - (1 - l)/s: K = P phi/(R (1 + s)),
    P <- P - P phi phi' P/(R (1/eps + s)), which is P^-1 <- P^-1 + eps phi phi'/R; no update at s = 0.

    A sample forgets in one direction of n only, so with l = 1 - 1/N the memory would be n N (that is why the source
    paper's l = 0.99 is as slow as an RLS of l = 0.9975 for n = 4). The level at which nothing changes is
    s = (1 - l)/l; with l = N/(N + n) it is n/N, which is the mean of phi' P phi/R at P_d = (R/N) R_phi^-1.

    phi = 0 winds nothing up, but a phi that is small without being zero does: P grows by 1/l an update along it until
    s = (1 - l)/l again. The AKF has a bound that does not depend on phi.

    **The statistic** is good where theta_hat has converged. S is right anywhere, but P and the gain wander from P_d,
    which the expectation follows: with a reference that rests half the time, faults may get a wrong name.

    Source: Kulhavy and Karny, Tracking of slowly varying parameters by directional forgetting (1984).
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
    if not strength > 0.0:
        for i in range(n):
            K[i] = 0.0
        return 0 if strength == 0.0 else 1
    l = memory / (memory + n)
    root = np.sqrt(strength)
    s = strength / R
    for i in range(n):
        K[i] = g[i] / (R + strength)
        theta[i] += K[i] * e
        g[i] /= root  # now |g[i]| <= sqrt(P[i, i]) however small phi is: nothing below can overflow
    # s eps/(1 + s eps) with 1 + s eps = l (1 + s)
    step = (l * s - (1.0 - l)) / (l * (1.0 + s))
    for i in range(n):
        for j in range(i + 1):
            P[i, j] -= step * g[i] * g[j]
            P[j, i] = P[i, j]
    return 0
