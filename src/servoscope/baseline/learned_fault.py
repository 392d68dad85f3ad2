"""Faults known from labelled recordings: where theta_hat goes under one, how sure that is, and its signature."""

from __future__ import annotations

from typing import Self

import numpy as np
from pydantic import model_validator

from servoscope.baseline.records import BaselineModel, Matrix, Vector, is_covariance

SEVERITY = "severity"  # the parameter of a fault that was learned from labelled recordings


class LearnedFault(BaselineModel):
    """What a baseline knows of a fault from labelled recordings of it."""

    name: str
    deviation: Vector  # by how much theta differs from healthy at the labelled severity, shape (n,)
    # of the deviation of a further recording of that severity around it, the noise of its own estimate aside: noise
    # of the labelled recordings, and what they differ by beside their severity, shape (n, n)
    covariance: Matrix
    # recordings, shares: names of the labelled recordings, and the severity of each relative to their mean
    recordings: tuple[str, ...]
    shares: Vector

    @model_validator(mode="after")
    def _check_consistency(self) -> Self:
        n, C = len(self.deviation), self.covariance
        if not any(self.deviation):
            raise ValueError(f"{self.name}: deviation must not be zero")
        if len(C) != n or any(len(row) != n for row in C):
            raise ValueError(f"{self.name}: covariance must be {n} by {n}")
        if not (np.diag(C).all() and is_covariance(C)):
            raise ValueError(f"{self.name}: covariance must be symmetric and positive")
        if not self.recordings or len(self.shares) != len(self.recordings):
            raise ValueError(f"{self.name}: shares must have one value per recording")
        return self

    @property
    def distinctness(self) -> float:
        """Squared distance of the deviation from healthy in units of its own covariance: how clear the direction is.

        A direction is told from another at an angle phi where ``distinct * tan(phi)**2`` exceeds the limit of a misfit.
        """
        size = np.sqrt(np.diag(self.covariance))
        s = np.array(self.deviation) / size
        return float(s @ np.linalg.solve(np.array(self.covariance) / np.outer(size, size), s))
