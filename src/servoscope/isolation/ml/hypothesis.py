"""One or two parameters that changed: the most likely sizes, their covariance, and the evidence for the hypothesis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.fit.search import Experiment, fit
from servoscope.isolation.ml.least_squares import explained_sum_of_squares, last_unknown_std
from servoscope.isolation.ml.window import ChangeProfile, ChangeWindow
from servoscope.isolation.posterior import Posterior
from servoscope.models.plants import Fault

MIN_SIZE_STDS = 3.0  # standard deviations below which a size is as good as none
SIZE_STDS = 5.0  # standard deviations of the size over which its likelihood is integrated
POINTS = 31
BOUND_SHARE = 1e-3  # of the logarithmic range, within which a size lies at its end
COST_TOLERANCES = 1e-4, 1e-7  # of the cost per sample: healthy parameters held, and free
# of the sum of squares: what is further off than the best one has no probability worth telling
MAX_EXCESS_SQUARES = 60.0


@dataclass(frozen=True, eq=False)
class HypothesisFit:
    """A hypothesis at its most likely sizes."""

    faults: tuple[Fault, ...]  # what changed, one or several
    profile: ChangeProfile
    # d, x: errors of the healthy parameters and changes of the faults', all in logarithms, shapes (m,) and (k,)
    d: FloatArray
    x: FloatArray
    cost: float  # sum of squares: innovations and prior
    covariance: FloatArray  # of x, shape (k, k)
    jacobian: FloatArray  # of the residual, shape (N + m, m + k); (N + m, k) where d was held
    residual: FloatArray  # shape (N + m,)

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters that change."""
        return tuple(fault.parameter for fault in self.faults)

    @property
    def has_free_nuisances(self) -> bool:
        """Whether the healthy parameters followed."""
        return bool(self.jacobian.shape[1] == len(self.d) + len(self.x))

    @property
    def faults_at_ends(self) -> list[Fault]:
        """The faults whose sizes lie at an end of their ranges."""
        low, high = log_ratio_bounds(self.faults)
        near = BOUND_SHARE * (high - low)
        at_end = (self.x <= low + near) | (self.x >= high - near)
        return [fault for fault, at in zip(self.faults, at_end, strict=True) if at]

    def intervals(self, noise_variance: float) -> tuple[tuple[float, float], ...]:
        """Return 95 % intervals of x within the ranges, for innovations of a variance."""
        std = np.sqrt(np.diag(self.covariance) * noise_variance)
        low, high = log_ratio_bounds(self.faults)
        return tuple(
            (float(max(x - 1.96 * s, a)), float(min(x + 1.96 * s, b)))
            for x, s, a, b in zip(self.x, std, low, high, strict=True)
        )


def log_ratio_bounds(faults: Sequence[Fault]) -> tuple[FloatArray, FloatArray]:
    """Return the smallest and largest logarithms of the ratios that are searched, shapes (k,)."""
    low, high = np.log(np.array([fault.ratio_range for fault in faults]).reshape(-1, 2)).T
    return low, high


def change_experiment(
    window: ChangeWindow, faults: Sequence[Fault], profile: ChangeProfile, other: FloatArray | float = 0.0
) -> Experiment:
    """Return what is searched for z = [d, x]: innovations and prior, less those of another explanation, (N + m,)."""
    names, anywhere = tuple(fault.parameter for fault in faults), np.full(window.nuisance_count, np.inf)
    low, high = log_ratio_bounds(faults)
    return Experiment(
        lambda z: window.residual(z, names, profile) - other,
        np.full(len(anywhere) + len(low), np.inf),  # the prior is among the residuals
        low=np.append(-anywhere, low),
        high=np.append(anywhere, high),
        max_step=np.inf,
        derivatives=lambda z, unknowns: window.jacobian(z, names, profile, unknowns),
    )


def fit_hypothesis(
    window: ChangeWindow,
    faults: Sequence[Fault],
    profile: ChangeProfile,
    d: FloatArray,
    starts: Sequence[FloatArray],
    free: bool,
) -> HypothesisFit:
    """Find the most likely sizes by least squares on the innovations.

    `d`: errors of the healthy parameters, to begin with, shape (m,); `starts`: sizes at which the search begins,
    one (k,) each; the best end counts; `free`: whether d follows, within reason, or stays.
    """
    experiment, m = change_experiment(window, faults, profile), window.nuisance_count
    unknowns, tolerance = np.arange(0 if free else m, m + len(faults)), COST_TOLERANCES[free] * window.used
    ends = [fit(experiment, np.append(d, x), unknowns, tolerance=tolerance) for x in starts]
    best = min(ends, key=lambda end: end.cost)
    if not np.isfinite(best.cost):
        raise np.linalg.LinAlgError("no size can be simulated from which a search may begin")
    z, k = best.x, len(unknowns) - len(faults)  # rows of d, where it is free
    return HypothesisFit(
        tuple(faults), profile, z[:m], z[m:], best.cost, best.covariance[k:, k:], best.jacobian, best.residual
    )


