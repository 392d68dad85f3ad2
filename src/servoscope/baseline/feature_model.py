"""What healthy recordings show in their features: scatter between recordings and within them, and how far off one is.

Recordings are drawn from a population: the mean of a recording's m windows scatters with S_b + S_w/m. The means of n
recordings are regressed on x = (1, t, c): their order t, for healthy machines drift, and their covariates c, where
those are logged. S_m, the covariance of what is left with n - p degrees of freedom, is shrunk towards the shape of S_w,
the covariance of windows within recordings (oracle approximating shrinkage; Chen, Wiesel, Eldar, Hero, 2010):

    S = ((n - p) S_m + nu k S_w)/(n - p + nu),  k = tr S_m/tr S_w
    C = S (1 + x' (X'X)^-1 x) + (n b)(n b)' + S_w max(1/m - 1/m_n, 0)

which predicts a recording n places after the middle of those learned, b the slope over the order. T^2/d of groups of
features that belong together are averaged in the fourth power: one group that is far off counts, and so do several that
are off together. The limit follows from the scores of recordings left out, whose mean and scatter are robust (Huber,
1964), and is none below the largest of these: an outlier among them raises it to its own score, not to a multiple.

A recording is compared with its own past too: the means of its later windows less those of its earlier ones, beside
those differences in healthy recordings. What differs from day to day hides nothing then.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from pydantic import Field

from servoscope.baseline.covariates import EDGE_SHARE
from servoscope.baseline.feature_spans import NO_COVARIATES, SpanFeatures
from servoscope.baseline.records import BaselineModel, Matrix, Vector
from servoscope.baseline.threshold import FEATURE_SHARE, SECONDS_PER_YEAR
from servoscope.core.arrays import FloatArray, to_tuples
from servoscope.estimation.window_features import MOTIONS, SIGNALS, FeatureLayout, Window

PRIOR_DEGREES = 30.0  # degrees of freedom of the shape of S_w behind S
SCORE_POWER = 4.0  # in which the scores of groups are averaged
WIDENING_SHARE = 0.5  # share by which the healthy range of motion is widened either way
MIN_WIDENING = 0.05  # and by how much at least: of a share of time, of a logarithm of speed


class FeatureGroup(BaselineModel):
    """Features that belong together, at one length of windows, of n healthy recordings."""

    level: int
    kept: tuple[int, ...]  # features that every recording shows, by number
    means: Matrix  # of each recording, in the order of learning, shape (n, k)
    within: Matrix  # covariance of windows around the mean of their recording, shape (k, k)
    degrees: int  # of freedom behind `within`
    windows: float  # per recording, on average
    # covariates of each recording, shape (n, k)
    covariates: Matrix = Field(default=(), exclude_if=lambda value: not value)
    # whether the features are later windows less earlier ones of the same recording
    past: bool = Field(default=False, exclude_if=lambda value: not value)

    def pick(self, span: SpanFeatures) -> tuple[FloatArray, float]:
        """Return the features of a span that the group is about, shape (k,), and how many windows they are worth."""
        values, counts = (span.shift, span.shift_counts) if self.past else (span.values, span.counts)
        return values[self.level, list(self.kept)], float(counts[self.level])


class FeatureModel(BaselineModel):
    """The features of healthy recordings; everything that compares another recording with them."""

    layout: FeatureLayout
    groups: tuple[FeatureGroup, ...]
    motion_low: Vector  # range of the healthy spans' motion: shares of the motions, log rms speeds
    motion_high: Vector
    left_out: Vector  # score of each healthy recording when learned without it
    limit: float  # of the score
    false_alarms: float  # share of healthy spans that exceed it
    in_a_row: int  # spans above the limit until a running monitor raises the alarm
    covariates: tuple[str, ...] = Field(default=(), exclude_if=lambda value: not value)  # names of the k covariates
    # of the score against the recording's own past; 0 where recordings are not compared with it
    past_limit: float = Field(default=0.0, exclude_if=lambda value: not value)

    @property
    def compares_past(self) -> bool:
        """Whether recordings are compared with their own past."""
        return self.past_limit > 0.0

    @property
    def recordings(self) -> int:
        """Number of healthy recordings n."""
        return len(self.left_out)

    def shared(self, false_alarms_per_year: float) -> Self:
        """Return the model for another budget of false alarms per year."""
        in_a_row = spans_in_a_row(self.layout, self.false_alarms, false_alarms_per_year)
        return self.model_copy(update={"in_a_row": in_a_row})

    def with_scatter(self, earlier: FeatureModel | None) -> Self | None:
        """Return the model with an earlier one's recordings, moved to the mean of its own, and the larger limits.

        None where the earlier one has other features: a short stretch alone does not show how healthy days differ.
        """
        if earlier is None or earlier.covariates:
            return None
        here, there = self.layout, earlier.layout
        if (here.bands_hz, here.edges_s) != (there.bands_hz, there.edges_s):
            return None
        known = {(group.level, group.past, group.kept): np.array(group.means) for group in earlier.groups}
        groups = []
        for group in self.groups:
            own, before = np.array(group.means), known.get((group.level, group.past, group.kept))
            if before is None:
                return None
            moved = before - before.mean(axis=0) + own.mean(axis=0)
            groups.append(group.model_copy(update={"means": to_tuples(np.vstack([moved, own]))}))
        limits = {
            "limit": max(self.limit, earlier.limit),
            "past_limit": max(self.past_limit, earlier.past_limit) if self.compares_past else 0.0,
        }
        left_out = (*earlier.left_out, *self.left_out)
        return self.model_copy(update={"groups": tuple(groups), "left_out": left_out, **limits})

    def at(self, covariates: FloatArray) -> Self:
        """Return the model at some covariates (k,), which recordings need not have then."""
        if not self.covariates:
            return self
        groups = [statistic.at(covariates) for statistic in self.statistics]
        # anew: a copy would keep the statistics of these groups
        return type(self).model_validate(self.model_dump() | {"groups": tuple(groups), "covariates": ()})

    @cached_property
    def statistics(self) -> tuple[GroupStatistic, ...]:
        """What scores each group."""
        return tuple(GroupStatistic.of(group) for group in self.groups)

    def ratio(self, span: SpanFeatures) -> float:
        """Return the larger score over its limit; NaN where healthy recordings do not move like this."""
        if not self.is_familiar(span):
            return float("nan")
        now, past = span_scores(self.statistics, span)
        return max(now / self.limit, past / self.past_limit if self.compares_past else 0.0)

    def ratios(self, span: SpanFeatures) -> list[float]:
        """Return T^2/d of each group over its limit; where the score exceeds it, the largest of them does."""
        return [
            statistic.of_span(span) / (self.past_limit if statistic.group.past else self.limit)
            for statistic in self.statistics
        ]

    def is_familiar(self, span: SpanFeatures) -> bool:
        """Return whether healthy recordings moved like this, at such covariates; what is unknown is no evidence."""
        seen = np.isfinite(span.motion)
        low, high = np.array(self.motion_low), np.array(self.motion_high)
        moved = bool(((span.motion >= low) & (span.motion <= high))[seen].all())
        return moved and (not self.covariates or is_near(np.array(self.groups[0].covariates), span.covariates))

    def conformal_p_value(self, span: SpanFeatures) -> float:
        """Return how often a further healthy recording would be as unlike the others, whatever their distribution.

        Full conformal (Vovk, Gammerman, Shafer, 2005): with the new one among them, each of the n + 1 recordings is
        scored against the n others; the p-value is the rank of the new one. Where recordings are exchangeable it is
        at most alpha with a probability of at most alpha; it is never below 1/(n + 1).
        """
        n = self.recordings
        scores = np.zeros(n + 1)
        for group in (group for group in self.groups if not group.past):
            new, _ = group.pick(span)
            values = np.vstack([np.array(group.means), new])
            if not np.isfinite(values).all():
                continue
            c = np.vstack([np.array(group.covariates).reshape(n, -1), span.covariates[: len(self.covariates)]])
            for i in range(n + 1):
                others = group.model_copy(
                    update={"means": np.delete(values, i, axis=0), "covariates": np.delete(c, i, axis=0)}
                )
                statistic = GroupStatistic.of(others, drift=False)
                scores[i] = max(scores[i], statistic.score(values[i], group.windows, c[i]))
        return float((scores >= scores[-1]).sum()) / (n + 1.0)


class GroupStatistic(NamedTuple):
    """T^2/d of a group of features, in their scale: regression on x = (1, t, c), and what is left of it."""

    group: FeatureGroup
    centre: FloatArray  # features at the middle of the order and of the covariates, shape (k,)
    scale: FloatArray
    slopes: FloatArray  # per unit of each covariate, shape (number of covariates, k)
    middle: FloatArray  # of each covariate
    gram: FloatArray  # (X'X)^-1
    ahead: FloatArray  # x of a further recording, at the middle of the covariates
    between: FloatArray  # S
    drift: FloatArray  # (n b)(n b)'
    within: FloatArray  # S_w

    @classmethod
    def of(cls, group: FeatureGroup, drift: bool = True) -> GroupStatistic:
        """Prepare a group; without `drift`, the order of the recordings does not count."""
        M, W = np.array(group.means), np.array(group.within)
        n, drift = len(M), drift and not group.past
        c = np.array(group.covariates).reshape(n, -1)
        centre, middle = M.mean(axis=0), c.mean(axis=0)
        scale = np.sqrt(np.diag(W) + M.var(axis=0, ddof=1))
        scale = np.where(scale > 0.0, scale, np.maximum(np.abs(centre), 1.0))
        Z, within = (M - centre) / scale, shrink(W / np.outer(scale, scale), group.degrees)
        order = np.arange(n)[:, None] - (n - 1.0) / 2.0
        X = np.hstack([np.ones((n, 1)), order if drift else order[:, :0], c - middle])
        gram = np.linalg.pinv(X.T @ X)
        B = gram @ X.T @ Z
        residual, dof = Z - X @ B, max(n - float(X.shape[1]), 1.0)
        left = residual.T @ residual / dof
        # recordings of one window say nothing of the shape: no feature then goes with another
        shape = within if np.trace(within) > 0.0 else np.eye(len(centre))
        ratio = float(np.trace(left) / np.trace(shape))
        S = (dof * left + PRIOR_DEGREES * ratio * shape) / (dof + PRIOR_DEGREES)
        moved = n * B[1] if drift else np.zeros(len(centre))
        ahead = np.array([1.0, *([n] if drift else []), *np.zeros(c.shape[1])])
        slopes = B[X.shape[1] - c.shape[1] :]
        return cls(group, centre, scale, slopes, middle, gram, ahead, S, np.outer(moved, moved), within)

    def predicted(self, covariates: FloatArray) -> FloatArray:
        """Return C for as many windows as the healthy recordings hold, at some covariates, in the scale."""
        x = self.ahead.copy()
        x[len(x) - len(self.middle) :] = covariates[: len(self.middle)] - self.middle
        return np.asarray(self.between * (1.0 + x @ self.gram @ x) + self.drift + 1e-9 * np.eye(len(self.centre)))

    def expected(self, covariates: FloatArray) -> FloatArray:
        """Return the features of a healthy recording at some covariates, shape (k,)."""
        off = (covariates[: len(self.middle)] - self.middle) @ self.slopes
        return np.asarray(self.centre + self.scale * off)

    def at(self, covariates: FloatArray) -> FeatureGroup:
        """Return the group as if all healthy recordings had been at some covariates."""
        if self.group.past:
            return self.group
        moved = (np.array(self.group.covariates) - covariates) @ self.slopes * self.scale
        return self.group.model_copy(update={"means": to_tuples(np.array(self.group.means) - moved), "covariates": ()})

    def deviations(self, values: FloatArray, covariates: FloatArray = NO_COVARIATES) -> FloatArray:
        """Return how far off each of the group's features is, in standard deviations between recordings."""
        spread = self.scale * np.sqrt(np.diag(self.predicted(covariates)))
        return np.asarray((values - self.expected(covariates)) / spread)

    def of_span(self, span: SpanFeatures) -> float:
        """Return T^2/d of the group's features in a span."""
        return self.score(*self.group.pick(span), span.covariates)

    def score(self, values: FloatArray, windows: float, covariates: FloatArray = NO_COVARIATES) -> float:
        """Return T^2/d of features (k,) that are the mean of some windows; 0 where none of them was seen."""
        z = (values - self.expected(covariates)) / self.scale
        seen = np.isfinite(z)
        if not seen.any() or not windows > 0.0:
            return 0.0
        C = self.predicted(covariates) + self.within * max(1.0 / windows - 1.0 / self.group.windows, 0.0)
        return float(z[seen] @ np.linalg.solve(C[np.ix_(seen, seen)], z[seen])) / int(seen.sum())


