"""What healthy recordings show in their features: scatter between recordings and within them, and how far off one is.

Recordings are drawn from a population: the mean of a recording's m windows scatters with S_b + S_w/m. With n recordings
S_m, the covariance of their means around a line over their order, is shrunk towards the shape of S_w, the covariance of
windows within recordings (oracle approximating shrinkage; Chen, Wiesel, Eldar, Hero, 2010):

    S = ((n - 2) S_m + nu k S_w)/(n - 2 + nu),  k = tr S_m/tr S_w
    C = S (1 + 1/n + n^2/t't) + (n b)(n b)' + S_w max(1/m - 1/m_n, 0)

which predicts a recording n places after the middle of those learned, b the slope over the order and t the order
itself: healthy machines drift. The statistic is the largest T^2/d over groups of features that belong together.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from pydantic import BaseModel, ConfigDict

from servoscope.baseline.threshold import FEATURE_SHARE, SECONDS_PER_YEAR
from servoscope.core.arrays import FloatArray, IndexArray
from servoscope.estimation.window_features import MOTIONS, SIGNALS, FeatureLayout, Window

PRIOR_DEGREES = 12.0  # degrees of freedom of the shape of S_w behind S
SCORE_STD = 0.5  # of the logarithm of healthy scores, expected before any was seen
SCORE_PRIOR = 8.0  # degrees of freedom of that expectation
WIDENING_SHARE = 0.5  # share by which the healthy range of motion is widened either way
MIN_WIDENING = 0.05  # and by how much at least: of a share of time, of a logarithm of speed

Vector = tuple[float, ...]
Matrix = tuple[Vector, ...]


class _FeatureRecord(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class FeatureGroup(_FeatureRecord):
    """Features that belong together, at one length of windows, of n healthy recordings."""

    level: int
    kept: tuple[int, ...]  # features that every recording shows, by number
    means: Matrix  # of each recording, in the order of learning, shape (n, k)
    within: Matrix  # covariance of windows around the mean of their recording, shape (k, k)
    degrees: int  # of freedom behind `within`
    windows: float  # per recording, on average


class FeatureModel(_FeatureRecord):
    """The features of healthy recordings; everything that compares another recording with them."""

    layout: FeatureLayout
    groups: tuple[FeatureGroup, ...]
    motion_low: Vector  # range of the healthy spans' motion: shares of the motions, log rms speeds
    motion_high: Vector
    left_out: Vector  # score of each healthy recording when learned without it
    limit: float  # of the score
    false_alarms: float  # share of healthy spans that exceed it
    in_a_row: int  # spans above the limit until a running monitor raises the alarm

    @property
    def recordings(self) -> int:
        """Number of healthy recordings n."""
        return len(self.left_out)

    def shared(self, false_alarms_per_year: float) -> Self:
        """Return the model for another budget of false alarms per year."""
        in_a_row = spans_in_a_row(self.layout, self.false_alarms, false_alarms_per_year)
        return self.model_copy(update={"in_a_row": in_a_row})

    @cached_property
    def statistics(self) -> tuple[GroupStatistic, ...]:
        """What scores each group."""
        return tuple(GroupStatistic.of(group) for group in self.groups)

    def score(self, span: SpanFeatures) -> float:
        """Return the largest T^2/d over the groups; NaN where the motion is none that healthy recordings show."""
        return max(self.scores(span)) if self.is_familiar(span) else float("nan")

    def scores(self, span: SpanFeatures) -> list[float]:
        """Return T^2/d of each group."""
        return [one.score(span.values[one.level], span.counts[one.level]) for one in self.statistics]

    def is_familiar(self, span: SpanFeatures) -> bool:
        """Return whether healthy recordings moved like this; what they never showed is no evidence."""
        seen = np.isfinite(span.motion)
        low, high = np.array(self.motion_low), np.array(self.motion_high)
        return bool(((span.motion >= low) & (span.motion <= high))[seen].all())

    def conformal_p_value(self, span: SpanFeatures) -> float:
        """Return how often a further healthy recording would be as unlike the others, whatever their distribution.

        Full conformal (Vovk, Gammerman, Shafer, 2005): with the new one among them, each of the n + 1 recordings is
        scored against the n others; the p-value is the rank of the new one. Where recordings are exchangeable it is
        at most alpha with a probability of at most alpha; it is never below 1/(n + 1).
        """
        n = self.recordings
        scores = np.zeros(n + 1)
        for group in self.groups:
            values = np.vstack([np.array(group.means), span.values[group.level][list(group.kept)]])
            if not np.isfinite(values).all():
                continue
            for i in range(n + 1):
                others = group.model_copy(update={"means": np.delete(values, i, axis=0)})
                one = GroupStatistic.of(others, drift=False, features=np.arange(values.shape[1]))
                scores[i] = max(scores[i], one.score(values[i], group.windows))
        return float((scores >= scores[-1]).sum()) / (n + 1.0)


class SpanFeatures(NamedTuple):
    """Mean features of a span of windows, per level: values (levels, d), windows (levels,), motion (5,)."""

    values: FloatArray
    counts: FloatArray
    motion: FloatArray

    @classmethod
    def of(cls, windows: Sequence[Window], layout: FeatureLayout) -> SpanFeatures:
        """Average windows."""
        sums = SpanSums(layout)
        for window in windows:
            sums.add(window)
        return sums.mean()


class SpanSums:
    """Adds up windows in one array of numbers, `state`, which may be one that somebody else keeps."""

    def __init__(self, layout: FeatureLayout, state: FloatArray | None = None) -> None:
        d, levels = layout.size, layout.levels
        self.state = np.zeros(self.size_of(layout)) if state is None else state
        self.counts = self.state[:levels]
        self._motion = self.state[levels : levels + 10].reshape(2, 5)
        self._values = self.state[levels + 10 :].reshape(2, levels, d)

    @staticmethod
    def size_of(layout: FeatureLayout) -> int:
        """Return the size of the state."""
        return layout.levels * (1 + 2 * layout.size) + 10

    def add(self, window: Window) -> None:
        """Add a window; what it does not show does not count."""
        self.counts[window.level] += 1.0
        for sums, values in ((self._values[:, window.level], window.features), (self._motion, window.motion)):
            if sums is self._motion and window.level:
                continue
            seen = np.isfinite(values)
            sums[0][seen] += values[seen]
            sums[1] += seen

    def mean(self) -> SpanFeatures:
        """Return the means; NaN where nothing was seen."""
        with np.errstate(invalid="ignore", divide="ignore"):
            values, motion = (one[0] / one[1] for one in (self._values, self._motion))
        return SpanFeatures(values, self.counts.copy(), motion)


class GroupStatistic(NamedTuple):
    """T^2/d of a group of features: centre, scale and covariances in standard deviations."""

    level: int
    kept: IndexArray
    centre: FloatArray
    scale: FloatArray
    predicted: FloatArray  # C for as many windows as the healthy recordings hold
    within: FloatArray  # S_w
    windows: float

    @classmethod
    def of(cls, group: FeatureGroup, drift: bool = True, features: IndexArray | None = None) -> GroupStatistic:
        """Prepare a group; without `drift`, the order of the recordings does not count."""
        M, W = np.array(group.means), np.array(group.within)
        n = len(M)
        centre = M.mean(axis=0)
        scale = np.sqrt(np.diag(W) + M.var(axis=0, ddof=1))
        scale = np.where(scale > 0.0, scale, np.maximum(np.abs(centre), 1.0))
        Z, within = (M - centre) / scale, shrink(W / np.outer(scale, scale), group.degrees)
        t = np.arange(n) - (n - 1.0) / 2.0
        tt = float(t @ t)
        slope = t @ Z / tt if drift else np.zeros(len(centre))
        rest, dof = Z - np.outer(t, slope), n - 2.0 if drift else n - 1.0
        between = rest.T @ rest / dof
        # recordings of one window say nothing of the shape: no feature then goes with another
        shape = within if np.trace(within) > 0.0 else np.eye(len(centre))
        ratio = float(np.trace(between) / np.trace(shape))
        S = (dof * between + PRIOR_DEGREES * ratio * shape) / (dof + PRIOR_DEGREES)
        ahead = n * n / tt if drift else 0.0
        C = S * (1.0 + 1.0 / n + ahead) + n * n * np.outer(slope, slope) + 1e-9 * np.eye(len(centre))
        kept = np.array(group.kept) if features is None else features
        return cls(group.level, kept, centre, scale, C, within, group.windows)

    def deviations(self, values: FloatArray) -> FloatArray:
        """Return how far off each of the group's features is, in standard deviations between recordings."""
        return np.asarray((values[self.kept] - self.centre) / (self.scale * np.sqrt(np.diag(self.predicted))))

    def score(self, values: FloatArray, windows: float) -> float:
        """Return T^2/d of features that are the mean of some windows; 0 where none of them was seen."""
        z = (values[self.kept] - self.centre) / self.scale
        seen = np.isfinite(z)
        if not seen.any() or not windows > 0.0:
            return 0.0
        C = self.predicted + self.within * max(1.0 / windows - 1.0 / self.windows, 0.0)
        return float(z[seen] @ np.linalg.solve(C[np.ix_(seen, seen)], z[seen])) / int(seen.sum())


