"""The threshold of T^2 and the shares of the tests in the budget of false alarms."""

from __future__ import annotations

from dataclasses import dataclass

from servoscope.models.loop import Loop

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
    rest = dof - n + 1.0
    limit = 10.0
    for _ in range(20):
        looks = counted * SECONDS_PER_YEAR * min(evaluation_rate, max(limit / (2.0 * memory), 1.0 / memory))
        tail = min(false_alarms_per_year / looks, 0.5)
        share = float(special.betaincinv(rest / 2.0, n / 2.0, tail))  # upper quantile of F(n, rest) through the beta's
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
