"""Adaptive Kalman filter of Stenlund and Gustafsson: P forgets towards P_d along excited directions only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from servoscope.core.jit import dot, sum_products
from servoscope.estimation.update import Matrix, Numbers, Update, symmetric

NAME = "akf"
NEEDS_INSTRUMENT = False


def steady_gain(R: Any, phi: Sequence[Any]) -> list[Any]:
    """Return the gain of a filter that began at P = P_d, for a phi (n) scaled so that P_d is I.

    (11) leaves P = P_d where it is, exactly: what is left of `update` is K = P_d phi/(R + phi' P_d phi).
    """
    factor = 1.0 / (R + dot(phi, phi))
    return [x * factor for x in phi]


def update(
    theta: Numbers, P: Matrix, P_d: Matrix, R: Any, memory: Any, eta: Any, phi: Numbers, z: Numbers, extra: Any
) -> Update:
    """Take one step of eqs. (7) to (9) and (11); the erratum of (10), P(k-1) in the denominator, is mended.

    Source: Stenlund and Gustafsson (2002); Medvedev (2003). At phi = 0 nothing moves: no covariance windup.
    """
    return step_along(phi, theta, P, P_d, R, sum_products([-x for x in phi], theta, eta))


def step_along(z: Numbers, theta: Numbers, P: Matrix, P_d: Matrix, R: Any, e: Any) -> Update:
    """Return the update by a residual e along z: phi, or the instrument in its place."""
    g, g_d = ([sum_products(row, z) for row in matrix] for matrix in (P, P_d))
    denominator, denominator_d = sum_products(z, g, R), sum_products(z, g_d, R)
    K = [x / denominator for x in g]
    return Update(
        [x + gain * e for x, gain in zip(theta, K, strict=True)],
        symmetric(lambda i, j: P[i][j] + (g_d[i] * g_d[j] / denominator_d - g[i] * g[j] / denominator), len(theta)),
        K,
    )
