"""The Bayes factor of a change of coefficients, given information M and score w of a stretch.

Of a stretch with the estimate ``M^-1 w`` and its covariance ``M^-1``, whose coefficients deviate by N(0, S) (Bishop,
2006, section 3.5): ``log p(w | S)/p(w | 0) = w' (M + S^-1)^-1 w / 2 - log det(I + S M) / 2``. M and w are sums over
blocks. Nothing needs an inverse of M, so that a block at rest, with M = 0, adds nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray


def evidence(M: FloatArray, w: FloatArray, S: FloatArray) -> FloatArray:
    """Return the logarithm of the Bayes factor of a deviation N(0, S) over none; M (..., p, p), w (..., p)."""
    X = np.eye(M.shape[-1]) + M @ S
    gain = np.einsum("...i,...i->...", w @ S, np.linalg.solve(X, w[..., None])[..., 0])
    return np.asarray(0.5 * gain - 0.5 * np.linalg.slogdet(X)[1])


def directional_evidence(M: FloatArray, w: FloatArray, S: FloatArray, D: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the `evidence` of N(0, S), shape (...), and of N(0, S + d d') for each column d of D (p, k), (..., k)."""
    X = np.eye(M.shape[-1]) + M @ S
    solved = np.linalg.solve(X, np.concatenate([M @ D, w[..., None]], axis=-1))  # (M^-1 + S)^-1 [D, estimate]
    moved, w_S = solved[..., -1], w @ S
    plain = 0.5 * np.einsum("...i,...i->...", w_S, moved) - 0.5 * np.linalg.slogdet(X)[1]
    spread = np.einsum("ik,...ik->...k", D, solved[..., :-1])
    gain = 0.5 * (moved @ D) ** 2 / (1.0 + spread) - 0.5 * np.log1p(spread)
    return np.asarray(plain), np.asarray(plain[..., None] + gain)


def posterior(M: FloatArray, w: FloatArray, S: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean (..., p) and covariance (..., p, p) of a deviation N(0, S) of which M and w are seen."""
    P = np.linalg.solve(np.eye(M.shape[-1]) + S @ M, np.broadcast_to(S, M.shape))
    return np.einsum("...ij,...j->...i", P, w), np.asarray(0.5 * (P + np.swapaxes(P, -1, -2)))


def running_sums(a: FloatArray) -> FloatArray:
    """Return the sums of all rows before each, shape (K + 1, ...)."""
    return np.concatenate([np.zeros_like(a[:1]), np.cumsum(a, axis=0)])


class ChangePrior(NamedTuple):
    """How coefficients of a stretch deviate: healthy, along the direction of one cause, or anyhow."""

    inside: FloatArray  # covariance of healthy stretches, shape (p, p)
    wide: FloatArray  # further covariance of a change of all coefficients, shape (p, p)
    directions: FloatArray  # of causes, each as long as changes are, shape (p, k)
    cost: float  # of a stretch with coefficients of its own [nats]

    def evidence(self, M: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the evidence of healthy and of changed coefficients, each of shape (...)."""
        healthy, single = directional_evidence(M, w, self.inside, self.directions)
        changed = evidence(M, w, self.inside + self.wide)
        if single.shape[-1]:
            changed = np.maximum(changed, single.max(axis=-1) - np.log(single.shape[-1]))
        return healthy, changed - self.cost
