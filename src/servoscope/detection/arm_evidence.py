"""How much better a change of an arm explains a recording than no change: Bayes factors over causes and onsets.

The residual e of a recording is X delta + X B c 1(t >= t_k) + noise: delta, how this recording differs from others and what
the coefficients are off, is a random effect of known covariance; c, the change from t_k on in the columns of one cause, has
a Gaussian prior. All is linear and Gaussian, so that each cause and onset has its evidence in closed form.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from servoscope.baseline.arm import Cause
from servoscope.core.arrays import FloatArray
from servoscope.estimation.arm_regression import Information

SHORTEST_END = 3  # blocks of a recording that a change has to last
INTERVAL = 1.96  # standard deviations, on both sides
EM_STEPS = 25  # of expectation and maximisation, after which the variances have settled
PRIOR_COUNT = 3.0  # recordings that the prior of a variance counts for
BETWEEN_SHARE, DRIFT_SHARE = 0.1, 0.02  # prior of recordings and halves, as a share of the size of a change


class CauseEvidence(NamedTuple):
    """What a recording says of one cause."""

    cause: Cause
    log_factor: float  # logarithm of its Bayes factor against no change, over all onsets
    onset: FloatArray  # (K,) probability of each block to be the first that has changed
    size: FloatArray  # (k,) of its columns, at the likeliest onset
    covariance: FloatArray  # (k, k)


class ChangeEvidence(NamedTuple):
    """What a recording says of all causes, the likeliest first."""

    t: FloatArray  # (K,) where the blocks begin [s]
    log_factor: float  # of any change against none
    causes: tuple[CauseEvidence, ...]
    probability: FloatArray  # of each cause, if there is a change


def weigh_changes(
    information: Information, prior: FloatArray, causes: Sequence[Cause], scale: FloatArray, drift: FloatArray
) -> ChangeEvidence:
    """Return the evidence of a recording for each cause.

    `information`: of P + D columns, coefficients before directions of change; `prior`: information of the random effect
    (P + D, P + D); `scale, drift`: standard deviations of a change and of what changes within healthy recordings, (D,).
    """
    first = prior.shape[0] - scale.size
    A, g = information.A[::-1].cumsum(0)[::-1], information.g[::-1].cumsum(0)[::-1]
    gain = np.linalg.solve(A[0] + prior, A[:, :, first:])
    R = A[:, first:, first:] - A[:, first:] @ gain
    r = g[:, first:] - np.einsum("kpd,p->kd", gain, g[0])
    onsets = max(1, len(A) - SHORTEST_END)
    found = []
    for cause in causes:
        columns = list(cause.columns)
        size, covariance, log_factor = _posterior(
            R[:onsets, columns][:, :, columns], r[:onsets, columns], scale[columns], drift[columns]
        )
        total = float(np.logaddexp.reduce(log_factor))
        best = int(log_factor.argmax())
        found.append(
            CauseEvidence(cause, total - np.log(onsets), np.exp(log_factor - total), size[best], covariance[best])
        )
    logs = np.array([each.log_factor for each in found])
    order = np.argsort(-logs)
    total = float(np.logaddexp.reduce(logs))
    probability = np.exp(logs[order] - total)
    return ChangeEvidence(information.t[:-1], total - np.log(len(logs)), tuple(found[i] for i in order), probability)


def _posterior(
    R: FloatArray, r: FloatArray, scale: FloatArray, drift: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return size (K, k), its covariance (K, k, k), and log Bayes factor (K,) of changes with information R, r."""
    k = scale.size
    damped = np.eye(k) + R * drift**2  # (R^-1 + drift^2)^-1 = (1 + R drift^2)^-1 R
    R, r = np.linalg.solve(damped, R), np.linalg.solve(damped, r[..., None])[..., 0]
    precision = (R + R.transpose(0, 2, 1)) / 2.0 + np.diag(scale**-2.0)
    covariance = np.linalg.inv(precision)
    size = np.einsum("kij,kj->ki", covariance, r)
    log_factor = 0.5 * np.einsum("ki,ki->k", r, size) - 0.5 * np.linalg.slogdet(precision * np.outer(scale, scale))[1]
    return size, covariance, log_factor


def second_half(information: Information, prior: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return what a recording says of its second half against its first: information (D, D) and vector (D,)."""
    middle = len(information.A) // 2
    A, g = information.A.sum(0), information.g.sum(0)
    late = information.A[middle:].sum(0)
    gain = np.linalg.solve(A + prior, late)
    return late - late @ gain, information.g[middle:].sum(0) - gain.T @ g


def random_effect(parts: Sequence[tuple[FloatArray, FloatArray]], scale: FloatArray, share: float) -> FloatArray:
    """Return the standard deviation (D,) of deviations, one per part, by expectation and maximisation.

    `parts`: information (D, D) and vector (D,) of each; `share`: of `scale` (D,), which a variance has a priori.
    """
    start = (share * scale) ** 2
    variance = start.copy()
    for _ in range(EM_STEPS):
        total = PRIOR_COUNT * start
        for A, g in parts:
            covariance = np.linalg.inv(A + np.diag(1.0 / variance))
            total = total + (covariance @ g) ** 2 + np.diag(covariance)
        variance = total / (PRIOR_COUNT + len(parts))
    return np.sqrt(variance)
