"""Sums of a recording, and what a set of equations offers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, Self

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.signals import Recording


class Sums(NamedTuple):
    """All that is kept of a recording: products of ``eta = phi' theta + e``, summed over blocks of equal length."""

    A: FloatArray  # sum of phi phi', shape (K, p, p)
    c: FloatArray  # sum of phi eta, shape (K, p)
    q: FloatArray  # sum of eta^2, shape (K,)
    n: FloatArray  # rows that count, shape (K,)
    begin_s: FloatArray  # time at which each block begins, shape (K,)
    block_s: float  # length of a block [s]
    x: FloatArray  # 1, then covariates of the recording, shape (m,)

    @classmethod
    def of_rows(cls, phi: FloatArray, eta: FloatArray, begin_s: FloatArray, block_s: float, x: Sequence[float]) -> Self:
        """Sum up rows that are cut into K blocks: phi (K, rows, p), eta (K, rows); a row that does not count is 0."""
        turned = np.swapaxes(phi, 1, 2)
        q, n = (eta**2).sum(axis=1), phi.any(axis=2).sum(axis=1).astype(np.float64)
        return cls(turned @ phi, (turned @ eta[..., None])[..., 0], q, n, begin_s, block_s, np.asarray(x, np.float64))

    def followed_by(self, other: Sums) -> Self:
        """Return the sums of this recording and what came after it."""
        A, c, q, n, begin_s = (np.concatenate([a, b]) for a, b in zip(self[:5], other[:5], strict=True))
        return self._replace(A=A, c=c, q=q, n=n, begin_s=begin_s)

    def part(self, begin: int, end: int) -> Self:
        """Return the sums of some blocks."""
        cut = slice(begin, end)
        return self._replace(A=self.A[cut], c=self.c[cut], q=self.q[cut], n=self.n[cut], begin_s=self.begin_s[cut])

    @property
    def unexplained(self) -> FloatArray:
        """Mean square (K,) of what a fit to each block leaves; 0 where a block has too few rows."""
        A, p = self.A, self.c.shape[1]
        ridge = (1e-9 * A.diagonal(axis1=1, axis2=2) + np.finfo(np.float64).tiny)[:, :, None] * np.eye(p)
        fit = np.linalg.solve(A + ridge, self.c[..., None])[..., 0]
        left = self.q - np.einsum("ki,ki->k", self.c, fit)
        return np.asarray(np.where(self.n > 2 * p, left.clip(0.0) / np.maximum(self.n - p, 1.0), 0.0))


class FaultDirection(NamedTuple):
    """A fault as a direction of the coefficients: at a ratio of its parameter, theta + (ratio - 1) direction."""

    name: str
    direction: FloatArray  # shape (p,)
    multiplies_all: bool = False  # a gain: the ratios of other causes are relative to it


class Equations(Protocol):
    """A regression that is linear in its coefficients, and the causes that change these."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the p coefficients."""

    @property
    def free(self) -> tuple[int, ...]:
        """Coefficients that may change at any time without a fault, as a constant force does."""

    def causes(self, theta: FloatArray) -> tuple[FaultDirection, ...]:
        """Return the causes about healthy coefficients (p,)."""

    def sums(self, recording: Recording) -> Sums:
        """Return the sums of a recording."""
