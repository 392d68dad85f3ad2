"""Instrumental-variable adaptive Kalman filter: the instrument z keeps the noise of phi out of the gain."""

from __future__ import annotations

from typing import Any

from servoscope.core.jit import sum_products, where
from servoscope.estimation.update import Matrix, Numbers, Update, symmetric

NAME = "iv-akf"
NEEDS_INSTRUMENT = True


def update(
    theta: Numbers, P: Matrix, P_d: Matrix, R: Any, memory: Any, eta: Any, phi: Numbers, z: Numbers, extra: Any
) -> Update:
    """Take one step with the symmetric instrumental gain (Young, 2011): phi is in e alone.

    K = P z/(R + z' P z), P by (11) with z. No noise of phi is in gain or covariance: to skip samples by the sign of
    phi' P z would be to choose them by their noise, which is a bias. A residual out of all proportion is refused
    (status 1).
    """
    g, g_d = ([sum_products(row, z) for row in matrix] for matrix in (P, P_d))
    e = sum_products([-x for x in phi], theta, eta)
    denominator, denominator_d = sum_products(z, g, R), sum_products(z, g_d, R)
    K = [x / denominator for x in g]
    new = Update(
        [x + gain * e for x, gain in zip(theta, K, strict=True)],
        symmetric(lambda i, j: P[i][j] + (g_d[i] * g_d[j] / denominator_d - g[i] * g[j] / denominator), len(theta)),
        K,
    )
    # no signal reaches this: where z points away from phi, theta would grow until it overflows
    refused = e * e > 1e12 * R
    return new.where(e * e <= 1e12 * R, theta, P, where(refused, 1.0, 0.0))
