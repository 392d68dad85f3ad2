"""Which fault, how large, how sure: signatures against the deviation; ambiguity and "unknown" said aloud."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import SimulationError
from servoscope.fit.search import minimise_from_grid
from servoscope.isolation.candidate import UNKNOWN, Candidate, FaultEstimate
from servoscope.isolation.posterior import Posterior
from servoscope.isolation.signature import Signature

GRID_POINTS = 17  # points along a signature before the minimum is refined
RELATIVE_PRECISION = 1e-4  # of the minimum, relative to two steps of the grid
MISFIT_BY_CHANCE = 1e-3  # probability with which the true fault may fit worse than the limit
INFINITE_MISFIT = 1e12  # stands for an infinite misfit
MAX_EXCESS_MISFIT = 200.0  # excess misfit from which a signature is not refined
SYSTEMATIC_ERROR_SHARE = 2e-3  # share of a signature that nominal parameters and intersample models may be off by


def misfit_limit(n: int) -> float:
    """Return the misfit that a true fault passes in one of a thousand cases, with n coefficients."""
    from scipy import special

    return float(special.chdtri(max(n - 1, 1), MISFIT_BY_CHANCE))


@dataclass(frozen=True)
class _SignatureFit:
    signature: Signature
    misfit: float  # smallest J
    evidence: float  # log of the integral over the prior
    best: float
    low: float
    high: float
    cosine: float | None


def isolate(
    signatures: Sequence[Signature],
    deviation: FloatArray,
    covariance: FloatArray,
    progress: Callable[[], None] = lambda: None,
) -> tuple[Candidate, ...]:
    """Compare a deviation with every signature.

    Along each curve J(x) = (d - s(x))' Sigma(x)^-1 (d - s(x)); the probability of a fault is proportional to the
    integral of exp(-(J + log det Sigma)/2) over its range. "unknown" stands for a change that would fit exactly as
    badly as the limit that a true fault passes in one of a thousand cases. Sigma(x) holds the scatter of a learned
    direction too, so a label that is known only roughly has to fit better to be as probable.

    The most probable candidate comes first, ``unknown`` among them; the probabilities sum to 1.
    """
    n = len(deviation)
    limit = misfit_limit(n)
    searches = [_SignatureSearch(signature, deviation, covariance) for signature in signatures]
    coarse = [search.coarse_misfit() for search in searches]
    fitted = []
    for search, misfit in zip(searches, coarse, strict=True):
        progress()
        if np.isfinite(misfit):
            # what misses by far even on the grid needs no fine integral: its probability is zero either way
            fitted.append(search.fit(fine=misfit < min(coarse) + MAX_EXCESS_MISFIT))
    if not fitted:
        return (Candidate(name=UNKNOWN, probability=1.0),)
    closest = min(fitted, key=lambda fit: fit.misfit)
    unknown = closest.evidence + (closest.misfit - limit) / 2.0
    evidence = np.array([fit.evidence for fit in fitted] + [unknown])
    probability = np.exp(evidence - evidence.max())
    probability /= probability.sum()
    candidates = [
        Candidate(
            name=fit.signature.fault.name,
            probability=float(share),
            faults=(
                FaultEstimate(
                    name=fit.signature.fault.name,
                    parameter=fit.signature.fault.parameter,
                    ratio=fit.signature.ratio(fit.best),
                    interval=(fit.signature.ratio(fit.low), fit.signature.ratio(fit.high)),
                ),
            ),
            misfit=fit.misfit - closest.misfit,
            cosine=fit.cosine,
        )
        for fit, share in zip(fitted, probability[:-1], strict=True)
    ]
    # a size that may be healthy is no explanation of a change
    named, unnamed = list[Candidate](), list[Candidate]()
    for candidate in candidates:
        (unnamed if any(fault.may_be_healthy for fault in candidate.faults) else named).append(candidate)
    unknown_share = float(probability[-1]) + sum(c.probability for c in unnamed)
    unnamed = [c.model_copy(update={"probability": 0.0}) for c in unnamed]
    candidates = [*named, *unnamed, Candidate(name=UNKNOWN, probability=unknown_share)]
    return tuple(sorted(candidates, key=lambda candidate: -candidate.probability))


class _SignatureSearch:
    """J along one signature, each point computed once."""

    def __init__(self, signature: Signature, deviation: FloatArray, covariance: FloatArray) -> None:
        self.signature = signature
        self.size = np.sqrt(np.diag(covariance))
        self.scaled = deviation / self.size
        self.correlation = covariance / np.outer(self.size, self.size)
        self.cache: dict[float, tuple[float, float]] = {}

    def misfit_at(self, x: float) -> float:
        """Return the misfit at a coordinate; infinite where the loop would be unstable."""
        if x not in self.cache:
            self.cache[x] = self._compute(x)
        return self.cache[x][0]

    def _compute(self, x: float) -> tuple[float, float]:
        try:
            s = self.signature.shift(x) / self.size
        except SimulationError:  # nobody could have recorded it
            return np.inf, 0.0
        Sigma = self._covariance(x, s)
        J = float((self.scaled - s) @ np.linalg.solve(Sigma, self.scaled - s))
        return J, float(np.linalg.slogdet(Sigma)[1])

    def _covariance(self, x: float, s: FloatArray) -> FloatArray:
        # an angle is off the curve: along it the size is free as it is
        angle, off = self.signature.angle * np.ones_like(s), (SYSTEMATIC_ERROR_SHARE * s) ** 2 + 1e-12
        Sigma = self.correlation + np.diag(angle**2 * (s @ s) + off) - np.outer(angle * s, angle * s)
        if self.signature.scatter is not None:
            Sigma = Sigma + self.signature.scatter(x) / np.outer(self.size, self.size)
        return np.asarray(Sigma)

    def cosine(self, x: float) -> float | None:
        """Return the cosine between deviation and shift in the metric of J; None where no direction was learned."""
        if self.signature.scatter is None:
            return None
        s = self.signature.shift(x) / self.size
        white = np.linalg.solve(np.linalg.cholesky(self._covariance(x, s)), np.column_stack([self.scaled, s]))
        return float(white[:, 0] @ white[:, 1] / np.prod(np.linalg.norm(white, axis=0)))

    def coarse_misfit(self) -> float:
        """Return the smallest misfit on the grid and a few steps towards the minimum beside its best point."""
        for x in np.linspace(self.signature.low, self.signature.high, GRID_POINTS):
            self.misfit_at(float(x))
        best = min(self.cache, key=lambda x: self.cache[x][0])
        if np.isfinite(self.cache[best][0]):
            self._refine(8)
        return min(J for J, _ in self.cache.values())

    def _refine(self, steps: int) -> None:
        grid = np.linspace(self.signature.low, self.signature.high, GRID_POINTS)

        def misfit(x: float) -> float:  # a parabola through infinity is none: a loop that cannot run is far away
            return min(self.misfit_at(x), INFINITE_MISFIT)

        minimise_from_grid(misfit, grid, RELATIVE_PRECISION * (grid[2] - grid[0]), steps)

    def fit(self, fine: bool) -> _SignatureFit:
        """Refine the minimum and integrate over the prior."""
        signature = self.signature
        width = 2.0 * (signature.high - signature.low) / (GRID_POINTS - 1)
        if fine:
            self._refine(40)
        best = min(self.cache, key=lambda x: self.cache[x][0])
        if fine:
            # a parabola through the minimum says how wide to look; the integral itself uses the true curve
            h = 1e-2 * width
            left, right = max(best - h, signature.low), min(best + h, signature.high)
            rise = [(self.misfit_at(x) - self.misfit_at(best)) / max(abs(x - best), 1e-12) for x in (left, right)]
            curvature = max(sum(slope for slope in rise if np.isfinite(slope)) / (right - left), 1e-12)
            reach = min(4.0 / np.sqrt(curvature), signature.high - signature.low)
            for x in best + reach * np.linspace(-1.0, 1.0, 17):
                self.misfit_at(float(np.clip(x, signature.low, signature.high)))
        x = np.array(sorted(self.cache))
        J, logdet = np.array([self.cache[float(value)] for value in x]).T
        log_weight = -(J + logdet) / 2.0
        posterior = Posterior.from_log_density(x, log_weight)
        low, high = posterior.interval
        # a size is relative to the healthy value: its error is that of the change, and a small change's is small
        vague = 1.96 * signature.healthy_std * min(float(np.expm1(abs(best))), 1.0)
        low, high = best - np.hypot(best - low, vague), best + np.hypot(high - best, vague)
        evidence = posterior.log_area - float(np.log(signature.high - signature.low))
        return _SignatureFit(signature, self.cache[best][0], evidence, best, float(low), float(high), self.cosine(best))
