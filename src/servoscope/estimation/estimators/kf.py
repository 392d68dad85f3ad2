"""Standard Kalman filter of a random walk: P grows by Q at every update, excited or not."""

from __future__ import annotations

from typing import Any

from servoscope.core.jit import sum_products
from servoscope.estimation.update import Matrix, Numbers, Update, symmetric

NAME = "kf"
NEEDS_INSTRUMENT = False
EXCEPTIONS = {
    "no windup": "Q is added whether or not phi says anything: at phi = 0, P grows by P_d every `memory` updates",
    "contracts": "P wavers around P_d, where the growth by Q and what the samples take away balance on average",
    "mean": "after a rest its gain is larger than the one the expectation follows; good where excitation stays alike",
}


def update(
    theta: Numbers, P: Matrix, P_d: Matrix, R: Any, memory: Any, eta: Any, phi: Numbers, z: Numbers, extra: Any
) -> Update:
    """Take one step of eqs. (7) to (10), with P(k-1) in the denominator of (10) as in (9), and Q = P_d / memory.

    With P_d = (R/N) R_phi^-1, the mean of (10) has the fixed point P R_phi P / R = Q = P_d / N, that is P = P_d: gain
    and memory are then those of the AKF and of RLS with l = 1 - 1/N.

    **The statistic** is good where excitation stays alike. S is right under any, but after a rest the gain is larger
    than the one that the expectation follows: a healthy recording full of rests, judged by a baseline without, alarms.

    Source: Gustafsson, Adaptive Filtering and Change Detection (2000), algorithm 8.1.
    """
    g = [sum_products(row, phi) for row in P]
    e = sum_products([-x for x in phi], theta, eta)
    denominator = R + sum_products(phi, g)
    K = [x / denominator for x in g]
    return Update(
        [x + gain * e for x, gain in zip(theta, K, strict=True)],
        symmetric(lambda i, j: P[i][j] + (P_d[i][j] / memory - g[i] * g[j] / denominator), len(theta)),
        K,
    )
