"""One or two parameters that changed: the most likely sizes, their covariance, and the evidence for the hypothesis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from servoscope.plants import Fault, FloatArray
from servoscope.posterior import Posterior
from servoscope.refinement.columns import deviation, explained
from servoscope.refinement.window import Growth, Window

STEPS = 12  # of the search, at most
UNSEEN = 3.0  # standard deviations below which a size is as good as none
REACH = 5.0  # standard deviations of the size over which its likelihood is integrated
POINTS = 31
AT_BOUND = 1e-6
IN_REACH = 60.0  # of the sum of squares: what is further off than the best one has no probability worth telling


@dataclass(frozen=True, eq=False)
class Fitted:
    """A hypothesis at its most likely sizes.

    Parameters
    ----------
    faults
        What changed, one or several.
    growth
        When.
    d, x
        Errors of the healthy parameters and changes of the faults', all in logarithms, shapes (m,) and (k,).
    J
        Sum of squares: innovations and prior.
    covariance
        Of x, shape (k, k).
    jacobian
        Of the residual, shape (N + m, m + k); (N + m, k) where d was held.
    residual
        Shape (N + m,).
    """

    faults: tuple[Fault, ...]
    growth: Growth
    d: FloatArray
    x: FloatArray
    J: float
    covariance: FloatArray
    jacobian: FloatArray
    residual: FloatArray

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters that change."""
        return tuple(fault.parameter for fault in self.faults)

    @property
    def is_free(self) -> bool:
        """Whether the healthy parameters followed."""
        return bool(self.jacobian.shape[1] == len(self.d) + len(self.x))

    def intervals(self, louder: float) -> tuple[tuple[float, float], ...]:
        """Return 95 % intervals of x within the ranges, for innovations of a variance."""
        std = np.sqrt(np.diag(self.covariance) * louder)
        low, high = bounds(self.faults)
        return tuple(
            (float(max(x - 1.96 * s, a)), float(min(x + 1.96 * s, b)))
            for x, s, a, b in zip(self.x, std, low, high, strict=True)
        )


def bounds(faults: Sequence[Fault]) -> tuple[FloatArray, FloatArray]:
    """Return the smallest and largest logarithms of the ratios that are searched, shapes (k,)."""
    low, high = np.log(np.array([fault.ratio_range for fault in faults]).reshape(-1, 2)).T
    return low, high


def fit(
    window: Window,
    faults: Sequence[Fault],
    growth: Growth,
    d: FloatArray,
    starts: Sequence[FloatArray],
    free: bool,
) -> Fitted:
    """Find the most likely sizes by least squares on the innovations.

    Parameters
    ----------
    window, faults, growth
        What is asked.
    d
        Errors of the healthy parameters, to begin with, shape (m,).
    starts
        Sizes at which the search begins, one (k,) each; the best end counts.
    free
        Whether d follows, within reason, or stays.
    """
    from scipy.optimize import least_squares as minimise

    names, m = tuple(fault.parameter for fault in faults), window.nuisances
    held = 0 if free else m
    low, high = bounds(faults)
    lowest = np.concatenate([np.full(m, -np.inf), low])[held:]
    highest = np.concatenate([np.full(m, np.inf), high])[held:]

    def whole(z: FloatArray) -> FloatArray:
        return z if free else np.concatenate([d, z])

    def residual(z: FloatArray) -> FloatArray:
        return window.residual(whole(z), names, growth)

    def jacobian(z: FloatArray) -> FloatArray:
        return window.jacobian(whole(z), names, growth, slice(held, None))

    if not len(lowest):  # nothing is open
        e = window.residual(d, names, growth)
        return Fitted((), growth, d, np.zeros(0), float(e @ e), np.zeros((0, 0)), np.zeros((len(e), 0)), e)
    ends = []
    for x in starts:
        z = np.clip(np.concatenate([d, x])[held:], lowest + AT_BOUND, highest - AT_BOUND)
        found = minimise(
            residual,
            z,
            jacobian,
            bounds=(lowest, highest),
            x_scale="jac",
            ftol=1e-7 if free else 1e-4,
            xtol=1e-7 if free else 1e-4,
            gtol=None,
            max_nfev=STEPS,
        )
        ends.append(found)
    best = min(ends, key=lambda found: float(found.cost))
    z, J = whole(np.asarray(best.x)), np.asarray(best.jac, dtype=np.float64)
    H = J.T @ J
    size = np.sqrt(np.maximum(np.diag(H), 1e-300))
    C = np.linalg.pinv(H / np.outer(size, size), rcond=1e-12, hermitian=True) / np.outer(size, size)
    k = m - held  # rows of d, where it is free
    return Fitted(tuple(faults), growth, z[:m], z[m:], 2.0 * float(best.cost), C[k:, k:], J, best.fun)


