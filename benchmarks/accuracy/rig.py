"""The reference rig for all scenarios: its loop, recordings, baselines, and when there is an alarm."""

from __future__ import annotations

import functools
from importlib.resources import files
from pathlib import Path

import numpy as np

import servoscope as ss
from servoscope.core.arrays import FloatArray
from servoscope.evidence.examination import Examination
from servoscope.scoring import events
from servoscope.simulation import FaultEvent, reference
from servoscope.simulation.measurement import NOISE_U_STD, NOISE_Y_STD

HOURS_PER_YEAR = 8766.0
FAULT_AT = 30.0  # s
SEEDS_PER_UNIT = 1000  # more than any unit draws


@functools.cache
def loop(per_year: float = 1.0) -> ss.Loop:
    """Return the loop of the reference rig, as its file has it but for the budget of false alarms."""
    made = ss.Loop.load(Path(str(files("servoscope"))) / "simulation" / "reference-rig.toml")
    return made.model_copy(
        update={"monitor": made.monitor.model_copy(update={"false_alarms_per_year": per_year})},
    )


def record(
    kind: str, seconds: float, unit: int, index: int, faults: tuple[FaultEvent, ...] = (), noise: float = 1.0
) -> ss.Recording:
    """Simulate the loop under a reference of some kind; unit and index make a seed of their own.

    `noise` is a factor on the standard deviations of the paper.
    """
    return ss.simulate(
        loop(),
        reference(kind, seconds, loop().sample_rate),
        faults=faults,
        noise_u_std=noise * NOISE_U_STD,
        noise_y_std=noise * NOISE_Y_STD,
        seed=SEEDS_PER_UNIT * unit + index,
    )[0]


def baseline(
    kind: str, seconds: float, unit: int, index: int = 0, noise: float = 1.0, per_year: float = 1.0
) -> ss.Baseline:
    """Learn from one healthy recording."""
    return ss.learn(loop(per_year), [record(kind, seconds, unit, index, noise=noise)])


def alarm_times(learned: ss.Baseline, recording: ss.Recording) -> FloatArray:
    """Return when `diagnose` would raise an alarm [s], without the search for names that follows one.

    One time per excursion: that of the sample where a sequential test passed its limit, or of the evaluation.
    """
    x = Examination.from_recording(learned, recording)
    at = events(x.alarm)
    crossed = np.asarray(x.estimates.crossed[at]).astype(np.int64)
    return np.asarray(recording.t[np.where(crossed > 0, crossed - 1, x.estimates.index[at])])


def until_first(times: FloatArray) -> list[float]:
    """Return the alarms up to the first one after the fault: all that its detection is judged by."""
    return [float(t) for t in times[: int(np.searchsorted(times, FAULT_AT)) + 1]]