def shrink(S: FloatArray, degrees: int) -> FloatArray:
    """Shrink a covariance matrix towards a multiple of the identity (oracle approximating shrinkage)."""
    p, n = len(S), max(degrees, 1)
    mean, square = float(np.trace(S)) / p, float((S**2).mean())
    spread = (n + 1.0) * (square - mean**2 / p)
    weight = min((square + mean**2) / spread, 1.0) if spread > 0.0 else 1.0
    return (1.0 - weight) * S + weight * mean * np.eye(p)


def fit_groups(recordings: Sequence[Sequence[Window]], layout: FeatureLayout) -> tuple[FeatureGroup, ...]:
    """Return the groups of features of healthy recordings, each given by its windows."""
    means = [SpanFeatures.of(windows, layout).values for windows in recordings]
    found = []
    for level in range(layout.levels):
        rows = [np.array([w.features for w in windows if w.level == level]) for windows in recordings]
        if not all(len(each) for each in rows):
            continue
        for part in layout.groups:
            columns = np.arange(layout.size)[part]
            kept = columns[np.isfinite([mean[level, part] for mean in means]).all(axis=0)]
            if not len(kept):
                continue
            M = np.array([mean[level, kept] for mean in means])
            apart = np.concatenate([each[:, kept] - mean for each, mean in zip(rows, M, strict=True)])
            apart = np.where(np.isfinite(apart), apart, 0.0)
            degrees = max(len(apart) - len(M), 1)
            found.append(
                FeatureGroup(
                    level=level,
                    kept=tuple(kept.tolist()),
                    means=tuple(map(tuple, M.tolist())),
                    within=tuple(map(tuple, (apart.T @ apart / degrees).tolist())),
                    degrees=degrees,
                    windows=len(apart) / len(M),
                )
            )
    return tuple(found)