def freed(window: Window, fitted: Sequence[Fitted], louder: float, J: float = np.inf) -> list[Fitted]:
    """Let the healthy parameters follow wherever that may bring a hypothesis within reach of the best one.

    One step of Gauss and Newton says how far each would come.

    Parameters
    ----------
    window, fitted
        What is asked, and the hypotheses so far.
    louder
        Variance of the innovations.
    J
        Sum of squares of the best one, if it is none of these.
    """
    promised = []
    for f in fitted:
        jacobian = window.jacobian(np.concatenate([f.d, f.x]), f.names, f.growth)
        promised.append(f.J - explained(jacobian, f.residual))
    limit = min(J, *promised) + IN_REACH * louder
    return [free(window, f) if limit >= promise else f for f, promise in zip(fitted, promised, strict=True)]


def free(window: Window, fitted: Fitted) -> Fitted:
    """Return a hypothesis whose healthy parameters followed too."""
    return fit(window, fitted.faults, fitted.growth, fitted.d, [fitted.x], free=True)


@dataclass(frozen=True)
class Scale:
    """What a fault's size is measured by before anything is known of it.

    The prior of a logarithm x of a ratio is 1/(|x| + m) within the fault's range: every order of magnitude is as likely
    as the next down to m, the size that just does not show. Two faults of which one shows at 0.1 % and the other at
    10 % are so compared on equal terms, where a prior uniform in x would call the first a coincidence.
    """

    fault: Fault
    unseen: float

    @classmethod
    def of(cls, window: Window, fault: Fault, growth: Growth) -> Scale:
        """Measure by the information that the window holds about a small change."""
        m = window.nuisances
        J = window.jacobian(np.zeros(m + 1), (fault.parameter,), growth)
        (low,), (high,) = bounds([fault])
        return cls(fault, min(UNSEEN * deviation(J), (high - low) / 4.0))

    def log_density(self, x: FloatArray) -> FloatArray:
        """Return the logarithm of the prior density at x, shape as x."""
        (low,), (high,) = bounds([self.fault])
        area = np.log1p(-low / self.unseen) + np.log1p(high / self.unseen)
        return np.asarray(-np.log((np.abs(x) + self.unseen) * area))


@dataclass(frozen=True)
class Evidence:
    """How well a hypothesis explains the window, averaged over the sizes that it may have.

    Parameters
    ----------
    log
        Logarithm of the integral of likelihood times prior.
    intervals
        95 % intervals of the logarithms of the ratios, one per fault.
    """

    log: float
    intervals: tuple[tuple[float, float], ...]

    def wider(self, fitted: Fitted, spread: Mapping[str, float]) -> Evidence:
        """Return the same with intervals that hold what is not known of the onset, `spread` by parameter, too."""
        intervals = []
        for name, x, (low, high) in zip(fitted.names, fitted.x, self.intervals, strict=True):
            more = 1.96 * spread.get(name, 0.0)
            intervals.append((float(x - np.hypot(x - low, more)), float(x + np.hypot(high - x, more))))
        return replace(self, intervals=tuple(intervals))


def evidence(window: Window, found: Fitted, scales: Sequence[Scale], louder: float) -> Evidence:
    """Integrate likelihood times prior over the sizes.

    One fault: along its size, with the healthy parameters following linearly. Two: a Gaussian around the most likely
    sizes (Laplace; MacKay, 2003, chapter 27), of which no more than the whole prior can be inside.

    Parameters
    ----------
    window, found
        The hypothesis.
    scales
        Priors of its faults.
    louder
        Variance of the innovations: 1 for the baseline's noise.
    """
    m, k = window.nuisances, len(found.x)
    H = found.jacobian.T @ found.jacobian / louder
    rest = H[:m, :m]
    volume = -0.5 * float(np.linalg.slogdet(rest)[1]) if m else 0.0
    if k == 1:
        return _along(window, found, scales[0], louder, volume)
    log = volume - 0.5 * found.J / louder
    C = louder * found.covariance
    # each direction's share of the prior is at most all of it
    conditional = float(np.linalg.slogdet(C)[1]) / 2.0 + k * np.log(2.0 * np.pi) / 2.0
    priors = sum(float(scale.log_density(np.array(x))) for scale, x in zip(scales, found.x, strict=True))
    return Evidence(log + min(conditional + priors, 0.0), found.intervals(louder))


def _along(window: Window, found: Fitted, scale: Scale, louder: float, volume: float) -> Evidence:
    m = window.nuisances
    (low,), (high,) = bounds(found.faults)
    best = float(found.x[0])
    reach = min(REACH * float(np.sqrt(found.covariance[0, 0] * louder)), high - low)
    sizes = np.unique(np.clip(best + reach * np.linspace(-1.0, 1.0, POINTS), low, high))
    H = found.jacobian.T @ found.jacobian
    follow = -np.linalg.solve(H[:m, :m], H[:m, m]) if m else np.zeros(0)
    J = []
    for x in sizes:
        z = np.append(found.d + follow * (x - best), x)
        J.append(float((window.residual(z, found.names, found.growth) ** 2).sum()))
    log_weight = -0.5 * np.array(J) / louder + scale.log_density(sizes)
    found_at = Posterior.of(sizes, log_weight)
    return Evidence(volume + found_at.log_area, (found_at.interval,))
