"""The thresholds of T^2 and of scores, and the shares of the tests in the budget of false alarms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.models.loop import Loop

MAX_SCORE_STDS = 1.345  # expected deviations of a logarithm from their mean; beyond, it counts as that (Huber, 1964)
SCORE_CONSISTENCY = 1.41  # 1 over the share of a normal variance that this leaves
MIN_SCORE = 1e-9  # of which a logarithm is taken
HUBER_ROUNDS = 30  # after which the mean does not move any more
SECONDS_PER_YEAR = 365.25 * 86400.0
FEATURE_SHARE = 0.1  # of the budget of false alarms, where there are features
SEQUENTIAL_SHARE = 0.5  # of the budget of false alarms, where there is a sequential test


@dataclass(frozen=True)
class CalibrationFactors:
    """Alarms that were counted, divided by those that theory expects: of T^2 and of the CUSUMs."""

    statistic: float = 1.0
    cusum: float = 1.0

    def sequential_budget(self, loop: Loop) -> float:
        """Return how many false alarms per year of a loop theory may expect of the CUSUMs."""
        return SEQUENTIAL_SHARE * loop.monitor.false_alarms_per_year / self.cusum


def threshold(
    n: int, evaluation_rate: float, memory: float, false_alarms_per_year: float, dof: float, counted: float = 1.0
) -> float:
    """Return the limit of T^2 that a healthy loop crosses as often as the budget allows.

    theta_hat forgets within `memory`, so looks close together are one look; how close depends on the level: an
    Ornstein-Uhlenbeck process stays above a high level only for a time of the order of memory / level (Aldous, 1989,
    section D). Simulated healthy loops show level / (2 memory) looks per second. The noise's variance is itself
    estimated, so T^2 follows Hotelling's distribution rather than a chi-square.

    `evaluation_rate`: evaluations per second [Hz]; `memory`: of the estimator [s]; `dof`: effective number of
    independent values behind the noise's variance; `counted`: alarms that a simulation counted (see
    `servoscope.detection.threshold_calibration`), divided by those that this rule expects.
    """
    from scipy import special  # not scipy.stats: half a second to import

    dof = min(max(dof, n + 2.0), 1e9)
    remaining_dof = dof - n + 1.0
    limit = 10.0
    for _ in range(20):
        looks = counted * SECONDS_PER_YEAR * min(evaluation_rate, max(limit / (2.0 * memory), 1.0 / memory))
        tail = min(false_alarms_per_year / looks, 0.5)
        # upper quantile of F(n, remaining_dof) through the beta's
        share = float(special.betaincinv(remaining_dof / 2.0, n / 2.0, tail))
        limit = dof * (1.0 - share) / share
    return limit


def t2_threshold(
    loop: Loop, n: int, dof: float, calibration: CalibrationFactors, sequential: bool, features: bool = False
) -> float:
    """Return the threshold of T^2 for its share of the loop's budget: what sequential test and features leave of it."""
    monitor = loop.monitor
    share = 1.0 - (SEQUENTIAL_SHARE if sequential else 0.0) - (FEATURE_SHARE if features else 0.0)
    budget = monitor.false_alarms_per_year * share
    return threshold(n, monitor.evaluation_rate, monitor.memory, budget, dof, calibration.statistic)


class ScorePrior(NamedTuple):
    """What is expected of the logarithms of healthy scores before any was seen."""

    std: float
    degrees: float  # of freedom


WIDE_PRIOR = ScorePrior(0.5, 8.0)
NARROW_PRIOR = ScorePrior(0.45, 20.0)  # that of F with 12 and 30 degrees: of features that no covariate moves


def score_limit(left_out: Sequence[float], false_alarms: float, prior: ScorePrior = WIDE_PRIOR) -> float:
    """Return the score that a further healthy recording exceeds with a probability, by a log-normal distribution.

    Student's t for one more value beyond n, whose variance is shrunk to what is expected of such scores. A larger score
    among those left out is the limit instead.
    """
    return max(robust_limit(left_out, false_alarms, prior), *left_out)


def robust_limit(left_out: Sequence[float], false_alarms: float, prior: ScorePrior = WIDE_PRIOR) -> float:
    """Return what `score_limit` does, without the largest score: one that exceeds it is an outlier."""
    from scipy import special

    mean, _ = _robust_mean(left_out, prior)
    quantile = float(special.stdtrit(len(left_out) - 1.0 + prior.degrees, 1.0 - false_alarms))
    return float(np.exp(mean + quantile * score_std(left_out, prior)))


def score_evidence(score: float, left_out: Sequence[float], prior: ScorePrior = WIDE_PRIOR) -> float:
    """Return the evidence of a recording's score against healthy [nats]: ``-ln p``, distributed as in `score_limit`.

    Few healthy recordings allow little: p has the tail of Student's t.
    """
    from scipy import special

    mean, _ = _robust_mean(left_out, prior)
    t = (float(np.log(max(score, MIN_SCORE))) - mean) / score_std(left_out, prior)
    return -float(np.log(max(special.stdtr(len(left_out) - 1.0 + prior.degrees, -t), np.finfo(np.float64).tiny)))


def score_std(left_out: Sequence[float], prior: ScorePrior = WIDE_PRIOR) -> float:
    """Return the standard deviation of the logarithm of a further healthy recording's score around their mean."""
    n = len(left_out)
    own = SCORE_CONSISTENCY * float((_robust_mean(left_out, prior)[1] ** 2).sum())
    variance = (own + prior.degrees * prior.std**2) / (n - 1.0 + prior.degrees)
    return float(np.sqrt(variance * (1.0 + 1.0 / n)))


def _robust_mean(left_out: Sequence[float], prior: ScorePrior) -> tuple[float, FloatArray]:
    """Return the mean of the logarithms of scores, and their deviations from it; one far off counts as one less so."""
    logs, most = np.log(np.maximum(left_out, MIN_SCORE)), MAX_SCORE_STDS * prior.std
    mean = float(np.median(logs))
    for _ in range(HUBER_ROUNDS):
        mean += float(np.clip(logs - mean, -most, most).mean())
    return mean, np.clip(logs - mean, -most, most)
