"""What the sums of healthy recordings teach: coefficients, noise, and how coefficients scatter."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.verdict import evidence_limit
from servoscope.sums.evidence import ChangePrior, posterior
from servoscope.sums.records import Equations, Sums
from servoscope.sums.scatter import block_weights

CHANGE_STD = 0.5  # standard deviation of a change, relative to the coefficient
CHANGE_COST = 3.0  # nats that a stretch with coefficients of its own has to gain
EFFECT_STEPS = 4  # of reweighting
STRETCH_S = 15.0  # over which coefficients of one recording are compared


@dataclass(frozen=True, eq=False)
class Healthy:
    """Healthy coefficients of a stretch: ``theta x + B + E``, each effect with its covariance."""

    equations: Equations
    theta: FloatArray  # by covariate, shape (p, m)
    unit: FloatArray  # what a coefficient's scatter and changes are relative to, shape (p,)
    kappa: float  # of the noise: the covariance of a block's score is kappa A
    within: FloatArray  # covariances (p, p): of stretches of one recording,
    between: FloatArray  # and of recordings
    inflation: float  # of the covariance of long stretches, for neighbouring blocks err alike
    degrees: float  # of freedom that `between` is known with
    unexplained: float  # mean of `Sums.unexplained`: where a block has more, its noise is louder than `kappa` says
    moments: FloatArray  # inverse of the moments of the covariates, shape (m, m)
    left_out: tuple[float, ...] = ()  # evidence of each healthy recording when it is left out of learning
    limit: float = 0.0  # of the evidence

    def mean(self, x: FloatArray) -> FloatArray:
        """Return the coefficients (p,) to expect at covariates (m,)."""
        return np.asarray(self.theta @ x)

    def scatter(self, x: FloatArray) -> FloatArray:
        """Return the covariance (p, p) of the effect of a recording: it grows outside of the covariates learned."""
        return np.asarray(self.between * (1.0 + float(x @ self.moments @ x)))

    def information(self, sums: Sums, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return information (K, p, p) and score (K, p) of each block about coefficients (p,)."""
        louder = self.kappa * np.maximum(sums.unexplained / self.unexplained, 1.0)
        M, w = sums.A / louder[:, None, None], (sums.c - sums.A @ theta) / louder[:, None]
        if not len(w):
            return M, w
        counts = block_weights(M, w, self.wide, round(STRETCH_S / sums.block_s)) / self.inflation
        return M * counts[:, None, None], w * counts[:, None]

    def change_prior(self, x: FloatArray) -> ChangePrior:
        """Return how coefficients deviate: as healthy ones, by one cause, or anyhow."""
        causes = self.equations.causes(self.mean(x))
        directions = np.column_stack([c.direction for c in causes]) if causes else np.diag(self.unit)
        return ChangePrior(self.within, self.wide, CHANGE_STD * directions, CHANGE_COST)

    @cached_property
    def wide(self) -> FloatArray:
        """The covariance (p, p) of a change of all coefficients."""
        return np.diag((CHANGE_STD * self.unit) ** 2)

    @property
    def excess(self) -> float:
        """What a change within a healthy recording that was left out gained beyond the smallest limit [nats]."""
        return max(self.limit - evidence_limit(()), 0.0) if self.left_out else 0.0

    def effect(self, M: FloatArray, w: FloatArray, scatter: FloatArray) -> FloatArray:
        """Return the likeliest effect (p,) of a recording: multivariate t, for few recordings show the scatter."""
        B, p, precision = np.zeros(len(w)), len(w), np.linalg.inv(scatter)
        for _ in range(EFFECT_STEPS):
            weight = (self.degrees + B @ precision @ B) / (self.degrees + p)
            B = posterior(M, w, scatter * weight)[0]
        return B

    def effect_cost(self, B: FloatArray, scatter: FloatArray) -> float:
        """Return how much less likely an effect is than none [nats]."""
        square = float(B @ np.linalg.solve(scatter, B))
        return 0.5 * (self.degrees + len(B)) * float(np.log1p(square / self.degrees))
