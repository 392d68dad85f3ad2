"""What the healthy coefficients leave of u: over whole recordings, and in their second half against their first.

No model is exact: in healthy recordings too, the residual e = eta - phi' theta has a mean of its own at each speed,
position and acceleration. This mean is taken out. What is left by classes of speed, its correlation with acceleration
and position, and its rms scatter between healthy recordings; how far a further recording is from them is T^2/d of
`GroupStatistic`. The second half of a recording is compared with the first, too: what differs from day to day is in
both. Where coefficients of a recording are compared with healthy ones, so are those of all its samples.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from pydantic import Field

from servoscope.baseline.covariates import CovariatePath
from servoscope.baseline.feature_model import FeatureGroup, GroupStatistic, is_near
from servoscope.baseline.records import BaselineModel, Matrix, Vector
from servoscope.core import outofcore
from servoscope.core.arrays import BoolArray, FloatArray, IntArray, to_tuples
from servoscope.estimation.pipeline import Pipeline, Regression, RegressionRunner
from servoscope.models.lti import solve_scaled
from servoscope.signals import Recording

SPEED_SHARES = (0.02, 0.1, 0.4, 0.8)  # of the top speed: the classes of speed in either direction
CLASSES = 2 * len(SPEED_SHARES) + 1
POSITIONS = 6  # classes of position
CORRELATIONS = 4  # with acceleration and position, each by itself and by direction
SIZE = CLASSES + CORRELATIONS + 1  # number of features
MIN_SAMPLES_PER_COEFFICIENT = 20  # usable samples that are fitted
FADE_S = 0.1  # time in a class at which its mean counts half
SAME_MOTION_RATIO = 1.6  # of rms position, speed and acceleration of r, up to which two recordings move alike
LIKE_MOTION = 0.12  # difference of the logarithms of these, at which the fit of another recording counts 60 %
COMMON_FITS = 0.5  # fits that the coefficients of all recordings count as, among those of like motions
MIN_SHARE = 1e-4  # of the rms of eta: a smaller difference is no evidence
MIN_COLUMN_SHARE = 0.05  # of the rms that a column has when healthy: with less it tells nothing of its coefficient


class ResidualSamples(NamedTuple):
    """A chunk of N samples: residual, eta, which may be used; position, speed and acceleration of y and r, (N, 3)."""

    e: FloatArray
    eta: FloatArray
    ok: BoolArray
    of_y: FloatArray
    of_r: FloatArray


class RecordingResidual(NamedTuple):
    """Features of a recording: of all of it, its first and its second half."""

    features: FloatArray  # shape (3, SIZE)
    covariates: FloatArray  # means, shape (3, k)
    motion: FloatArray  # logarithms of the rms position, speed and acceleration of r, shape (3,)
    samples: float  # that are usable
    size: float  # rms of eta

    @property
    def shift(self) -> FloatArray:
        """Features of the second half less those of the first, shape (SIZE,)."""
        return np.asarray(self.features[2] - self.features[1])


class ResidualLayout(BaselineModel):
    """The healthy coefficients, the classes, and the mean that the residual has in each."""

    theta: Vector
    origin: float  # middle of the healthy positions
    speeds: Vector  # edges of the classes
    positions: Vector
    accelerations: Vector
    means: Vector = ()  # of the residual, by classes of speed, position and acceleration
    covariates: tuple[str, ...] = ()

    @property
    def cells(self) -> tuple[int, int, int]:
        """Number of classes of speed, position and acceleration."""
        return len(self.speeds) + 1, len(self.positions) + 1, len(self.accelerations) + 1

    def cell(self, kinematics: FloatArray) -> IntArray:
        """Return the number of the cell of each sample, shape (N,), at position, speed and acceleration (N, 3)."""
        edges = zip(kinematics.T[[1, 0, 2]], (self.speeds, self.positions, self.accelerations), strict=True)
        return np.asarray(np.ravel_multi_index(tuple(np.digitize(x, edge) for x, edge in edges), self.cells))

    def with_means(self, pipeline: Pipeline, recordings: Sequence[Recording]) -> Self:
        """Return the layout with the mean residual of healthy recordings in each cell."""
        sums = np.zeros((2, int(np.prod(self.cells))))
        for recording in recordings:
            for part in residual_samples(pipeline, self, recording):
                cell = self.cell(part.of_y[part.ok])
                sums += [np.bincount(cell, weights, sums.shape[1]) for weights in (part.e[part.ok], None)]
        means = sums[0] / (sums[1] + FADE_S * pipeline.loop.sample_rate)
        return self.model_copy(update={"means": tuple(means.tolist())})

    def features(self, pipeline: Pipeline, recording: Recording) -> RecordingResidual:
        """Read a recording once, chunk by chunk."""
        means, half, begin = np.array(self.means), recording.samples // 2, 0
        sums, motion = np.zeros((2, 2 * CLASSES + 2 * CORRELATIONS + 3)), np.zeros(3)
        for part in residual_samples(pipeline, self, recording):
            columns = self._columns(part, means[self.cell(part.of_y)])
            later = np.arange(begin, begin := begin + len(part.e)) >= half
            sums += [columns[part.ok & ~later].sum(axis=0), columns[part.ok & later].sum(axis=0)]
            motion += (part.of_r[part.ok] ** 2).sum(axis=0)
        fade = FADE_S * recording.sample_rate
        parts = slice(None), slice(half), slice(half, None)
        channels = [recording.channels[name] for name in self.covariates]
        number, power = sums[:, -1].sum(), sums[:, -2].sum()
        with np.errstate(divide="ignore", invalid="ignore"):
            return RecordingResidual(
                np.array([_features(x, fade) for x in (sums.sum(axis=0), *sums)]),
                np.array([[np.nanmean(channel[part]) for channel in channels] for part in parts]),
                0.5 * np.log(motion / number),
                float(number),
                float(np.sqrt(power / number)),
            )

    def _columns(self, part: ResidualSamples, means: FloatArray) -> FloatArray:
        """Return what is summed up: counts and e by class of speed, e w, w^2, e^2, eta^2 and 1."""
        e, (y, v, a) = part.e - means, part.of_y.T
        inside = np.digitize(v, self.speeds)[:, None] == np.arange(CLASSES)
        w = np.column_stack([a, np.abs(a) * np.sign(v), y, y * np.sign(v)])
        return np.column_stack([inside, inside * e[:, None], w * e[:, None], w**2, e**2, part.eta**2, np.ones(len(e))])


def residual_samples(pipeline: Pipeline, layout: ResidualLayout, recording: Recording) -> Iterator[ResidualSamples]:
    """Yield a recording, chunk by chunk."""
    runners = [RegressionRunner(p) for p in (pipeline, pipeline.kinematics, pipeline.kinematics)]
    for rows in outofcore.iter_chunks(0, recording.samples):
        part = recording.rows(rows)
        r, y = part.r - layout.origin, part.y - layout.origin
        inputs = (part.r, part.u, part.y), (y, y, y), (r, r, r)
        g, of_y, of_r = (runner.advance(*x, part.restart) for runner, x in zip(runners, inputs, strict=True))
        yield ResidualSamples(g.eta - g.phi @ layout.theta, g.eta, g.ok & of_y.ok & of_r.ok, of_y.phi, of_r.phi)
        outofcore.release(*recording.columns)


def _features(sums: FloatArray, fade: float) -> FloatArray:
    """Return the features (SIZE,) of sums, in units of u; a mean of few samples fades to 0, which is expected of it."""
    counts, means, products, squares, last = np.split(sums, np.cumsum([CLASSES, CLASSES, CORRELATIONS, CORRELATIONS]))
    correlations = products / np.sqrt(np.maximum(squares, np.finfo(np.float64).tiny) * last[2])
    return np.concatenate([means / (counts + fade), correlations, np.sqrt(last[:1] / last[2])])


class MotionFits(BaselineModel):
    """Coefficients of healthy recordings by their motion: what no term explains repeats with it."""

    fits: Matrix  # shape (m, n)
    motions: Matrix  # `rms_motion` of each, shape (m, 3)
    covariance: Matrix = ()  # of a further whole recording about what its motion lets expect, shape (n, n)

    def expected(self, motion: FloatArray, theta: FloatArray) -> FloatArray:
        """Return the coefficients that a motion (3,) lets expect, (n,); theta (n,) of all where none moved like it."""
        apart = (np.array(self.motions) - motion) / LIKE_MOTION
        weight = np.exp(-0.5 * (apart**2).sum(axis=1))
        total = weight @ np.array(self.fits) + COMMON_FITS * theta
        return np.asarray(total / (weight.sum() + COMMON_FITS))


def rms_motion(pipeline: Pipeline, recording: Recording, origin: float) -> FloatArray:
    """Return the logarithms of the rms position, speed and acceleration of r, shape (3,)."""
    r = recording.r - origin
    g = pipeline.kinematics.regression(r, r, r, recording.restart)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(0.5 * np.log((g.phi[g.ok] ** 2).mean(axis=0)))


class ResidualModel(BaselineModel):
    """The residuals of healthy recordings; everything that compares another recording with them."""

    layout: ResidualLayout
    motions: Matrix  # `RecordingResidual.motion` of each recording, shape (n, 3)
    samples: float  # of a recording, on average
    groups: tuple[FeatureGroup, FeatureGroup]  # whole recordings; second halves less first ones
    limits: tuple[float, float] = (1.0, 1.0)  # of T^2/d
    # covariance (n, n) of coefficients fitted to half a recording, about the healthy ones; empty where not compared
    halves: Matrix = Field(default=(), exclude_if=lambda value: not value)
    rms: Vector = Field(default=(), exclude_if=lambda value: not value)  # of each column when healthy
    like: MotionFits | None = Field(default=None, exclude_if=lambda value: value is None)
    fit_limit: float = Field(default=np.inf, exclude_if=np.isinf)  # of T^2/n of the coefficients of a whole recording

    @classmethod
    def of(cls, layout: ResidualLayout, healthy: Sequence[RecordingResidual]) -> Self:
        """Describe healthy recordings, without limits."""
        values = np.array([residual.features[0] for residual in healthy])
        c = np.array([residual.covariates[0] for residual in healthy])
        shifts = np.array([residual.shift for residual in healthy])
        least = (MIN_SHARE * float(np.mean([residual.size for residual in healthy]))) ** 2
        X = np.column_stack([np.ones(len(c)), c])
        left = values - X @ (np.linalg.pinv(X) @ values)
        whole = _group(values, 0.5 * np.cov(shifts.T), left.var(axis=0, ddof=X.shape[1]), least, 2.0, c)
        statistic = GroupStatistic.of(whole, drift=False)
        shifts -= [_expected_shift(statistic, residual) for residual in healthy]
        W = np.cov(shifts.T)
        return cls(
            layout=layout,
            motions=to_tuples(np.array([residual.motion for residual in healthy])),
            samples=float(np.mean([residual.samples for residual in healthy])),
            groups=(whole, _group(shifts, W, np.diag(W), least, 1.0, c[:, :0])),
        )

    @cached_property
    def _statistics(self) -> list[GroupStatistic]:
        return [GroupStatistic.of(group, drift=False) for group in self.groups]

    def ratios_of(self, pipeline: Pipeline, recording: Recording) -> FloatArray:
        """Return `ratios` of a recording."""
        return self.ratios(self.layout.features(pipeline, recording))

    def ratios(self, residual: RecordingResidual) -> FloatArray:
        """Return the scores of a recording and of its second half against its first over their limits, shape (2,).

        NaN where no healthy recording moves like this, at such covariates.
        """
        (whole, shift), c = self._statistics, residual.covariates[0]
        apart = np.abs(np.array(self.motions) - residual.motion).max(axis=1).min()
        if not apart <= np.log(SAME_MOTION_RATIO) or not is_near(np.array(self.groups[0].covariates), c):
            return np.full(2, np.nan)
        if self.like is not None:  # an axis is scanned for changes, and what its terms leave of u goes by the gain
            return np.zeros(2)
        share = residual.samples / self.samples
        moved = residual.shift - _expected_shift(whole, residual)
        scores = whole.score(residual.features[0], 2.0 * share, c), shift.score(moved, share)
        return np.array(scores) / self.limits

    def stretch_covariance(self, samples: float) -> FloatArray:
        """Return the covariance (n, n) of coefficients fitted to so many usable samples of a healthy recording.

        More than half a recording is not surer: what differs from day to day does not average.
        """
        return np.array(self.halves) * max(1.0, 0.5 * self.samples / max(samples, 1.0))

    def deviation_of_rows(
        self, pipeline: Pipeline, recording: Recording, rows: slice, theta: FloatArray, along: CovariatePath | None
    ) -> StretchFit | None:
        """Return a fit to some rows against theta (n,), moved along covariates or to what their motion lets expect.

        NaN where the rows do not show a coefficient; None where they are few, or healthy fits were not compared.
        """
        part = recording.rows(rows)
        g = pipeline.regression(part.r, part.u, part.y, part.restart) if self.halves else None
        if g is None or (samples := int(g.ok.sum())) < MIN_SAMPLES_PER_COEFFICIENT * len(theta):
            return None
        if along is not None:
            theta = along.expected(np.arange(recording.samples)[rows][g.ok]).mean(axis=0)
        elif self.like is not None:
            theta = self.like.expected(rms_motion(pipeline, part, self.layout.origin), theta)
        deviation = fit_coefficients(g, np.array(self.rms or 0.0)) - theta
        return StretchFit(deviation, self.stretch_covariance(samples), theta)

    def detectable_changes(self, directions: Mapping[str, FloatArray], covariance: FloatArray) -> dict[str, float]:
        """Return the smallest relative changes that leave the limit of the fit, by parameter; infinite: none does.

        `directions`: what a relative change adds to the coefficients, (n,); `covariance`: of the fit, (n, n).
        """
        with np.errstate(divide="ignore"):
            sizes = {
                name: len(d) * self.fit_limit / (d @ solve_scaled(covariance, d)) for name, d in directions.items()
            }
        return {name: float(np.sqrt(size)) for name, size in sizes.items()}


class StretchFit(NamedTuple):
    """Coefficients fitted to some rows: how far they are from healthy (n,), how healthy ones scatter (n, n)."""

    deviation: FloatArray
    covariance: FloatArray
    healthy: FloatArray  # shape (n,)

    @property
    def t2(self) -> float:
        """Hotelling's statistic of a deviation by a coefficient."""
        return mean_t2(self.deviation, self.covariance)


