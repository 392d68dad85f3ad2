"""Healthy minutes simulated to count false alarms: how often both tests pass levels that can be counted.

Theory gives the shape of the tail, and the number of independent looks behind it up to a factor that depends on how
the reference moves: a machine that rests half of the time looks less often, and neighbouring CUSUMs alarm together.
The factor is counted where alarms are frequent, and holds where they are rare.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from servoscope.detection import SECONDS_PER_YEAR, delayed, statistic, threshold
from servoscope.loop import Loop
from servoscope.noise import Noise
from servoscope.plants import FloatArray, Plant
from servoscope.recording import Recording
from servoscope.sequential import Member, members, watch
from servoscope.signatures import Course, Expectation
from servoscope.simulation import simulate

SAMPLES = 120_000  # as many as a third of a second simulates
MOST_SAMPLES = 1_200_000
MEMORIES = 240.0  # or delays of the alarm, that a rehearsal lasts if it can
FEW = 10.0  # alarms: fewer are not believed where they would lower a limit
COUNTED = 30.0  # alarms that theory expects among them
SEED = 20
UNLIKELY = 1e-3  # chance of an alarm during the healthy recordings from which noise is not believed to raise it
SEQUENTIAL = 0.5  # share of the budget of false alarms that is the sequential test's


@dataclass(frozen=True)
class Rehearsed:
    """Alarms that were counted, divided by those that theory expects: of T^2 and of the CUSUMs."""

    statistic: float = 1.0
    cusum: float = 1.0


def limit_of(loop: Loop, n: int, dof: float, rehearsed: Rehearsed, sequential: bool) -> float:
    """Return the threshold of T^2 for its share of the loop's budget; without a sequential test that is all of it."""
    monitor = loop.monitor
    budget = monitor.false_alarms_per_year * (1.0 - SEQUENTIAL if sequential else 1.0)
    return threshold(n, monitor.evaluation_rate, monitor.memory, budget, dof, rehearsed.statistic)


def rehearse(expectation: Expectation, plant: Plant, noise: Noise, chosen: Sequence[Member]) -> Rehearsed:
    """Simulate the healthy loop under a baseline's reference, repeated, and count.

    Parameters
    ----------
    expectation
        Of a healthy recording.
    plant
        The healthy plant.
    noise
        Of the loop.
    chosen
        The sequential test; an error of the baseline plays no part in it.
    """
    pipeline, tuning = expectation.pipeline, expectation.tuning
    loop = pipeline.loop.model_copy(update={"plant": plant})
    off = pipeline.delays[1] * pipeline.every / loop.sample_rate
    wanted = max(SAMPLES, round(MEMORIES * max(loop.monitor.memory, off) * loop.sample_rate))
    samples = min(wanted, MOST_SAMPLES)
    counted = COUNTED * samples / wanted
    budget = counted * SECONDS_PER_YEAR * loop.sample_rate / samples
    r = np.resize(expectation.course.r, samples)
    recording, _ = simulate(loop, r, noise_u_std=noise.u_std, noise_y_std=noise.y_std, seed=SEED)
    certain = [replace(member, drift=0.0) for member in chosen]
    test = watch(pipeline, plant, noise, tuning.scale, certain, budget) if certain else None
    e = pipeline.estimate(tuning, recording, test)
    whole = replace(expectation, noise=noise, course=Course(r, np.arange(samples), recording.restart))
    expected = whole.path(tuning.theta, plant)
    ready = e.updates > pipeline.memory
    T2 = np.where(
        ready, statistic(e.theta, expected, np.where(ready[:, None, None], e.S, np.eye(len(tuning.theta)))), 0.0
    )
    monitor = loop.monitor
    limit = threshold(len(tuning.theta), monitor.evaluation_rate, monitor.memory, budget, np.inf)
    delays = pipeline.delays
    return Rehearsed(_share(delayed(limit < T2, *delays), counted), _share(delayed(e.level >= 1.0, *delays), counted))


def prepare(
    recordings: Sequence[Recording],
    expectations: Sequence[Expectation],
    plant: Plant,
    theta: FloatArray,
    covariance: FloatArray,
    loudest: Noise,
) -> tuple[Rehearsed, tuple[Member, ...], list[str]]:
    """Design the sequential test and rehearse it; return what was counted, the test, and what the user should know.

    There is no test where it would have raised an alarm on the healthy recordings themselves.

    Parameters
    ----------
    recordings, expectations
        One of each per healthy recording.
    plant, covariance
        The healthy plant, and the covariance of its parameters' logarithms, shape (m, m).
    theta
        The estimate that it is expected to lead to, shape (n,).
    loudest
        What the noise of the loop may be at most.
    """
    tuning = expectations[0].tuning
    first = replace(expectations[0], tuning=replace(tuning, theta=theta))
    if not plant.linear:  # what runs beside the loop is a linear one
        return Rehearsed(), (), ["there is no sequential test: the plant is not linear"]
    chosen = members(first, plant, loudest, covariance)
    rehearsed = rehearse(first, plant, loudest, chosen)
    if not chosen:
        return rehearsed, (), ["there is no sequential test: the healthy recordings are too short or too still for it"]
    pipeline = first.pipeline
    # the recordings are short: they speak where an alarm during them would have a chance of one in a thousand
    years = sum(rec.duration_s for rec in recordings) / SECONDS_PER_YEAR
    budget = max(SEQUENTIAL * pipeline.loop.monitor.false_alarms_per_year, UNLIKELY / years) / rehearsed.cusum
    test = watch(pipeline, plant, loudest, tuning.scale, chosen, budget)
    highest = max(float(pipeline.estimate(tuning, rec, test).level.max(initial=0.0)) for rec in recordings)
    if test is None or highest >= 1.0:
        told = "its residual is not the noise that it takes for granted" if test else "they are too short for it"
        return rehearsed, (), [f"the sequential test is left out of what the healthy recordings support: {told}"]
    return rehearsed, chosen, []


def _share(alarm: npt.NDArray[np.bool_], expected: float) -> float:
    """Return events against those expected, none counting as a half."""
    events = int((np.diff(alarm.astype(np.int8)) == 1).sum())
    share = float((events + 0.5) / (expected + 0.5))
    return share if expected >= FEW else max(share, 1.0)