def refit_contenders_jointly(
    window: ChangeWindow, fitted: Sequence[HypothesisFit], noise_variance: float, J: float = np.inf
) -> list[HypothesisFit]:
    """Let the healthy parameters follow wherever that may bring a hypothesis within reach of the best one.

    One step of Gauss and Newton says how far each would come.
    """
    promised = []
    for f in fitted:
        jacobian = window.jacobian(np.concatenate([f.d, f.x]), f.names, f.profile)
        promised.append(f.cost - explained_sum_of_squares(jacobian, f.residual))
    limit = min(J, *promised) + MAX_EXCESS_SQUARES * noise_variance
    return [refit_jointly(window, f) if limit >= promise else f for f, promise in zip(fitted, promised, strict=True)]


def refit_jointly(window: ChangeWindow, fitted: HypothesisFit) -> HypothesisFit:
    """Return a hypothesis whose healthy parameters followed too."""
    return fit_hypothesis(window, fitted.faults, fitted.profile, fitted.d, [fitted.x], free=True)


@dataclass(frozen=True)
class SizePrior:
    """What a fault's size is measured by before anything is known of it.

    The prior of a logarithm x of a ratio is 1/(|x| + m) within the fault's range: every order of magnitude is as likely
    as the next down to m, the size that just does not show. Two faults of which one shows at 0.1 % and the other at
    10 % are so compared on equal terms, where a prior uniform in x would call the first a coincidence.
    """

    fault: Fault
    noise_floor: float

    @classmethod
    def from_window(cls, window: ChangeWindow, fault: Fault, profile: ChangeProfile) -> SizePrior:
        """Measure by the information that the window holds about a small change."""
        m = window.nuisance_count
        J = window.jacobian(np.zeros(m + 1), (fault.parameter,), profile)
        (low,), (high,) = log_ratio_bounds([fault])
        return cls(fault, min(MIN_SIZE_STDS * last_unknown_std(J), (high - low) / 4.0))

    def log_density(self, x: FloatArray) -> FloatArray:
        """Return the logarithm of the prior density at x, shape as x."""
        (low,), (high,) = log_ratio_bounds([self.fault])
        area = np.log1p(-low / self.noise_floor) + np.log1p(high / self.noise_floor)
        return np.asarray(-np.log((np.abs(x) + self.noise_floor) * area))


@dataclass(frozen=True)
class HypothesisEvidence:
    """How well a hypothesis explains the window, averaged over the sizes that it may have."""

    log: float  # logarithm of the integral of likelihood times prior
    intervals: tuple[tuple[float, float], ...]  # 95 % intervals of the logarithms of the ratios, one per fault

    def widen(self, fitted: HypothesisFit, spread: Mapping[str, float], model_error: float = 0.0) -> HypothesisEvidence:
        """Return the same with intervals that hold what is not known of the onset, `spread` by parameter, too.

        `model_error`: share of a size, as a logarithm, that a plant simpler than the machine brings.
        """
        intervals = []
        for name, x, (low, high) in zip(fitted.names, fitted.x, self.intervals, strict=True):
            widening = 1.96 * float(np.hypot(spread.get(name, 0.0), model_error * x))
            intervals.append((float(x - np.hypot(x - low, widening)), float(x + np.hypot(high - x, widening))))
        return replace(self, intervals=tuple(intervals))


def integrate_evidence(
    window: ChangeWindow, fitted: HypothesisFit, scales: Sequence[SizePrior], noise_variance: float
) -> HypothesisEvidence:
    """Integrate likelihood times prior over the sizes.

    One fault: along its size, with the healthy parameters following linearly. Two: a Gaussian around the most likely
    sizes (Laplace; MacKay, 2003, chapter 27), of which no more than the whole prior can be inside.
    """
    m, k = window.nuisance_count, len(fitted.x)
    H = fitted.jacobian.T @ fitted.jacobian / noise_variance
    nuisance = H[:m, :m]
    volume = -0.5 * float(np.linalg.slogdet(nuisance)[1]) if m else 0.0
    if k == 1:
        return _evidence_along_size(window, fitted, scales[0], noise_variance, volume)
    log = volume - 0.5 * fitted.cost / noise_variance
    C = noise_variance * fitted.covariance
    # each direction's share of the prior is at most all of it
    conditional = float(np.linalg.slogdet(C)[1]) / 2.0 + k * np.log(2.0 * np.pi) / 2.0
    priors = sum(float(scale.log_density(np.array(x))) for scale, x in zip(scales, fitted.x, strict=True))
    return HypothesisEvidence(log + min(conditional + priors, 0.0), fitted.intervals(noise_variance))


def _evidence_along_size(
    window: ChangeWindow, fitted: HypothesisFit, scale: SizePrior, noise_variance: float, volume: float
) -> HypothesisEvidence:
    m = window.nuisance_count
    (low,), (high,) = log_ratio_bounds(fitted.faults)
    best = float(fitted.x[0])
    reach = min(SIZE_STDS * float(np.sqrt(fitted.covariance[0, 0] * noise_variance)), high - low)
    sizes = np.unique(np.clip(best + reach * np.linspace(-1.0, 1.0, POINTS), low, high))
    H = fitted.jacobian.T @ fitted.jacobian
    follow = -np.linalg.solve(H[:m, :m], H[:m, m]) if m else np.zeros(0)
    z = np.column_stack([fitted.d + np.outer(sizes - best, follow), sizes])
    J = (window.residuals(z, fitted.names, fitted.profile) ** 2).sum(axis=1)
    log_weight = -0.5 * J / noise_variance + scale.log_density(sizes)
    found_at = Posterior.from_log_density(sizes, log_weight)
    return HypothesisEvidence(volume + found_at.log_area, (found_at.interval,))
