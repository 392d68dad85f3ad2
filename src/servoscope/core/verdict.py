"""The verdict on a recording: what every judge returns, the limit of their evidence, and the rule that decides.

Evidence is a log Bayes factor against healthy [nats], or what is calibrated like one: ``-ln p`` of a statistic. Its
limit follows from healthy recordings that were left out, with everything learned again. A further healthy recording is
above n exchangeable ones with a probability of at most 1/(n + 1) (Vovk, Gammerman, Shafer, 2005); beyond, the model
counts.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal, NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.messages import Message

VerdictKind = Literal["healthy", "suspect", "fault", "undetermined"]

FOUND: tuple[VerdictKind, ...] = ("suspect", "fault")
FALSE_ALARMS = 0.01  # share of healthy recordings that may be called suspect
NORMAL_95 = 1.959963984540054  # of the normal distribution, 97.5 % below it
SURE_LIMITS = 3.0  # limits from which one recording alone is a fault


class Explanation(NamedTuple):
    """A set of causes that explains a change; none: an unknown one."""

    causes: tuple[str, ...]
    log_odds: float  # against all others
    sizes: FloatArray  # logarithms of the ratios of its parameters, shape (k,)
    covariance: FloatArray  # of `sizes`, (k, k)
    text: Message | None = None
    alike: tuple[Explanation, ...] = ()  # other sets that move the same coefficients: no recording tells which it is

    @property
    def probability(self) -> float:
        """The probability of this set, or of one that is alike."""
        return float(1.0 / (1.0 + np.exp(-np.clip(self.log_odds, -700.0, 700.0))))

    @property
    def ratios(self) -> dict[str, tuple[float, float, float]]:
        """The ratio of each cause's parameter to its healthy value, with its 95 % interval: low, likely, high."""
        std = np.sqrt(np.diag(self.covariance).clip(0.0))
        ends = np.exp(self.sizes[:, None] + NORMAL_95 * std[:, None] * np.array([-1.0, 0.0, 1.0]))
        return {
            cause: (low, likely, high) for cause, (low, likely, high) in zip(self.causes, ends.tolist(), strict=True)
        }


class Segment(NamedTuple):
    """A part of a recording between two changes; times are lower end, most likely and upper end [s]."""

    begin_s: tuple[float, float, float]
    end_s: tuple[float, float, float]
    changed: bool
    deviation: FloatArray  # of the coefficients from healthy ones, shape (p,); of no element where there are none
    covariance: FloatArray  # (p, p)
    explanations: tuple[Explanation, ...] = ()  # the likeliest first


class JudgeEvidence(NamedTuple):
    """What one judge says of a recording."""

    judge: str
    nats: float  # against healthy
    segments: tuple[Segment, ...] = ()  # in order; none: it speaks of the whole recording
    inside: bool = False  # whether the recording changed within itself, which scatter between recordings does not do


class Verdict(NamedTuple):
    """What all judges together say of a recording."""

    kind: VerdictKind
    evidence: float  # against healthy [nats]
    limit: float  # of the evidence
    recordings: int = 0  # n that were left out behind the limit
    segments: tuple[Segment, ...] = ()
    inside: bool = False

    @property
    def excess(self) -> float:
        """The evidence over its limit."""
        return self.evidence / self.limit

    @property
    def guaranteed(self) -> float:
        """Share of healthy recordings that look like this, whatever their distribution: at most 1/(n + 1)."""
        return 1.0 / (self.recordings + 1.0)

    @property
    def by_model(self) -> float:
        """Share of healthy recordings that look like this if the model holds beyond the recordings left out."""
        learned = self.limit + float(np.log(FALSE_ALARMS))  # what left-out recordings have raised the limit by
        return float(np.exp(-np.clip(self.evidence - max(learned, 0.0), 0.0, 700.0)))


def evidence_limit(left_out: Sequence[float], false_alarms: float = FALSE_ALARMS) -> float:
    """Return the limit of the evidence: ``max(ln 1/alpha, largest left out + ln 1/(alpha (n + 1)))`` [nats]."""
    least = -float(np.log(false_alarms))
    if not len(left_out):
        return least
    return max(least, max(left_out) - float(np.log(false_alarms * (len(left_out) + 1.0))))


def joint_evidence(told: Iterable[JudgeEvidence], judges: int) -> JudgeEvidence:
    """Return the strongest evidence, less what it costs that it may come from each of several judges.

    Each has its share of the false alarms (Bonferroni): at most so many times as often is one of them above a limit.
    """
    strongest = max(told, key=lambda evidence: evidence.nats, default=JudgeEvidence("", 0.0))
    return strongest._replace(nats=strongest.nats - float(np.log(judges)))


def decide(evidence: JudgeEvidence, limit: float, recordings: int = 0, before: VerdictKind = "undetermined") -> Verdict:
    """Return the verdict on a recording: suspect above the limit, and fault if that is sure.

    It is sure with a change inside the recording, at `SURE_LIMITS` times the limit, and after another recording that
    was above the limit (`before`: the verdict on the recording before).
    """
    kind: VerdictKind = "healthy"
    if evidence.nats > limit:
        sure = evidence.inside or evidence.nats > SURE_LIMITS * limit or before in FOUND
        kind = "fault" if sure else "suspect"
    return Verdict(kind, evidence.nats, limit, recordings, evidence.segments, evidence.inside)
