"""Random faults under random motions, on rigs of all kinds: how far stated probabilities can be believed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

import servoscope as ss
from accuracy import motion, nonlinear, rig
from accuracy.axis import AXES, record
from accuracy.draws import between
from accuracy.rig import SEEDS_PER_UNIT
from accuracy.scenario import Numbers, Row, Scenario, Table
from accuracy.told import percent
from servoscope.isolation.candidate import UNKNOWN
from servoscope.scoring import reliability
from servoscope.simulation import FaultEvent, reference, simulate_rig

UNITS = 300
RIGS = (*AXES, "valve", "reference rig")
SMALLEST, LARGEST = 1.05, 2.0  # ratio of the changed parameter, up or down
EARLIEST, LATEST = 10.0, 50.0  # s
OF_AXIS = {"viscous": "viscous_friction", "coulomb": "coulomb_friction", "mass": "inertia", "gain": "input_gain"}
OF_EHA = ("p_s", "C_ie", "b_p", "beta")
SURE = 0.99


def job(unit: int) -> Numbers:
    """Draw one fault and judge it."""
    rng = np.random.default_rng(unit)
    name = str(rng.choice(RIGS))
    ratio = between(rng, SMALLEST, LARGEST) ** float(rng.choice([-1.0, 1.0]))
    at, seed = float(rng.uniform(EARLIEST, LATEST)), SEEDS_PER_UNIT * unit + 500
    if name in AXES:
        field, words = str(rng.choice(list(OF_AXIS))), str(rng.choice(list(motion.MOTIONS)))
        axis, parameter = AXES[name], OF_AXIS[field]
        faulty = replace(axis, **{field: getattr(axis, field) * ratio})
        recording = record(axis, motion.MOTIONS[words](seed), seed, faulty, at)
        learned = motion.baseline(name, unit % 3)
    else:
        parameter, words = str(rng.choice(OF_EHA)), str(rng.choice(motion.KINDS))
        amplitude, events = between(rng, 0.5, 1.5), (FaultEvent(parameter, ratio, at),)
        words += f" x {amplitude:.2f}"
        r = reference(words.split()[0], 60.0, 100.0, amplitude=amplitude)
        if name == "valve":
            recording, _ = simulate_rig(nonlinear.loop(), r, motion.VALVE, faults=events, seed=seed)
            learned = motion.valve_baseline(motion.KINDS[unit % 3])
        else:
            recording, _ = ss.simulate(rig.loop(), r, faults=events, seed=seed)
            learned = rig.baseline(motion.KINDS[unit % 3], 60.0, 0)
    diagnosis = ss.diagnose(learned, recording)
    known = [candidate for candidate in diagnosis.candidates if candidate.name != UNKNOWN]
    best = known[0] if known else None
    return {
        "rig": name,
        "motion": words,
        "fault": [parameter, round(ratio, 4), round(at, 2)],
        "outcome": motion.outcome(diagnosis, parameter),
        "first": [fault.parameter for fault in best.faults] if best else [],
        "probability": round(best.probability, 6) if best else None,
    }


def rows(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show what was said, and what stated probabilities were worth."""
    made: list[Row] = []
    for name, runs in [(words, found), *((name, [run for run in found if run["rig"] == name]) for name in RIGS)]:
        claims = [(run["probability"], run["first"] == [run["fault"][0]]) for run in runs if run["first"]]
        said = [run["outcome"] for run in runs]
        named = said.count("named") + said.count("wrong name")
        wrong = sum(probability >= SURE and not right for probability, right in claims)
        error = reliability(*map(np.array, zip(*claims, strict=True))).calibration_error if claims else np.nan
        ends = (said.count(end) for end in ("healthy", "undetermined", "motion", "unnamed"))
        right = percent(said.count("named"), named, low=0.95)
        made.append(
            (name, str(len(runs)), *map(str, ends), str(named), right, str(wrong), f"{error:.3f}" if claims else "")
        )
    return made


TABLES = (
    Table(
        "mixed",
        (
            *("rig", "faults", "healthy", "too little motion", "motion never seen", "fault without a name", "named"),
            *("of them rightly", "wrong at 99 %", "calibration error"),
        ),
        (Scenario("mixed/all", "all", UNITS, job, (), rows),),
    ),
)
