"""Whether a hypothesis explains everything: what is left of the innovations against what a wrong model would leave."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.isolation.ml.least_squares import normalise_columns, orthonormal_basis
from servoscope.isolation.ml.predictor import Predictor
from servoscope.isolation.ml.window import ChangeProfile, RefitWindow

LAGS = 6  # samples of u and of y that a wrong dynamic model may have missed
MISFIT = 1e-3  # probability with which a true hypothesis may fit worse than the limit
SYSTEMATIC = 2e-3  # share of a change that nominal parameters may be off by


@dataclass(frozen=True)
class GoodnessOfFit:
    """A test of what is left."""

    # sum of squares that the `misspecification_columns` take out, chi-square with `dof` degrees of freedom if nothing
    # but noise is left
    statistic: float
    dof: int  # number of columns that say something of their own
    limit: float  # what a true hypothesis passes in one of a thousand cases


def misspecification_columns(
    window: RefitWindow, predictor: Predictor, profile: ChangeProfile, where: BoolArray
) -> FloatArray:
    """Return what wrong models leave in the innovations, shape (N, q).

    Missed dynamics: u and y of the last samples, as additions to y; backlash: the sign of y', added to y; Coulomb
    friction: the same, added to u; offsets of both. `where` (N,) are the samples from which they count.
    """
    u, y = window.u, window.y
    moving = np.sign(_speed(y))
    nothing = np.zeros(window.samples)
    to_y = [_later(x, lag) for x in (u, y) for lag in range(1, LAGS + 1)] + [_later(moving, 1), np.ones(window.samples)]
    to_u = [_later(moving, 1), np.ones(window.samples)]
    columns = [window.disturbance_response(predictor, profile, nothing, column * where) for column in to_y]
    columns += [window.disturbance_response(predictor, profile, column * where, nothing) for column in to_u]
    return np.array(columns).T


def score_test(
    Z: FloatArray, jacobian: FloatArray, residual: FloatArray, noise_variance: float, shift: float
) -> GoodnessOfFit:
    """Test whether columns Z (N, q) explain part of a residual that the unknowns of the fit do not.

    Score test (Rao, 1948): both are projected off the Jacobian (N + m, k) first.

    `Z, jacobian, residual`: columns, and the least-squares problem at its end; the last rows of the latter are the
    prior's; `shift`: root of the sum of squares that the change adds to healthy innovations: a share of it may be
    left.
    """
    from scipy import special

    Z = np.vstack([Z, np.zeros((len(residual) - len(Z), Z.shape[1]))])
    Q = orthonormal_basis(jacobian)
    Z, _ = normalise_columns(Z)
    own = orthonormal_basis(Z - Q @ (Q.T @ Z))
    dof = own.shape[1]
    left = residual - Q @ (Q.T @ residual)
    statistic = float(((own.T @ left) ** 2).sum()) / noise_variance
    limit = float(special.chdtri(max(dof, 1), MISFIT)) + (SYSTEMATIC * shift) ** 2 / noise_variance
    return GoodnessOfFit(statistic, dof, limit)


def _later(x: FloatArray, samples: int) -> FloatArray:
    return np.concatenate([np.full(samples, x[0]), x[:-samples]])


def _speed(y: FloatArray, over: int = 5) -> FloatArray:
    """Return the difference over a few samples, so that noise does not decide its sign as long as there is motion."""
    return np.concatenate([np.zeros(over), y[over:] - y[:-over]])
