"""Scatter of healthy coefficients as random effects, by expectation maximisation (Laird and Ware, 1982)."""

from __future__ import annotations

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.sums.evidence import posterior, running_sums

STEPS = 200  # of the maximisation
PRIOR_DOF = 2.0  # recordings that the floor of a scatter counts for
FLOOR = 0.004  # of every scatter, relative: no two healthy days are more alike
MIN_SHARE = 0.1  # of the usual excitation, from which a block shows the noise
RIDGE = 1e-6
TAIL_DEGREES = 4.0  # of freedom of Student's t, of which the scores of blocks are


def floor_variance(unit: FloatArray) -> FloatArray:
    """Return the smallest variance of coefficients between any two stretches, shape (p,)."""
    return np.asarray((FLOOR * unit) ** 2)


def random_effect(M: FloatArray, w: FloatArray, floor: FloatArray, lost: float = 0.0) -> FloatArray:
    """Return the covariance (p, p) of deviations over K stretches of information M (K, p, p) and score w (K, p).

    `floor`: smallest variances (p,); `lost`: stretches' worth of means that the scores are about.
    """
    K, p = w.shape
    start = np.linalg.solve(M + np.diag(1e-3 / floor), w[..., None])[..., 0]
    S = np.diag(np.maximum(np.median(start**2, axis=0), floor))
    for _ in range(STEPS):
        mean, P = posterior(M, w, S)
        counted = K / max(K - lost, 0.5)
        grown = (P.sum(axis=0) + counted * mean.T @ mean + PRIOR_DOF * np.diag(floor)) / (K + PRIOR_DOF)
        done = _is_settled(S, grown, floor, 1e-4)
        S = grown
        if done:
            break
    return _shrunk(S, (K - lost) / (K - lost + p))


def block_noise(A: FloatArray, g: FloatArray, recordings: int) -> float:
    """Return kappa of scores ``g ~ N(0, kappa A)`` of blocks (K, p) about their recording's own fit."""
    usual = np.diag(A.mean(axis=0))
    shown = np.flatnonzero((np.diagonal(A, axis1=1, axis2=2) / usual).mean(axis=1) > MIN_SHARE)
    A, g = A[shown], g[shown]
    K, p = g.shape
    solved = np.linalg.solve(A + RIDGE * np.diag(usual), g[..., None])[..., 0]
    counted = max(K - recordings, 1)  # each recording's own fit took one away
    return float(np.einsum("ki,ki->", g, solved) / (p * counted) + np.finfo(np.float64).tiny)


def block_weights(M: FloatArray, w: FloatArray, prior: FloatArray, length: int) -> FloatArray:
    """Return by how much each block counts, at most 1, shape (K,), as of Student's t (Lange, Little and Taylor, 1989).

    A block that agrees with so many blocks before it, or with those after it, counts in full, so that a change costs
    nothing; one that agrees with neither, as in slow motion, where friction is no term, hardly does. M (K, p, p) and
    w (K, p): information and score of each; `prior` (p, p): covariance of the coefficients of its neighbours.
    """
    K, p = w.shape
    sums_M, sums_w, at = running_sums(M), running_sums(w), np.arange(K)
    I = np.eye(p)
    ridge = (1e-9 * M.diagonal(axis1=1, axis2=2) + np.finfo(np.float64).tiny)[:, :, None] * I
    square = np.full(K, np.inf)
    for begin, end in ((np.maximum(at - length, 0), at), (at + 1, np.minimum(at + 1 + length, K))):
        theta, P = posterior(sums_M[end] - sums_M[begin], sums_w[end] - sums_w[begin], prior)
        off = w - np.einsum("kij,kj->ki", M, theta)
        # off' (M + M P M)^-1 off, which is that of the estimate of a block, in what it shows
        known, estimate = np.linalg.solve(np.array([I + (M + ridge) @ P, M + ridge]), off[..., None])[..., 0]
        apart = np.einsum("ki,ki->k", estimate, known)
        square = np.where(end > begin, np.minimum(square, apart), square)
    return np.asarray(np.minimum((TAIL_DEGREES + p) / (TAIL_DEGREES + square), 1.0))


def _is_settled(S: FloatArray, grown: FloatArray, floor: FloatArray, share: float) -> bool:
    """Return whether a covariance has stopped to change, in the units of its floor (p,)."""
    units = np.sqrt(np.outer(floor, floor))
    return float(np.abs((grown - S) / units).max()) < share * float(np.abs(grown / units).max())


def _shrunk(S: FloatArray, share: float) -> FloatArray:
    """Return a covariance with a share of its correlations: few stretches show none."""
    return np.asarray(share * S + (1.0 - share) * np.diag(np.diag(S)))
