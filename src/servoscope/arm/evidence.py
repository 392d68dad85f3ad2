"""How much better a change of an arm explains a recording than no change: Bayes factors over causes and onsets.

The residual e of a recording is X delta + X (d + B c) 1(t >= t_k) + noise. delta, how this recording differs from
others and what the coefficients are off, and d, what changes within healthy recordings, are random effects of known
covariance; c, the change from t_k on in the columns of one cause, has a Gaussian prior. All is linear and Gaussian, so
that each cause and onset has its evidence in closed form.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from servoscope.arm.baseline import ArmCause
from servoscope.arm.regression import Information
from servoscope.core.arrays import FloatArray

MIN_END_BLOCKS = 1  # blocks of a recording that a change has to last
INTERVAL = 1.96  # standard deviations, on both sides
EM_STEPS = 25  # of expectation and maximisation, after which the variances have settled
SIMULATED_RECORDINGS = 1000  # healthy ones, from which the limit comes
CONFIDENCE = 0.9  # that a variance between few recordings is not larger
PRIOR_COUNT = 3.0  # recordings that the prior of a variance counts for
BETWEEN_SHARE, DRIFT_SHARE = 0.1, 0.02  # prior of recordings and halves, as a share of the size of a change


class CauseEvidence(NamedTuple):
    """What a recording says of one cause."""

    cause: ArmCause
    log_factor: float  # logarithm of its Bayes factor against no change, over all onsets, times its prior
    onset: FloatArray  # (K,) probability of each block to be the first that has changed
    size: FloatArray  # (k,) of its columns, over all onsets
    covariance: FloatArray  # (k, k)


class ChangeEvidence(NamedTuple):
    """What a recording says of all causes, the likeliest first."""

    t: FloatArray  # (K,) where the blocks begin [s]
    log_factor: float  # of any change against none
    causes: tuple[CauseEvidence, ...]
    probability: FloatArray  # of each cause, if there is a change


class ChangeTest:
    """The evidence for causes and onsets in recordings with given columns.

    `information`: of P + D columns, coefficients before directions of change; `prior`: information of the random effect
    (P + D, P + D); `scale, drift`: standard deviations of a change and of what changes within healthy recordings, (D,).
    """

    def __init__(
        self,
        information: Information,
        prior: FloatArray,
        causes: Sequence[ArmCause],
        scale: FloatArray,
        drift: FloatArray,
    ) -> None:
        self._information, self._prior, self._causes, self._drift = information, prior, causes, drift
        first = prior.shape[0] - scale.size
        A = information.A[::-1].cumsum(0)[::-1][: max(1, len(information.A) - MIN_END_BLOCKS)]
        self._gain = np.linalg.solve(information.A.sum(0) + prior, A[:, :, first:])
        R = A[:, first:, first:] - A[:, first:] @ self._gain
        # what changes within healthy recordings may change in any direction, whatever the cause: (R^-1 + drift^2)^-1
        self._damping = np.linalg.inv(np.eye(scale.size) + R * drift**2)
        R = self._damping @ R
        self._terms = [_Term.of(R, list(cause.columns), scale) for cause in causes]
        odds = np.array([cause.odds for cause in causes])
        self._log_prior = np.log(odds / odds.sum())

    def weigh(self) -> ChangeEvidence:
        """Return the evidence of the recording itself."""
        r, drifted = self._change_vector(self._information.g[None])
        evidences = []
        for cause, term, log_prior in zip(self._causes, self._terms, self._log_prior, strict=True):
            sizes = term.sizes(r)[0]
            logs = term.log_factors(r)[0] + drifted[0]
            total = float(np.logaddexp.reduce(logs))
            onset = np.exp(logs - total)
            size = onset @ sizes
            off = sizes - size
            covariance = np.einsum("k,kij->ij", onset, term.covariance) + np.einsum("k,ki,kj->ij", onset, off, off)
            log_factor = total - float(np.logaddexp.reduce(drifted[0])) + float(log_prior)
            evidences.append(CauseEvidence(cause, log_factor, onset, size, covariance))
        logs = np.array([evidence.log_factor for evidence in evidences])
        order = np.argsort(-logs)
        total = float(np.logaddexp.reduce(logs))
        probability = np.exp(logs[order] - total)
        t = self._information.t[:-1]
        return ChangeEvidence(t, total, tuple(evidences[i] for i in order), probability)

    def healthy_limit(self, share: float) -> float:
        """Return what the logarithm of the Bayes factor of any change exceeds in a share of healthy recordings.

        From Monte Carlo simulation of recordings with the same columns, with random effect, drift and noise.
        """
        rng, A = np.random.default_rng(0), self._information.A
        values, vectors = np.linalg.eigh(A)
        noise = rng.normal(size=(SIMULATED_RECORDINGS, *values.shape)) * np.sqrt(np.maximum(values, 0.0))
        g = np.einsum("kij,skj->ski", vectors, noise)
        root = np.linalg.cholesky(np.linalg.inv(self._prior))
        effect = np.broadcast_to((rng.normal(size=(SIMULATED_RECORDINGS, len(root))) @ root.T)[:, None], g.shape).copy()
        onset = rng.integers(len(self._gain), size=SIMULATED_RECORDINGS)
        drift = rng.normal(size=(SIMULATED_RECORDINGS, self._drift.size)) * self._drift
        late = np.arange(len(A)) >= onset[:, None]
        effect[:, :, len(root) - self._drift.size :] += late[..., None] * drift[:, None]
        r, drifted = self._change_vector(g + np.einsum("kij,skj->ski", A, effect))
        logs = np.array([np.logaddexp.reduce(term.log_factors(r) + drifted, axis=1) for term in self._terms])
        logs -= np.logaddexp.reduce(drifted, axis=1)
        total = np.logaddexp.reduce(logs + self._log_prior[:, None], axis=0)
        return float(np.quantile(total, 1.0 - share))

    def _change_vector(self, g: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what vectors (S, K, P + D) say of a change from each onset on, (S, onsets, D).

        And the logarithm of the Bayes factor of what changes within healthy recordings alone, from each onset on,
        (S, onsets): the reference that all onsets share.
        """
        first = g.shape[2] - self._drift.size
        late = g[:, ::-1, first:].cumsum(1)[:, ::-1][:, : len(self._gain)]
        r = late - np.einsum("kpd,sp->skd", self._gain, g.sum(1))
        damped: FloatArray = np.asarray(np.einsum("kij,skj->ski", self._damping, r, optimize=True))
        return damped, 0.5 * ((r * damped) @ self._drift**2 + np.linalg.slogdet(self._damping)[1])


