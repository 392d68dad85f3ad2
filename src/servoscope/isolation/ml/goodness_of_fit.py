"""Whether a hypothesis explains everything: what is left of the innovations against what a wrong model would leave."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.fit.tuning import sum_covariance
from servoscope.isolation.ml.least_squares import normalise_columns, orthonormal_basis
from servoscope.isolation.ml.window import ChangeProfile, ChangeWindow

MISFIT_BY_CHANCE = 1e-3  # probability with which a true hypothesis may fit worse than the limit


@dataclass(frozen=True)
class GoodnessOfFit:
    """A test of what is left."""

    # sum of squares that the `misspecification_columns` take out, chi-square with `dof` degrees of freedom if nothing
    # but noise is left
    statistic: float
    dof: int  # number of columns that say something of their own
    limit: float  # what a true hypothesis passes in one of a thousand cases


def misspecification_columns(
    window: ChangeWindow, predictor: Any, profile: ChangeProfile, where: BoolArray
) -> FloatArray:
    """Return what wrong models leave in the innovations, shape (N, q).

    The window's `unmodelled_signals`; `where` (N,) are the samples from which they count.
    """
    nothing = np.zeros(window.samples)
    to_y, to_u = window.unmodelled_signals()
    columns = [window.disturbance_response(predictor, profile, nothing, column * where) for column in to_y]
    columns += [window.disturbance_response(predictor, profile, column * where, nothing) for column in to_u]
    return np.array(columns).T


def score_test(
    Z: FloatArray, jacobian: FloatArray, residual: FloatArray, noise_variance: float, shift: float, coloured: int = 0
) -> GoodnessOfFit:
    """Test whether columns Z (N, q) explain part of a residual that the unknowns of the fit do not.

    Score test (Rao, 1948): both are projected off the Jacobian (N + m, k) first.

    `Z, jacobian, residual`: columns, and the least-squares problem at its end; the last rows of the latter are the
    prior's; `shift`: root of the sum of squares that may be left, because nominal parameters are a little off;
    `coloured`: samples over which the residual of a true hypothesis hangs together, 0 where it is white.
    """
    from scipy import special

    Z = np.vstack([Z, np.zeros((len(residual) - len(Z), Z.shape[1]))])
    Q = orthonormal_basis(jacobian)
    Z, _ = normalise_columns(Z)
    own = orthonormal_basis(Z - Q @ (Q.T @ Z))
    dof = own.shape[1]
    left = residual - Q @ (Q.T @ residual)
    scores = own * left[:, None]
    if coloured and dof:  # their long-run covariance (Newey and West, 1987)
        total = scores.sum(axis=0)
        statistic = float(total @ np.linalg.solve(sum_covariance(scores, coloured), total))
    else:
        statistic = float((scores.sum(axis=0) ** 2).sum()) / noise_variance
    limit = float(special.chdtri(max(dof, 1), MISFIT_BY_CHANCE)) + shift**2 / noise_variance
    return GoodnessOfFit(statistic, dof, limit)
