"""Instrumental-variable adaptive Kalman filter: the instrument z keeps the noise of phi out of the gain."""

from __future__ import annotations

from typing import Any

from servoscope.core.jit import sum_products, where
from servoscope.estimation.estimators.akf import step_along
from servoscope.estimation.update import Matrix, Numbers, Update

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
    e = sum_products([-x for x in phi], theta, eta)
    new = step_along(z, theta, P, P_d, R, e)
    # no signal reaches this: where z points away from phi, theta would grow until it overflows
    refused = e * e > 1e12 * R
    return new.where(e * e <= 1e12 * R, theta, P, where(refused, 1.0, 0.0))
