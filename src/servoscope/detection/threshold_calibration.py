"""Healthy minutes simulated to count false alarms: how often both tests pass levels that can be counted.

Theory gives the shape of the tail, and the number of independent looks behind it up to a factor that depends on how
the reference moves: a machine that rests half of the time looks less often, and neighbouring CUSUMs alarm together.
The factor is counted where alarms are frequent, and holds where they are rare.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from servoscope.baseline.expectation import Expectation, ReferencePath
from servoscope.baseline.hypothesis import CusumHypothesis
from servoscope.baseline.threshold import SECONDS_PER_YEAR, SEQUENTIAL_SHARE, CalibrationFactors, threshold
from servoscope.core.arrays import FloatArray
from servoscope.core.messages import Message, message
from servoscope.detection.cusum_design import build_cusum_constants, choose_cusum_hypotheses
from servoscope.detection.statistic import apply_alarm_delays, t2_statistic
from servoscope.estimation.noise_model import WhiteNoise
from servoscope.models.plants import Plant
from servoscope.signals import Recording
from servoscope.simulation import simulate

SAMPLES = 120_000  # as many as a third of a second simulates
MAX_SAMPLES = 1_200_000
MEMORIES = 240.0  # or delays of the alarm, that a rehearsal lasts if it can
MIN_ALARMS = 10.0  # alarms: fewer are not believed where they would lower a limit
EXPECTED_ALARMS = 30.0  # alarms that theory expects among them
SEED = 20
# where the sequential test steps once per evaluation: one alone leaves its limits off by a third in rate
REHEARSALS = 4
MIN_ALARM_CHANCE = 1e-3  # chance of an alarm during the healthy recordings from which noise is not believed to raise it


def calibrate_thresholds(
    expectation: Expectation, plant: Plant, noise: WhiteNoise, hypotheses: Sequence[CusumHypothesis]
) -> CalibrationFactors:
    """Simulate the healthy loop under a baseline's reference, repeated, and count."""
    pipeline, tuning = expectation.pipeline, expectation.tuning
    loop = pipeline.loop.model_copy(update={"plant": plant})
    off = pipeline.delays[1] * pipeline.every / loop.sample_rate
    wanted = max(SAMPLES, round(MEMORIES * max(loop.monitor.memory, off) * loop.sample_rate))
    samples = min(wanted, MAX_SAMPLES)
    counted = EXPECTED_ALARMS * samples / wanted
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
        alarms = (apply_alarm_delays(exceeded, *pipeline.delays) for exceeded in (limit < T2, e.level >= 1.0))
        events += [int((np.diff(alarm.astype(np.int8)) == 1).sum()) for alarm in alarms]
    return CalibrationFactors(*(_share(float(event), counted * rehearsals) for event in events))


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
    budget = (
        max(SEQUENTIAL_SHARE * pipeline.loop.monitor.false_alarms_per_year, MIN_ALARM_CHANCE / years)
        / calibration.cusum
    )
    test = build_cusum_constants(pipeline, plant, largest_noise, tuning.scale, hypotheses, budget)
    highest = max(float(pipeline.estimate(tuning, rec, test).level.max(initial=0.0)) for rec in recordings)
    if test is None or highest >= 1.0:
        reason = message("learning.cusum_residual" if test else "learning.cusum_short")
        return calibration, (), [message("learning.cusum_left_out", reason=reason)]
    return calibration, hypotheses, []


def _share(events: float, expected: float) -> float:
    """Return events against those expected, none counting as a half."""
    share = float((events + 0.5) / (expected + 0.5))
    return share if expected >= MIN_ALARMS else max(share, 1.0)