def mean_t2(deviation: FloatArray, covariance: FloatArray) -> float:
    """Return d' C^-1 d/n of the n entries of a deviation that are known: Hotelling's statistic."""
    known = np.flatnonzero(np.isfinite(deviation))
    d = deviation[known]
    return float(d @ solve_scaled(covariance[np.ix_(known, known)], d)) / max(len(known), 1)


def fit_coefficients(g: Regression, rms: FloatArray) -> FloatArray:
    """Return least squares over the usable samples, (n,); NaN where a column is hardly there, by its healthy rms."""
    phi, z, eta = g.phi[g.ok], g.z[g.ok], g.eta[g.ok]
    theta = np.full(phi.shape[1], np.nan)
    known = np.flatnonzero((phi**2).sum(axis=0) > len(phi) * (MIN_COLUMN_SHARE * rms) ** 2)
    theta[known] = solve_scaled(z[:, known].T @ phi[:, known], z[:, known].T @ eta)
    return theta


def _expected_shift(statistic: GroupStatistic, residual: RecordingResidual) -> FloatArray:
    """Return what the covariates make of the second half less the first, shape (SIZE,)."""
    first, second = (statistic.expected(c) for c in residual.covariates[1:])
    return np.asarray(second - first)


def _group(
    values: FloatArray, within: FloatArray, variances: FloatArray, least: float, windows: float, c: FloatArray
) -> FeatureGroup:
    """Return features as a group; variances of few recordings are widened by that of the median feature."""
    within = within + max(float(np.median(variances)), least) * np.eye(SIZE)
    return FeatureGroup(
        level=0,
        kept=tuple(range(SIZE)),
        means=to_tuples(values),
        within=to_tuples(within),
        degrees=len(values) - 1,
        windows=windows,
        covariates=to_tuples(c),
    )
