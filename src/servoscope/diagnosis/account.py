"""The joint account: what all judges of a recording say, and one limit for the strongest of them.

Judges that healthy recordings of their own have scored, each learned without it, say ``-ln p`` of a recording's score
by the distribution of those (`score_evidence`). The largest evidence of a recording that was left out, by the others,
raises the limit for all. A judge whose healthy scores nobody knows, as with fewer than four recordings, counts from its
own limit on: by the share of false alarms that this has.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.threshold import (
    MIN_SCORE,
    NARROW_PRIOR,
    SECONDS_PER_YEAR,
    WIDE_PRIOR,
    ScorePrior,
    robust_limit,
    score_evidence,
    t2_threshold,
)
from servoscope.core.verdict import JudgeEvidence, Verdict, VerdictKind, decide, evidence_limit, joint_evidence
from servoscope.evidence.examination import Examination
from servoscope.evidence.features import PAST_BUDGET

MIN_RECORDINGS = 4  # whose scores, each learned without it, are believed


class HealthyScores(NamedTuple):
    """The scores of healthy recordings by one judge, each learned without it; none: they are not known."""

    left_out: Sequence[float]
    prior: ScorePrior

    def evidence(self, score: float) -> float:
        """Return the evidence of a further recording."""
        return score_evidence(score, self.left_out, self.prior)

    def limit(self, nats: float) -> float:
        """Return the score whose evidence is so much."""
        return robust_limit(self.left_out, float(np.exp(-nats)), self.prior)

    @property
    def largest(self) -> float:
        """The largest evidence of a recording by the scores of the others."""
        every = list(self.left_out)
        return max(score_evidence(x, every[:i] + every[i + 1 :], self.prior) for i, x in enumerate(every))


class Account:
    """The judges of one baseline, and the limit of their joint evidence."""

    def __init__(self, baseline: Baseline) -> None:
        self.baseline = baseline

    @cached_property
    def coefficients(self) -> HealthyScores | None:
        """Of T^2, where recordings scatter: noise alone has the distribution that its limit is made for."""
        scores = [ratio * self.baseline.thresholds.statistic for ratio in self.baseline.scatter.left_out]
        # a recording left out at an end of the range of covariates is extrapolated to, and scores far too much
        between = self.baseline.covariates is None and not self.baseline.thresholds.hypotheses
        known = between and len(scores) >= MIN_RECORDINGS
        return HealthyScores(scores, WIDE_PRIOR) if known else None

    @cached_property
    def features(self) -> HealthyScores | None:
        """Of the features."""
        model = self.baseline.features
        if model is None or len(model.left_out) < MIN_RECORDINGS:
            return None
        return HealthyScores(model.left_out, WIDE_PRIOR if model.covariates else NARROW_PRIOR)

    @property
    def _known(self) -> list[HealthyScores]:
        return [scores for scores in (self.coefficients, self.features) if scores is not None]

    @cached_property
    def judges(self) -> int:
        """How many share the false alarms."""
        known = self.baseline
        models = known.features, known.axis, known.residual, known.pressures, known.thresholds.hypotheses or None
        return 1 + sum(model is not None for model in models)

    @property
    def share(self) -> float:
        """What the evidence of each costs, because there are several [nats]."""
        return float(np.log(self.judges))

    @property
    def recordings(self) -> int:
        """How many were left out."""
        return max((len(scores.left_out) for scores in self._known), default=0)

    @cached_property
    def limit(self) -> float:
        """The limit of the joint evidence [nats]."""
        known = self._known
        if not known:
            return evidence_limit([])
        largest = max(scores.largest for scores in known) - self.share
        return evidence_limit([largest] * self.recordings)

    def shared(self, duration_s: float) -> Baseline:
        """Return the baseline with the limits of its judges where the joint evidence of a recording has its own."""
        baseline, nats, update = self.baseline, self.limit + self.share, dict[str, object]()
        if self.coefficients is not None:
            thresholds, scatter = baseline.thresholds, baseline.scatter
            limit = self.coefficients.limit(nats + self._looks(duration_s))
            left_out = tuple(score / limit for score in self.coefficients.left_out)
            update["thresholds"] = thresholds.model_copy(update={"statistic": limit})
            update["scatter"] = scatter.model_copy(update={"left_out": left_out})
        if self.features is not None and (model := baseline.features) is not None:
            limit = self.features.limit(nats)
            past = model.past_limit * limit / model.limit
            update["features"] = model.model_copy(update={"limit": limit, "past_limit": past})
        return baseline.model_copy(update=update) if update else baseline

    @property
    def _limit_of_year(self) -> float:
        """T^2 that noise alone exceeds as often in a year as the budget of false alarms allows."""
        known = self.baseline.thresholds
        tests = bool(known.hypotheses), self.baseline.features is not None
        return t2_threshold(self.baseline.loop, len(self.baseline.names), known.dof, known.calibration, *tests)

    def _looks(self, duration_s: float) -> float:
        """Return what it costs that T^2 is looked at for longer than in the recordings learned from [nats]."""
        learned = float(np.mean([source.duration_s for source in self.baseline.sources]))
        return float(np.log(max(duration_s / learned, 1.0)))

    def verdict(self, exam: Examination, before: VerdictKind = "undetermined", *, inside: bool = False) -> Verdict:
        """Return the verdict on an examination; `inside`: whether it is known that a change came within it."""
        told = joint_evidence(self._judges(exam), self.judges)
        return decide(told._replace(inside=told.inside or inside), self.limit, self.recordings, before)

    def _judges(self, exam: Examination) -> Iterator[JudgeEvidence]:
        """Yield what each judge says of an examination, of what the baseline shares the false alarms among."""
        T2, level = (float(statistic.value.max(where=exam.ready, initial=0.0)) for statistic in exam.statistics[:2])
        duration_s, limit = exam.recording.duration_s, self._limit_of_year
        yearly = self.baseline.loop.monitor.false_alarms_per_year
        rare = -float(np.log(min(yearly * duration_s / SECONDS_PER_YEAR, 1.0)))
        if self.coefficients is not None:
            yield JudgeEvidence("coefficients", self.coefficients.evidence(T2) - self._looks(duration_s))
        if limit < T2:  # beyond its own limit: the tail of a chi-square, whose logarithm falls with half of T^2
            yield JudgeEvidence("coefficients", rare + (T2 - limit) / 2.0)
        if level >= 1.0:  # the likelihood ratio of a test that exceeds a level falls exponentially with it
            yield JudgeEvidence("sequential", rare * level)
        if self.features is not None and exam.features is not None and (model := exam.baseline.features) is not None:
            score = float(exam.features.values.max(initial=0.0)) * model.limit
            yield JudgeEvidence("features", self.features.evidence(score))
        yield from self._of_limits(exam)

    def _of_limits(self, exam: Examination) -> Iterator[JudgeEvidence]:
        """Yield what judges say that are known by their limit alone, which a share of healthy recordings exceeds."""
        share = self.baseline.loop.monitor.feature_false_alarms
        names = zip(("residual", "shift", "fit"), exam.residual_ratios.tolist(), (1.0, PAST_BUDGET, 1.0), strict=True)
        excesses = [(name, ratio, part) for name, ratio, part in names if np.isfinite(ratio)]
        if exam.pressures is not None:
            excesses.append(("pressures", exam.pressures.excess**2, 1.0))  # of a deviation; the others are of squares
        for name, ratio, part in excesses:
            yield JudgeEvidence(name, limit_evidence(ratio, part * share, len(self.baseline.sources)))
        if (change := exam.change) is not None:
            # scatter between recordings, which raises the limit, is none within one
            raised = self.limit - evidence_limit([])
            yield JudgeEvidence("change", raised + change.nats, change.segments, inside=True)


def limit_evidence(excess: float, false_alarms: float, recordings: int) -> float:
    """Return the evidence of a score that is so many times a limit that a share of healthy recordings exceeds [nats].

    The scatter of the score's logarithm over so many recordings is taken for what is expected of it.
    """
    from scipy import special

    dof, std = recordings - 1.0 + WIDE_PRIOR.degrees, WIDE_PRIOR.std * np.sqrt(1.0 + 1.0 / recordings)
    t = special.stdtrit(dof, 1.0 - false_alarms) + np.log(max(excess, MIN_SCORE)) / std
    return -float(np.log(max(special.stdtr(dof, -t), np.finfo(np.float64).tiny)))
