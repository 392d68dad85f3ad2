"""Motion that the baseline never saw: whether anything healthy is called faulty, and what true faults lose by it."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

import servoscope as ss
from accuracy import nonlinear
from accuracy.axis import AXES, Axis, loop, moves, random_motion, record
from accuracy.rig import SEEDS_PER_UNIT
from accuracy.scenario import Numbers, Row, Scenario, Table
from servoscope.core.arrays import FloatArray
from servoscope.evidence.examination import Examination

Motion = Callable[[int], FloatArray]
MOTIONS: dict[str, Motion] = {
    "as learned": moves,
    "slower": lambda seed: moves(seed, time=2.0),
    "larger": lambda seed: moves(seed, size=0.5, time=1.6),
    "random, 2 Hz": functools.partial(random_motion, acceleration=6.0),
    "random, u at its limits": functools.partial(random_motion, acceleration=9.0),
}
FAULTS: dict[str, tuple[str, Callable[[Axis], Axis]]] = {
    "friction + 30 %": ("viscous_friction", lambda axis: replace(axis, viscous=1.3 * axis.viscous)),
    "inertia + 20 %": ("inertia", lambda axis: replace(axis, mass=1.2 * axis.mass)),
    "gain - 10 %": ("input_gain", lambda axis: replace(axis, gain=0.9)),
}
KINDS = ("profile", "multisine", "trapezoid")
OUTCOMES = ("healthy", "undetermined", "motion", "unnamed", "named", "wrong name")
SMALLEST, LARGEST = 0.3, 2.0  # amplitude, relative to the baseline's
VALVE = replace(nonlinear.LINEAR_RIG, load_pressure_flow=True)


@functools.cache
def baseline(name: str, unit: int) -> ss.Baseline:
    """Learn an axis from two recordings of a minute."""
    seeds = (SEEDS_PER_UNIT * unit + i for i in range(2))
    return ss.learn(loop(), [record(AXES[name], moves(seed), seed) for seed in seeds])


def outcome(diagnosis: ss.Diagnosis, truth: str = "") -> str:
    """Return the verdict; of a fault, whether it was named rightly, wrongly or not at all."""
    if diagnosis.verdict != "fault":
        motion = any(warning.kind == "motion" for warning in diagnosis.warnings)
        return "motion" if diagnosis.verdict == "undetermined" and motion else diagnosis.verdict
    if not diagnosis.faults:
        return "unnamed"
    return "named" if [fault.parameter for fault in diagnosis.faults] == [truth] else "wrong name"


def axis_job(unit: int, name: str) -> Numbers:
    """Judge healthy recordings under every motion, and each fault under the baseline's; with the check and without."""
    axis, learned, runs = AXES[name], baseline(name, unit), {}
    unlimited = learned.model_copy(update={"motion": None})
    cases = [(words, motion, "", axis) for words, motion in MOTIONS.items()]
    cases += [(words, moves, parameter, spoil(axis)) for words, (parameter, spoil) in FAULTS.items()]
    for i, (words, motion, parameter, faulty) in enumerate(cases):
        seed = SEEDS_PER_UNIT * unit + 10 + i
        recording = record(axis, motion(seed), seed, faulty)
        runs[words] = [outcome(ss.diagnose(one, recording), parameter) for one in (learned, unlimited)]
    return {"runs": runs}


def valve_job(unit: int, kind: str) -> Numbers:
    """Judge a healthy recording of the square-root valve with a linear file, at some amplitude."""
    amplitude = float(np.exp(np.random.default_rng(unit).uniform(np.log(SMALLEST), np.log(LARGEST))))
    recording, _ = nonlinear.simulated(kind, 100 + unit, amplitude, rig=VALVE)
    learned = valve_baseline(kind)
    unlimited = Examination.from_recording(learned, recording).apparent_alarm.any()
    said = [outcome(ss.diagnose(learned, recording)), "fault" if unlimited else "healthy"]
    return {"runs": {f"amplitude {SMALLEST:g} to {LARGEST:g}": said}, "amplitude": round(amplitude, 3)}


@functools.cache
def valve_baseline(kind: str) -> ss.Baseline:
    """Learn the valve with a linear file at the amplitude 1."""
    return ss.learn(nonlinear.loop(delay=0.0), [nonlinear.simulated(kind, 1, rig=VALVE)[0]])


def rows(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show how often each thing was said."""
    made: list[Row] = []
    for what in found[0]["runs"]:
        said, unlimited = zip(*(unit["runs"][what] for unit in found), strict=True)
        counts = (str(said.count(end)) for end in OUTCOMES)
        faults = sum(end not in ("healthy", "undetermined", "motion") for end in unlimited)
        right = unlimited.count("named") if what in FAULTS else ""
        made.append((words if not made else "", what, str(len(said)), *counts, str(faults), str(right)))
    return made


AXIS_WORDS = {
    "ideal": "motor axis",
    "stribeck": "with Stribeck friction",
    "cogging": "with cogging",
    "belt": "on a belt",
}
SCENARIOS = (
    *(Scenario(f"motion/{name}", AXIS_WORDS[name], 25, axis_job, (name,), rows) for name in AXES),
    *(Scenario(f"motion/valve-{kind}", f"valve, {kind}", 34, valve_job, (kind,), rows) for kind in KINDS),
)
TABLES = (
    Table(
        "motion",
        (
            *("loop", "recording", "runs", "healthy", "too little motion", "motion never seen"),
            *("fault without a name", "named rightly", "**named wrongly**"),
            *("without the check: fault", "named rightly"),
        ),
        SCENARIOS,
    ),
)