def score_limit(left_out: Sequence[float], false_alarms: float) -> float:
    """Return the score that a further healthy recording exceeds with a probability, by a log-normal distribution.

    Student's t for one more value beyond n, whose variance is shrunk to what is expected of such scores.
    """
    from scipy import special

    quantile = float(special.stdtrit(len(left_out) - 1.0 + SCORE_PRIOR, 1.0 - false_alarms))
    return float(np.exp(_score_logs(left_out).mean() + quantile * score_std(left_out)))


def score_std(left_out: Sequence[float]) -> float:
    """Return the standard deviation of the logarithm of a further healthy recording's score around their mean."""
    logs, n = _score_logs(left_out), len(left_out)
    own = float(logs.var(ddof=1)) if n > 1 else 0.0
    variance = ((n - 1.0) * own + SCORE_PRIOR * SCORE_STD**2) / (n - 1.0 + SCORE_PRIOR)
    return float(np.sqrt(variance * (1.0 + 1.0 / n)))


def _score_logs(left_out: Sequence[float]) -> FloatArray:
    return np.asarray(np.log(np.maximum(left_out, 1e-9)))


def spans_in_a_row(layout: FeatureLayout, false_alarms: float, false_alarms_per_year: float) -> int:
    """Return how many spans in a row must exceed the limit so that a stream of them stays within its budget."""
    budget = FEATURE_SHARE * false_alarms_per_year * layout.span_s / SECONDS_PER_YEAR
    return max(1, int(np.ceil(np.log(budget) / np.log(false_alarms))))


class FeatureName(NamedTuple):
    """What a feature is: of which signal, in which motion, and in which band or time since the motion began."""

    signal: str
    motion: str
    band_hz: tuple[float, float] | None
    since_s: tuple[float, float] | None

    @classmethod
    def of(cls, layout: FeatureLayout, feature: int) -> FeatureName:
        """Return what the feature of a number is."""
        for group, part in enumerate(layout.groups):
            if part.start <= feature < part.stop:
                signal, k = SIGNALS[group % 2], feature - part.start
                if group < 2:
                    motion, at = divmod(k, len(layout.edges_s) + 1)
                    edges = (0.0, *layout.edges_s, float("inf"))
                    return cls(signal, MOTIONS[motion], None, (edges[at], edges[at + 1]))
                motion, at = divmod(k, layout.bands)
                return cls(signal, MOTIONS[motion], (layout.bands_hz[at], layout.bands_hz[at + 1]), None)
        raise ValueError(f"there is no feature {feature}")
