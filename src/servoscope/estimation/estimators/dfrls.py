"""Recursive least squares with directional forgetting: only what a sample speaks of is forgotten."""

from __future__ import annotations

from typing import Any

from servoscope.core.jit import sqrt, sum_products, where
from servoscope.estimation.update import Matrix, Numbers, Update, symmetric

NAME = "dfrls"
NEEDS_INSTRUMENT = False
EXCEPTIONS = {
    "contracts": "P has no P_d to go to: along excited directions it wavers around a level of its own",
    "mean": "P wanders from P_d, and the gain with it: the expectation is good where theta_hat has converged",
}


def update(
    theta: Numbers, P: Matrix, P_d: Matrix, R: Any, memory: Any, eta: Any, phi: Numbers, z: Numbers, extra: Any
) -> Update:
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
    g = [sum_products(row, phi) for row in P]
    e = sum_products([-x for x in phi], theta, eta)
    strength = sum_products(phi, g)
    excited = strength > 0.0
    l = memory / (memory + float(n))
    s = strength / R
    K = [x / (R + strength) for x in g]
    h = [
        x / sqrt(where(excited, strength, 1.0)) for x in g
    ]  # |h[i]| <= sqrt(P[i][i]) however small phi is: nothing below can overflow
    # s eps/(1 + s eps) with 1 + s eps = l (1 + s)
    step = (l * s - (1.0 - l)) / (l * (1.0 + s))
    new = Update(
        [x + gain * e for x, gain in zip(theta, K, strict=True)],
        symmetric(lambda i, j: P[i][j] - step * h[i] * h[j], n),
        K,
    )
    return new.where(excited, theta, P, where(excited | (strength >= 0.0), 0.0, 1.0))
