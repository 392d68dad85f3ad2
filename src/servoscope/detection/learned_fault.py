"""Faults known from labelled recordings: where theta_hat goes under one, how sure that is, and its signature."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Self

import numpy as np
from pydantic import BaseModel, ConfigDict, model_validator

from servoscope.core.arrays import FloatArray
from servoscope.detection.homogeneity import scatter
from servoscope.detection.result import SEVERITY
from servoscope.detection.signature import Signature, parameter_signature
from servoscope.models.plants import Fault

SHARES = (0.05, 10.0)  # of the labelled severity that are searched
ROUNDS = 50  # of the alternation between direction and shares; five are usual


class LearnedFault(BaseModel):
    """What a baseline knows of a fault from labelled recordings of it."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    name: str
    deviation: tuple[float, ...]  # by how much theta differs from healthy at the labelled severity, shape (n,)
    # of the deviation of a further recording of that severity around it, the noise of its own estimate aside: noise
    # of the labelled recordings, and what they differ by beside their severity, shape (n, n)
    covariance: tuple[tuple[float, ...], ...]
    # recordings, shares: names of the labelled recordings, and the severity of each relative to their mean
    recordings: tuple[str, ...]
    shares: tuple[float, ...]

    @model_validator(mode="after")
    def _check_consistency(self) -> Self:
        n, C = len(self.deviation), self.covariance
        if not any(self.deviation):
            raise ValueError(f"{self.name}: deviation must not be zero")
        if len(C) != n or any(len(row) != n for row in C):
            raise ValueError(f"{self.name}: covariance must be {n} by {n}")
        size = np.sqrt(np.maximum(np.diag(C), 0.0))
        scaled = np.array(C) / np.outer(size, size) if size.all() else -np.eye(n)
        if not np.allclose(scaled, scaled.T, atol=1e-6) or np.linalg.eigvalsh((scaled + scaled.T) / 2.0)[0] < -1e-9:
            raise ValueError(f"{self.name}: covariance must be symmetric and positive")
        if not self.recordings or len(self.shares) != len(self.recordings):
            raise ValueError(f"{self.name}: shares must have one value per recording")
        return self

    @classmethod
    def from_recordings(
        cls, name: str, recordings: Sequence[str], deviations: FloatArray, covariances: FloatArray, healthy: FloatArray
    ) -> LearnedFault:
        """Learn a direction from recordings that may differ in severity: d_j = a_j s, with a mean of 1 over a_j.

        Direction s and shares a_j minimise the sum of (d_j - a_j s)' (C_j + C)^-1 (d_j - a_j s), a weighted
        approximation of rank one (Gabriel and Zamir, 1979). What is left beside the severities counts as scatter
        between recordings, by the rule for healthy ones.

        `deviations, covariances`: d_j, theta of each recording minus its healthy expectation, shape (m, n), and C_j
        of their noise, (m, n, n); `healthy`: c, the covariance of a healthy recording around the baseline, shape
        (n, n).
        """
        C = covariances + healthy
        size = np.sqrt(np.diagonal(C, axis1=1, axis2=2).mean(axis=0))
        d, W = deviations / size, np.linalg.inv(C / np.outer(size, size))
        s, a = d.mean(axis=0), np.ones(len(d))
        for _ in range(ROUNDS):
            a = np.einsum("a,jab,jb->j", s, W, d) / np.einsum("a,jab,b->j", s, W, s)
            known = np.linalg.inv(np.einsum("j,jab->ab", a**2, W))
            s = known @ np.einsum("j,jab,jb->a", a, W, d)
            s, a, known = s * a.mean(), a / a.mean(), known * a.mean() ** 2
        own = known * np.outer(size, size)
        between = scatter(deviations - a[:, None] * (s * size), C)
        return cls(
            name=name,
            deviation=tuple(float(x) for x in s * size),
            covariance=tuple(tuple(float(x) for x in row) for row in own + between),
            recordings=tuple(recordings),
            shares=tuple(float(x) for x in a),
        )

    @property
    def distinctness(self) -> float:
        """Squared distance of the deviation from healthy in units of its own covariance: how clear the direction is.

        A direction is told from another at an angle phi where ``distinct * tan(phi)**2`` exceeds the limit of a misfit.
        """
        size = np.sqrt(np.diag(self.covariance))
        s = np.array(self.deviation) / size
        return float(s @ np.linalg.solve(np.array(self.covariance) / np.outer(size, size), s))

    def signature(self, taken_up: FloatArray) -> Signature:
        """Return the ray along which theta_hat moves as the share of the labelled severity grows.

        The scatter of the direction grows with the share. Along the ray the misfit of a deviation that points elsewhere
        then tends to `distinct`, however large it is.

        `taken_up`: share of a change that theta_hat has taken up by now, I - Psi, shape (n, n).
        """
        moved = taken_up @ np.array(self.deviation)
        C = taken_up @ np.array(self.covariance) @ taken_up.T
        words = Fault(self.name, SEVERITY, SHARES, self.name)
        ray = parameter_signature(words, lambda share: share * moved)
        return replace(ray, scatter=lambda x: float(np.exp(2.0 * x)) * C)
