"""Scatter of healthy coefficients as random effects, by expectation maximisation (Laird and Ware, 1982)."""

from __future__ import annotations

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.sums.evidence import posterior

STEPS = 200  # of the maximisation
PRIOR_DOF = 2.0  # recordings that the floor of a scatter counts for
FLOOR = 0.004  # of every scatter, relative: no two healthy days are more alike
FIRST_SHARE = 0.1  # of a coefficient, at which its scatter between blocks starts at most
MIN_SHARE = 0.1  # of the usual excitation, from which a block shows the noise
MAX_BLOCKS = 1000  # that the noise is estimated from
RIDGE = 1e-6


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


def block_noise(A: FloatArray, g: FloatArray, unit: FloatArray, recordings: int) -> tuple[float, FloatArray]:
    """Return kappa and S of scores ``g ~ N(0, kappa A + A S A)`` of blocks (K, p) about their recording's own fit.

    S is the error of the model by block: it follows the motion, and does not fall with the samples of a block.
    """
    usual = np.diag(A.mean(axis=0))
    shown = np.flatnonzero((np.diagonal(A, axis1=1, axis2=2) / usual).mean(axis=1) > MIN_SHARE)
    shown = shown[:: -(-len(shown) // MAX_BLOCKS)]
    A, g = A[shown], g[shown]
    K, p = g.shape
    regular = A + RIDGE * np.diag(usual)
    own = np.linalg.solve(regular, g[..., None])[..., 0]
    kappa = float(np.median(np.einsum("ki,ki->k", g, own)) / p) + 1e-300
    floor = floor_variance(unit)
    S = np.diag(np.clip(0.5 * np.median(own**2, axis=0), floor, (FIRST_SHARE * unit) ** 2))
    for _ in range(STEPS):
        mean, P = posterior(A / kappa, g / kappa, S)
        left = g - np.einsum("kij,kj->ki", A, mean)
        solved = np.linalg.solve(regular, left[..., None])[..., 0]
        level = float((np.einsum("ki,ki->k", left, solved) + np.einsum("kij,kji->k", A, P)).mean() / p)
        grown = (P.sum(axis=0) + mean.T @ mean + PRIOR_DOF * np.diag(floor)) / (K + PRIOR_DOF)
        done = abs(level / kappa - 1.0) < 1e-3 and _is_settled(S, grown, floor, 1e-3)
        kappa, S = max(level, 1e-12 * kappa), grown
        if done:
            break
    counted = max(K - recordings, 1)  # each recording's own fit took one away
    return kappa * K / counted, _shrunk(S, counted / (counted + p)) * K / counted


def _is_settled(S: FloatArray, grown: FloatArray, floor: FloatArray, share: float) -> bool:
    """Return whether a covariance has stopped to change, in the units of its floor (p,)."""
    units = np.sqrt(np.outer(floor, floor))
    return float(np.abs((grown - S) / units).max()) < share * float(np.abs(grown / units).max())


def _shrunk(S: FloatArray, share: float) -> FloatArray:
    """Return a covariance with a share of its correlations: few stretches show none."""
    return np.asarray(share * S + (1.0 - share) * np.diag(np.diag(S)))
