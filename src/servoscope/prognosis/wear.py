"""Courses of wear, and how well each explains a series: the posterior that a prognosis is drawn from.

A size stands still until `start` and then follows a Wiener process in a clock of its own,

    dx = c dL + sigma dB(L),   L(t) = (expm1(k a) / expm1(k))^p,   a = age since the start over that at the last value,

which is steady wear where p = 1 and k = 0, and accelerating wear by a power or exponentially else (Whitmore and
Schenkelberg 1997, Modelling accelerated degradation data using Wiener diffusion with a time scale transformation,
eqs. 1 to 3). The rate c may walk randomly. Beside it stands that there is no wear: x wanders without a rate. What is
measured is y = x + b'(covariates) + e. Level, rate c and the coefficients b are Gaussian given the rest, by a Kalman
filter; the rest is sampled by population Monte Carlo (Cappe and others 2004, Population Monte Carlo).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.prognosis.series import SizeSeries

POPULATION, ROUNDS = 600, 8
MIN_EFFECTIVE_SIZE = 80.0  # effective size of a population that the next one is drawn around
DEFENCE = 0.15  # share of each later round that is drawn from the prior: no region is lost for good
SPREAD = 0.6  # of a kernel: share of the population's covariance, as a factor of its root
PRIOR_LEVEL_STD = 10.0  # standard deviation of the first level, in ranges of the values
RATE = 2.0  # of the rate: ranges of the values in one history


@dataclass(frozen=True)
class Courses:
    """Courses of wear, each column of shape (G,); time is counted in lengths of the history, sizes in their range.

    `start` inf: no wear; `exponent`, `growth`: p and k of the clock; `diffusion`: sigma; `walk`: how far the rate walks
    in one history; `noise`: standard deviation of e as a multiple of what successive values show.
    """

    start: FloatArray
    exponent: FloatArray
    growth: FloatArray
    diffusion: FloatArray
    walk: FloatArray
    noise: FloatArray

    @classmethod
    def from_cube(cls, u: FloatArray) -> Courses:
        """Return the courses at points of the unit cube, shape (G, 6), on which the prior is uniform.

        Two of five begin with the first value, half have p = 1, half k = 0; the others are uniform from there on.
        """
        return cls(
            start=np.maximum(1.5 * u[:, 0] - 0.6, 0.0),
            exponent=1.0 + 3.0 * np.maximum(2.0 * u[:, 1] - 1.0, 0.0),
            growth=5.0 * np.maximum(2.0 * u[:, 2] - 1.0, 0.0),
            diffusion=0.003 * 30.0 ** u[:, 3],
            # below 0.01 it is none: for half of them
            walk=0.0002 * 2500.0 ** u[:, 4],
            noise=0.8 * 1.6 ** u[:, 5],
        )

    @classmethod
    def without_wear(cls) -> Courses:
        """Return a grid of courses whose size only wanders."""
        diffusion, noise = (axis.ravel() for axis in np.meshgrid(0.003 * 30.0 ** _grid(8), 0.8 * 1.6 ** _grid(4)))
        zero = np.zeros_like(noise)
        return cls(zero + np.inf, zero + 1.0, zero, diffusion, zero, noise)

    def clock(self, t: float | FloatArray) -> FloatArray:
        """Return L at a time, or at times of shape (N, 1); it is 1 at the end of the history."""
        begin = np.where(np.isfinite(self.start), self.start, 0.0)
        age = np.maximum(t - begin, 0.0) / (1.0 - begin)
        k = np.maximum(self.growth, 1e-6)  # expm1(k a) / expm1(k) becomes a
        with np.errstate(over="ignore"):  # far ahead, where every limit has been passed
            return np.minimum((np.expm1(k * age) / np.expm1(k)) ** self.exponent, 1e9)

    def slope(self) -> FloatArray:
        """Return dL/dt at the end of the history."""
        k = np.maximum(self.growth, 1e-6)
        return self.exponent * k / -np.expm1(-k) / (1.0 - self.start)

    def take(self, index: np.ndarray) -> Courses:
        """Return some of them."""
        return Courses(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class WearPosterior:
    """What a series says of its wear.

    Parameters
    ----------
    courses, weight : (G,)
        Courses, and the probability of each, given that there is wear.
    mean, covariance : (G, n), (G, n, n)
        Of level, rate per unit of the clock, and the coefficients of the covariates, at the last time.
    log_odds
        Logarithm of how many times better wear explains the series than no wear.
    origin, range, length_s
        Value and units of values and time: the first level is near 0, all values lie within about 1.
    """

    courses: Courses
    weight: FloatArray
    mean: FloatArray
    covariance: FloatArray
    log_odds: float
    origin: float
    range: float
    length_s: float


@dataclass(frozen=True)
class ScaledSeries:
    """A series as the filter takes it: times in histories, values in their range, covariates standardised."""

    t: FloatArray
    y: FloatArray
    R: FloatArray
    inputs: FloatArray  # (covariates, N)


def scale_series(series: SizeSeries) -> tuple[ScaledSeries, float, float, float]:
    """Return a series as the filter takes it, with origin and range of its values, and its length [s]."""
    length, origin = float(series.t[-1] - series.t[0]), float(np.median(series.value[:3]))
    scatter = _scatter(series.value)
    noise = max(float(np.sqrt(scatter)), float(np.median(series.std)))
    size = max(float(np.ptp(series.value)), 4.0 * noise, 1e-9 * abs(origin), 1e-300)
    # 1e-12: of values that repeat exactly
    R = np.maximum(np.maximum(np.square(series.std), scatter) / size**2, 1e-12)
    inputs = np.array([_standardised(covariate) for covariate in series.covariates.values()]).reshape(-1, R.size)
    scaled = ScaledSeries((series.t - series.t[0]) / length, (series.value - origin) / size, R, inputs)
    return scaled, origin, size, length


def fit_wear(series: SizeSeries, rng: np.random.Generator) -> WearPosterior:
    """Return what the values say of wear; there are three at least, at different times."""
    scaled, origin, size, length = scale_series(series)
    u, density = _stratified(rng, POPULATION), np.ones(POPULATION)
    for k in range(ROUNDS):
        courses = Courses.from_cube(u)
        log_likelihood, x, P = filter_series(courses, scaled)
        log_weight = log_likelihood - np.log(density)
        if k + 1 < ROUNDS:
            u, density = _propose(rng, u, _tempered(log_weight))
    weight = _normalised(log_weight)
    evidence = float(np.logaddexp.reduce(log_weight)) - np.log(POPULATION)
    quiet, *_ = filter_series(Courses.without_wear(), scaled)
    log_odds = evidence - float(np.logaddexp.reduce(quiet) - np.log(quiet.size))
    return WearPosterior(courses, weight, x, P, log_odds, origin, size, length)


def filter_series(courses: Courses, scaled: ScaledSeries) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the log-likelihood of each course, shape (G,), and mean and covariance of its state at the last value."""
    n, g = 2 + len(scaled.inputs), courses.start.size
    # courses last: each step then runs through whole rows
    x, P = np.zeros((n, g)), np.zeros((n, n, g))
    P[0, 0], P[1, 1] = PRIOR_LEVEL_STD**2, np.where(np.isfinite(courses.start), RATE**2, 0.0)
    P[range(2, n), range(2, n)] = 1.0
    R = np.square(courses.noise)
    # what moves the state is worked out for all values at once: a step is short, and its overhead would be most of it
    clock = courses.clock(scaled.t[:, None])
    step = np.diff(clock, axis=0, prepend=courses.clock(0.0)[None])
    walk = np.where(step > 0.0, np.square(courses.walk) * np.diff(scaled.t, prepend=0.0)[:, None], 0.0)
    moved = np.square(courses.diffusion) * step + walk * np.square(step) / 3.0
    both = walk * step / 2.0
    log_likelihood = np.zeros(g)
    for k, y in enumerate(scaled.y.tolist()):
        x[0] += step[k] * x[1]
        P[0] += step[k] * P[1]
        P[:, 0] += step[k] * P[:, 1]
        P[0, 0] += moved[k]
        P[0, 1] += both[k]
        P[1, 0] += both[k]
        P[1, 1] += walk[k]
        gain, expected = P[0].copy(), x[0].copy()
        h = scaled.inputs[:, k].tolist()
        for i, weight in enumerate(h, start=2):
            gain += weight * P[i]
            expected += weight * x[i]
        S = gain[0] + scaled.R[k] * R
        for i, weight in enumerate(h, start=2):
            S += weight * gain[i]
        e = y - expected
        log_likelihood -= 0.5 * (e * e / S + np.log(S))
        x += gain * (e / S)
        P -= gain[:, None] * (gain / S)
    return log_likelihood, x.T, np.moveaxis(P, -1, 0)