class _Term(NamedTuple):
    """What is constant in the evidence of a cause: columns (k,), covariance (K, k, k) of its size, and log det (K,)."""

    columns: list[int]
    covariance: FloatArray
    log_det: FloatArray

    @classmethod
    def of(cls, R: FloatArray, columns: list[int], scale: FloatArray) -> _Term:
        own = R[:, columns][:, :, columns]
        precision = (own + own.transpose(0, 2, 1)) / 2.0 + np.diag(scale[columns] ** -2.0)
        log_det = np.linalg.slogdet(precision * np.outer(scale[columns], scale[columns]))[1]
        covariance: FloatArray = np.asarray(np.linalg.inv(precision), dtype=np.float64)
        return cls(columns, covariance, np.asarray(log_det, dtype=np.float64))

    def sizes(self, r: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("kij,skj->ski", self.covariance, r[:, :, self.columns]))

    def log_factors(self, r: FloatArray) -> FloatArray:
        return np.asarray(0.5 * np.einsum("ski,ski->sk", r[:, :, self.columns], self.sizes(r)) - 0.5 * self.log_det)


def second_half(information: Information, prior: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return what a recording says of its second half against its first: information (D, D) and vector (D,)."""
    middle = len(information.A) // 2
    A, g = information.A.sum(0), information.g.sum(0)
    late = information.A[middle:].sum(0)
    gain = np.linalg.solve(A + prior, late)
    return late - late @ gain, information.g[middle:].sum(0) - gain.T @ g


def random_effect(parts: Sequence[tuple[FloatArray, FloatArray]], scale: FloatArray, share: float) -> FloatArray:
    """Return the upper confidence limit of the standard deviation (D,) of deviations, one per part.

    By expectation and maximisation.

    `parts`: information (D, D) and vector (D,) of each; `share`: of `scale` (D,), which a variance has a priori.
    """
    from scipy.stats import chi2

    start, freedom = (share * scale) ** 2, PRIOR_COUNT + len(parts)
    variance = start.copy()
    for _ in range(EM_STEPS):
        total = PRIOR_COUNT * start
        for A, g in parts:
            covariance = np.linalg.inv(A + np.diag(1.0 / variance))
            total = total + (covariance @ g) ** 2 + np.diag(covariance)
        variance = total / freedom
    return np.asarray(np.sqrt(variance * freedom / chi2.ppf(1.0 - CONFIDENCE, freedom)))
