"""Sums of a recording, what a set of equations offers, and what a recording is found to show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, Self

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.signals import Recording

Times = tuple[float, float, float]
"""Lower limit, likeliest value and upper limit of a time [s]."""


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


class Ratio(NamedTuple):
    """A cause of a change and its size: the ratio of its parameter to the healthy one, with its 95 % interval."""

    cause: str
    ratio: float
    low: float
    high: float


class Explanation(NamedTuple):
    """Causes that explain a change, and other sets of causes that move the same coefficients."""

    ratios: tuple[Ratio, ...]  # none: a change that no known cause explains
    probability: float
    log_odds: float  # against no change of this stretch [nats]
    alike: tuple[tuple[Ratio, ...], ...] = ()  # no recording distinguishes them from `ratios`

    @property
    def causes(self) -> frozenset[str]:
        """Names of the causes."""
        return frozenset(ratio.cause for ratio in self.ratios)


class Segment(NamedTuple):
    """A stretch of a recording with constant coefficients."""

    begin_s: Times
    end_s: Times
    changed: bool  # whether its coefficients are not the healthy ones
    theta: FloatArray  # coefficients, shape (p,)
    covariance: FloatArray  # shape (p, p)
    healthy: FloatArray  # coefficients that this recording would have if it were healthy, shape (p,)
    explanations: tuple[Explanation, ...] = ()  # the likeliest first; none of a healthy stretch


class Verdict(NamedTuple):
    """What a recording shows."""

    evidence: float  # logarithm of the Bayes factor of a change over none [nats]
    limit: float  # that one healthy recording in so many exceeds, as `learn` was told
    segments: tuple[Segment, ...]  # in order of time

    @property
    def is_changed(self) -> bool:
        """Whether the evidence is above its limit."""
        return self.evidence > self.limit