def is_near(learned: FloatArray, covariates: FloatArray) -> bool:
    """Return whether covariates (k,) are within the range of learned ones (n, k), or next to it."""
    edge = EDGE_SHARE * np.ptp(learned, axis=0)  # beyond the range, the limit widens with the distance
    return bool(((covariates >= learned.min(axis=0) - edge) & (covariates <= learned.max(axis=0) + edge)).all())


def span_scores(statistics: Sequence[GroupStatistic], span: SpanFeatures) -> tuple[float, float]:
    """Return the score of a span against healthy recordings, and of its later windows against its earlier ones."""
    scores = np.array([statistic.of_span(span) for statistic in statistics])
    past = np.array([statistic.group.past for statistic in statistics], dtype=np.bool_)
    now, later = (
        float(np.mean(part[part > 0.0] ** SCORE_POWER)) ** (1.0 / SCORE_POWER) if (part > 0.0).any() else 0.0
        for part in (scores[~past], scores[past])
    )
    return now, later


def shrink(S: FloatArray, degrees: int) -> FloatArray:
    """Shrink a covariance matrix towards a multiple of the identity (oracle approximating shrinkage)."""
    p, n = len(S), max(degrees, 1)
    mean, square = float(np.trace(S)) / p, float((S**2).mean())
    spread = (n + 1.0) * (square - mean**2 / p)
    weight = min((square + mean**2) / spread, 1.0) if spread > 0.0 else 1.0
    return (1.0 - weight) * S + weight * mean * np.eye(p)


