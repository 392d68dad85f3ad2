"""Recursive least squares with exponential forgetting, l = 1 - 1/memory: it forgets what nothing replaces."""

from __future__ import annotations

import functools
import math
import sys
from typing import Any

from servoscope.core.jit import maximum, sum_products, where
from servoscope.estimation.update import Matrix, Numbers, Update, symmetric

NAME = "rls"
NEEDS_INSTRUMENT = False
EXCEPTIONS = {
    "no windup": "P is divided by l, excited or not: at phi = 0 it grows e-fold every `memory` updates",
    "contracts": "P wavers around P_d, where forgetting and what the samples bring balance on average",
    "mean": "after a rest its gain is larger than the one the expectation follows; good where excitation stays alike",
}


def update(
    theta: Numbers, P: Matrix, P_d: Matrix, R: Any, memory: Any, eta: Any, phi: Numbers, z: Numbers, extra: Any
) -> Update:
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
    n = len(theta)
    l = 1.0 - 1.0 / maximum(memory, 2.0)
    g = [sum_products(row, phi) for row in P]
    e = sum_products([-x for x in phi], theta, eta)
    strength = sum_products(phi, g)
    largest = functools.reduce(maximum, (P[i][i] for i in range(n)))
    denominator = l * R + strength
    K = [x / denominator for x in g]
    new = Update(
        [x + gain * e for x, gain in zip(theta, K, strict=True)],
        symmetric(lambda i, j: (P[i][j] - g[i] * K[j]) / l, n),
        K,
    )
    valid = (strength >= 0.0) & (strength < math.inf) & (largest < 0.5 * l * sys.float_info.max)
    return new.where(valid, theta, P, where(valid, 0.0, 1.0))