def _propose(rng: np.random.Generator, u: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Draw the next population near the heavy points of this one; return it with its density in the cube.

    What falls outside of the cube is drawn from the prior instead, and the density has that share, too.
    """
    off = u - weight @ u
    spread = SPREAD * np.linalg.cholesky(off.T @ (weight[:, None] * off) + 1e-7 * np.eye(u.shape[1]))
    drawn = u[rng.choice(weight.size, POPULATION, p=weight)] + rng.standard_normal(u.shape) @ spread.T
    outside = (np.abs(drawn - 0.5) > 0.5).any(axis=1)
    renewed = outside | (rng.random(POPULATION) < DEFENCE)
    drawn[renewed] = rng.random((int(renewed.sum()), u.shape[1]))
    heavy = weight > 1e-6
    to, of = np.linalg.solve(spread, drawn.T), np.linalg.solve(spread, u[heavy].T)
    # |a - b|^2 by products of matrices: all pairs at once
    distance = np.square(to).sum(axis=0)[:, None] + np.square(of).sum(axis=0) - 2.0 * to.T @ of
    kernel = np.exp(-0.5 * np.maximum(distance, 0.0)) / np.prod(np.diag(spread) * np.sqrt(2.0 * np.pi))
    inside = 1.0 - float(outside.mean())
    prior = 1.0 - inside * (1.0 - DEFENCE)
    return drawn, (1.0 - DEFENCE) * (kernel @ weight[heavy]) + prior


def _normalised(log_weight: FloatArray) -> FloatArray:
    weight = np.exp(log_weight - log_weight.max())
    return np.asarray(weight / weight.sum())


def _tempered(log_weight: FloatArray) -> FloatArray:
    """Return weights, flattened by a power until enough points have a share."""
    low, high = 0.0, 1.0
    if 1.0 / np.square(_normalised(log_weight)).sum() >= MIN_EFFECTIVE_SIZE:
        return _normalised(log_weight)
    for _ in range(20):
        middle = 0.5 * (low + high)
        enough = 1.0 / np.square(_normalised(middle * log_weight)).sum() >= MIN_EFFECTIVE_SIZE
        low, high = (middle, high) if enough else (low, middle)
    return _normalised(low * log_weight)


def _stratified(rng: np.random.Generator, count: int) -> FloatArray:
    """Return points of the unit cube, each coordinate in equal parts (Latin hypercube)."""
    order = rng.permuted(np.tile(np.arange(count)[:, None], (1, 6)), axis=0)
    return np.asarray((order + rng.random((count, 6))) / count)


def _scatter(values: FloatArray) -> float:
    """Return the variance of the noise by the second differences, whatever the trend; robust against single steps."""
    second = np.diff(values, 2)
    # 0.455 is the median of a squared standard normal number, 6 the variance of the second difference of white noise
    return float(np.median(np.square(second))) / (6.0 * 0.455) if second.size else 0.0


def _standardised(values: FloatArray) -> FloatArray:
    return np.asarray((values - values.mean()) / max(float(values.std()), 1e-300))


def _grid(count: int) -> FloatArray:
    return (np.arange(count) + 0.5) / count
