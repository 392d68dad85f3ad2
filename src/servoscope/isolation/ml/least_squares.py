"""Columns of least-squares problems whose unknowns have very different units: brought to one length, and projected."""

from __future__ import annotations

import numpy as np

from servoscope.core.arrays import FloatArray

RANK_TOLERANCE = 1e-7  # of a column's length, below which it says nothing new
MIN_LENGTH = 1e-300  # length of a column that is not zero


def normalise_columns(columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return columns (N, k) of length one, and the lengths that they had, shape (k,)."""
    size = np.maximum(np.linalg.norm(columns, axis=0), MIN_LENGTH)
    return columns / size, size


def orthonormal_basis(columns: FloatArray) -> FloatArray:
    """Return an orthonormal basis of columns (N, k), those left out that say nothing new."""
    from scipy.linalg import qr

    if not columns.shape[1]:
        return columns
    scaled, size = normalise_columns(columns)
    Q, R, _ = qr(scaled[:, size > RANK_TOLERANCE], mode="economic", pivoting=True)
    return np.asarray(Q[:, np.abs(np.diag(R)) > RANK_TOLERANCE])


def explained_sum_of_squares(J: FloatArray, residual: FloatArray) -> float:
    """Return by how much the unknowns of a problem can lower the sum of squares of its residual, in one step."""
    Q, _ = np.linalg.qr(normalise_columns(J)[0])
    return float(((Q.T @ residual) ** 2).sum())


def solve_least_squares(J: FloatArray, residual: FloatArray) -> tuple[FloatArray, float]:
    """Return the unknowns that make ``residual + J step`` smallest, and the sum of squares that is left."""
    scaled, size = normalise_columns(J)
    Q, R = np.linalg.qr(scaled)
    step = -np.linalg.lstsq(R, Q.T @ residual, rcond=None)[0] / size
    return step, float(((residual + J @ step) ** 2).sum())


def last_unknown_std(J: FloatArray) -> float:
    """Return the standard deviation of the last unknown of a least-squares problem with Jacobian J (N, k)."""
    others, own = J[:, :-1], J[:, -1]
    if others.shape[1]:
        Q, _ = np.linalg.qr(normalise_columns(others)[0])
        own = own - Q @ (Q.T @ own)
    length = float(np.linalg.norm(own))
    return 1.0 / length if length > 0.0 else np.inf
