"""Healthy minutes simulated to count false alarms: how often both tests pass levels that can be counted.

Theory gives the shape of the tail, and the number of independent looks behind it up to a factor that depends on how
the reference moves: a machine that rests half of the time looks less often, and neighbouring CUSUMs alarm together.
The factor is counted where alarms are frequent, and holds where they are rare.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.messages import Message, message
from servoscope.detection.chi2_test import SECONDS_PER_YEAR, apply_alarm_delays, t2_statistic, threshold
from servoscope.detection.cusum_design import CusumHypothesis, build_cusum_constants, choose_cusum_hypotheses
from servoscope.detection.expectation import Expectation, ReferencePath
from servoscope.estimation.noise_model import WhiteNoise
from servoscope.models.loop import Loop
from servoscope.models.plants import Plant
from servoscope.signals import Recording
from servoscope.simulation import simulate

SAMPLES = 120_000  # as many as a third of a second simulates
MOST_SAMPLES = 1_200_000
MEMORIES = 240.0  # or delays of the alarm, that a rehearsal lasts if it can
FEW = 10.0  # alarms: fewer are not believed where they would lower a limit
COUNTED = 30.0  # alarms that theory expects among them
SEED = 20
REHEARSALS = (
    4  # where the sequential test steps once per evaluation: one alone leaves its limits off by a third in rate
)
UNLIKELY = 1e-3  # chance of an alarm during the healthy recordings from which noise is not believed to raise it
FEATURES = 0.1  # share of the budget of false alarms that is the features', where there are any
SEQUENTIAL = 0.5  # share of the budget of false alarms that is the sequential test's


@dataclass(frozen=True)
class CalibrationFactors:
    """Alarms that were counted, divided by those that theory expects: of T^2 and of the CUSUMs."""

    statistic: float = 1.0
    cusum: float = 1.0

    def sequential_budget(self, loop: Loop) -> float:
        """Return how many false alarms per year of a loop theory may expect of the CUSUMs."""
        return SEQUENTIAL * loop.monitor.false_alarms_per_year / self.cusum


def t2_threshold(
    loop: Loop, n: int, dof: float, calibration: CalibrationFactors, sequential: bool, features: bool = False
) -> float:
    """Return the threshold of T^2 for its share of the loop's budget: what sequential test and features leave of it."""
    monitor = loop.monitor
    share = 1.0 - (SEQUENTIAL if sequential else 0.0) - (FEATURES if features else 0.0)
    budget = monitor.false_alarms_per_year * share
    return threshold(n, monitor.evaluation_rate, monitor.memory, budget, dof, calibration.statistic)


def calibrate_thresholds(
    expectation: Expectation, plant: Plant, noise: WhiteNoise, hypotheses: Sequence[CusumHypothesis]
) -> CalibrationFactors:
    """Simulate the healthy loop under a baseline's reference, repeated, and count."""
    pipeline, tuning = expectation.pipeline, expectation.tuning
    loop = pipeline.loop.model_copy(update={"plant": plant})
    off = pipeline.delays[1] * pipeline.every / loop.sample_rate
    wanted = max(SAMPLES, round(MEMORIES * max(loop.monitor.memory, off) * loop.sample_rate))
    samples = min(wanted, MOST_SAMPLES)
    counted = COUNTED * samples / wanted
    budget = counted * SECONDS_PER_YEAR * loop.sample_rate / samples
    r = np.resize(expectation.reference.r, samples)
    certain = [replace(member, drift=0.0) for member in hypotheses]
    test = build_cusum_constants(pipeline, plant, noise, tuning.scale, certain, budget) if certain else None
    monitor = loop.monitor
    limit = threshold(len(tuning.theta), monitor.evaluation_rate, monitor.memory, budget, np.inf)
    whole = replace(expectation, noise=noise, reference=ReferencePath(r, np.arange(samples), np.zeros(samples, bool)))
    expected = whole.mean_path(tuning.theta, plant)
    rehearsals = REHEARSALS if pipeline.cusum_updates > 1 else 1
    events = np.zeros(2)
    for seed in range(SEED, SEED + rehearsals):
        recording, _ = simulate(loop, r, noise_u_std=noise.u_std, noise_y_std=noise.y_std, seed=seed)
        e = pipeline.estimate(tuning, recording, test)
        ready = e.updates > pipeline.memory
        T2 = np.where(
            ready, t2_statistic(e.theta, expected, np.where(ready[:, None, None], e.S, np.eye(len(tuning.theta)))), 0.0
        )
        alarms = (apply_alarm_delays(each, *pipeline.delays) for each in (limit < T2, e.level >= 1.0))
        events += [int((np.diff(alarm.astype(np.int8)) == 1).sum()) for alarm in alarms]
    return CalibrationFactors(*(_share(float(each), counted * rehearsals) for each in events))


def design_sequential_test(
    recordings: Sequence[Recording],
    expectations: Sequence[Expectation],
    plant: Plant,
    theta: FloatArray,
    covariance: FloatArray,
    largest_noise: WhiteNoise,
) -> tuple[CalibrationFactors, tuple[CusumHypothesis, ...], list[Message]]:
    """Design the sequential test and rehearse it; return what was counted, the test, and what the user should know.

    There is no test where it would have raised an alarm on the healthy recordings themselves.
    """
    tuning = expectations[0].tuning
    first = replace(expectations[0], tuning=replace(tuning, theta=theta))
    if not plant.linear:  # what runs beside the loop is a linear one
        return CalibrationFactors(), (), [message("learning.no_cusum_nonlinear")]
    hypotheses = choose_cusum_hypotheses(first, plant, largest_noise, covariance)
    calibration = calibrate_thresholds(first, plant, largest_noise, hypotheses)
    if not hypotheses:
        return calibration, (), [message("learning.no_cusum_short")]
    pipeline = first.pipeline
    # the recordings are short: they speak where an alarm during them would have a chance of one in a thousand
    years = sum(rec.duration_s for rec in recordings) / SECONDS_PER_YEAR
    budget = max(SEQUENTIAL * pipeline.loop.monitor.false_alarms_per_year, UNLIKELY / years) / calibration.cusum
    test = build_cusum_constants(pipeline, plant, largest_noise, tuning.scale, hypotheses, budget)
    highest = max(float(pipeline.estimate(tuning, rec, test).level.max(initial=0.0)) for rec in recordings)
    if test is None or highest >= 1.0:
        reason = message("learning.cusum_residual" if test else "learning.cusum_short")
        return calibration, (), [message("learning.cusum_left_out", reason=reason)]
    return calibration, hypotheses, []


def _share(events: float, expected: float) -> float:
    """Return events against those expected, none counting as a half."""
    share = float((events + 0.5) / (expected + 0.5))
    return share if expected >= FEW else max(share, 1.0)
