"""Recursive least squares with covariance resetting: no forgetting, but a fresh start once per memory."""

from __future__ import annotations

import math
from typing import Any

from servoscope.core.jit import sum_products, where
from servoscope.estimation.update import Matrix, Numbers, Update, symmetric

NAME = "rls-reset"
NEEDS_INSTRUMENT = False
EXCEPTIONS = {
    "contracts": "P is a sawtooth: it shrinks like 1/k and is reset to (e - 1) P_d",
    "mean": "its gain is a sawtooth: the expectation is good where theta_hat has converged",
}


def extra_state_size(n: int, memory: float) -> int:
    """Return the size of the private state: the number of excited updates since P was reset."""
    return 1


def update(
    theta: Numbers, P: Matrix, P_d: Matrix, R: Any, memory: Any, eta: Any, phi: Numbers, z: Numbers, extra: Any
) -> Update:
    """Take one step of RLS without forgetting (l = 1); after every `memory` excited updates P becomes (e - 1) P_d.

    P_d = (R/N) R_phi^-1 is worth N samples, so (e - 1) P_d is worth N/(e - 1) of them, and N further ones leave the
    old estimate a share of 1/e: one cycle is one memory. The first cycle starts at P_d and leaves 1/2. At phi = 0
    nothing moves, and the cycle does not age.

    **The statistic** is good where theta_hat has converged. S is right anywhere, but the expectation follows the gain
    at P_d, not the sawtooth: a healthy recording of another reference may alarm.

    Source: Goodwin and Sin, Adaptive Filtering Prediction and Control (1984), section 3.3.
    """
    g = [sum_products(row, phi) for row in P]
    e = sum_products([-x for x in phi], theta, eta)
    strength = sum_products(phi, g)
    K = [x / (R + strength) for x in g]
    age = where(strength > 0.0, extra[0] + 1.0, extra[0])
    again = age >= memory
    extra[0] = where(again, 0.0, age)
    return Update(
        [x + gain * e for x, gain in zip(theta, K, strict=True)],
        symmetric(
            lambda i, j: where(again, (math.e - 1.0) * P_d[i][j], P[i][j] - g[i] * g[j] / (R + strength)), len(theta)
        ),
        K,
    )
