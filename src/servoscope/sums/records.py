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
    begin_s: FloatArray  # time at which each block begins, shape (K,)
    block_s: float  # length of a block [s]
    x: FloatArray  # 1, then covariates of the recording, shape (m,)

    @classmethod
    def of_rows(cls, phi: FloatArray, eta: FloatArray, begin_s: FloatArray, block_s: float, x: Sequence[float]) -> Self:
        """Sum up rows that are cut into K blocks: phi (K, rows, p), eta (K, rows); a row that does not count is 0."""
        turned = np.swapaxes(phi, 1, 2)
        return cls(turned @ phi, (turned @ eta[..., None])[..., 0], begin_s, block_s, np.asarray(x, dtype=np.float64))

    def followed_by(self, other: Sums) -> Self:
        """Return the sums of this recording and what came after it."""
        A, c, begin_s = (np.concatenate([a, b]) for a, b in zip(self[:3], other[:3], strict=True))
        return self._replace(A=A, c=c, begin_s=begin_s)


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