def fit_groups(
    recordings: Sequence[Sequence[Window]],
    spans: Sequence[Sequence[SpanFeatures]],
    layout: FeatureLayout,
    covariates: Matrix = (),
) -> tuple[FeatureGroup, ...]:
    """Return the groups of features of healthy recordings, each given by its windows, spans and covariates."""
    means = np.array([SpanFeatures.of(windows, layout).values for windows in recordings])
    groups = []
    for level in range(layout.levels):
        rows = [np.array([w.features for w in windows if w.level == level]) for windows in recordings]
        if not all(len(row) for row in rows):
            continue
        for part in layout.groups:
            columns = np.arange(layout.size)[part]
            kept = columns[np.isfinite(means[:, level, part]).all(axis=0)]
            if not len(kept):
                continue
            M = means[:, level, kept]
            apart = np.concatenate([row[:, kept] - mean for row, mean in zip(rows, M, strict=True)])
            apart = np.where(np.isfinite(apart), apart, 0.0)
            degrees = max(len(apart) - len(M), 1)
            group = FeatureGroup(
                level=level,
                kept=tuple(kept.tolist()),
                means=to_tuples(M),
                within=to_tuples(apart.T @ apart / degrees),
                degrees=degrees,
                windows=len(apart) / len(M),
                covariates=covariates,
            )
            groups.append(group)
            if (past := _own_past(group, spans)) is not None:
                groups.append(past)
    return tuple(groups)


def _own_past(group: FeatureGroup, spans: Sequence[Sequence[SpanFeatures]]) -> FeatureGroup | None:
    """Return the group of the same features, later windows less earlier ones; None where recordings show none."""
    past = group.model_copy(update={"past": True, "covariates": ()})
    picked = [[past.pick(span) for span in span_features if span.shift.size] for span_features in spans]
    if not all(picked):
        return None
    means = np.array([np.mean([values for values, _ in windows], axis=0) for windows in picked])
    worth = float(np.mean([sum(count for _, count in windows) for windows in picked]))
    if not np.isfinite(means).all() or not worth > 0.0:
        return None
    return past.model_copy(update={"means": to_tuples(means), "windows": worth})


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
