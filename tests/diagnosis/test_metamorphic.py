"""Changes of a recording that must not change its diagnosis: units, signs, time, length, place of the onset, rate.

Each machine is judged healthy and with three faults, and again after each change of log, motion or onset.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from importlib.resources import files
from typing import Any

import numpy as np
import pytest

import servoscope as ss
from servoscope.diagnosis.result import Diagnosis
from servoscope.simulation import CylinderRig, FaultEvent, cylinder_motion, reference, simulate, simulate_cylinder

RIG = ss.Loop.load(str(files("servoscope") / "simulation" / "reference-rig.toml")).to_dict()
AXIS: dict[str, Any] = {
    "sample_rate": 100.0,
    "plant": {
        "kind": "axis",
        "terms": ["viscous", "coulomb", "offset"],
        "coefficients": {"inertia": 2.0, "viscous_friction": 8.0, "coulomb_friction": 3.0, "offset": 0.5},
    },
    "controller": {"kind": "pi", "k_p": 400.0, "k_i": 0.0},
}
SEED = 9  # of the recordings that are judged
SHARE = 0.4  # of a recording, after which a fault comes
Change = Callable[[ss.Recording], ss.Recording]


@dataclass(frozen=True)
class Machine:
    """A simulated machine, three of its faults, and how its loop file follows the units of a log."""

    loop: Callable[[float, float], ss.Loop]  # by factor on u and sample rate
    record: Callable[..., ss.Recording]  # by seed, seconds, amplitude and faults
    rate: float
    seconds: float
    faults: Mapping[str, FaultEvent]  # by the name that a diagnosis gives, beginning at 0
    factor_y: float  # of its log in other units, below 0 for another sign
    mirrored: Mapping[str, str] = field(default_factory=dict)  # names that signs exchange
    rest_s: float = 0.0  # for which it may rest or move the other way, and shows no change

    def recording(
        self, name: str | None, share: float = SHARE, length: float = 1.0, amplitude: float = 1.0, seed: int = SEED
    ) -> ss.Recording:
        seconds = length * self.seconds
        faults = () if name is None else (replace(self.faults[name], at_s=share * seconds),)
        return replace(self.record(seed, seconds, amplitude, *faults), name=f"{name} {seed}")


def axis_motion(seed: int, seconds: float, amplitude: float, *faults: FaultEvent) -> ss.Recording:
    t, phase = np.arange(round(100.0 * seconds)) / 100.0, np.random.default_rng(seed).uniform(0.0, 6.0, 3)
    waves = [
        a * (np.sin(w * t + p) - np.sin(p)) for a, w, p in zip((0.5, 0.3, 0.1), (2.1, 4.7, 9.3), phase, strict=True)
    ]
    r = amplitude * np.sum(waves, axis=0)
    return simulate(ss.Loop.from_dict(AXIS), r, faults=faults, noise_u_std=0.05, noise_y_std=1e-5, seed=seed)[0]


def axis_loop(_: float, rate: float) -> ss.Loop:
    hold = "zoh" if rate == AXIS["sample_rate"] else "foh"  # u moves between the samples of a slower log
    return ss.Loop.from_dict(
        {"sample_rate": rate, "hold": hold, "plant": {"kind": "axis", "terms": AXIS["plant"]["terms"]}}
    )


def rig_motion(seed: int, seconds: float, amplitude: float, *faults: FaultEvent) -> ss.Recording:
    loop = ss.Loop.from_dict(RIG)
    return simulate(loop, amplitude * reference("multisine", seconds, 100.0, seed=seed), faults=faults, seed=seed)[0]


def rig_loop(factor_u: float, rate: float) -> ss.Loop:
    gains = {"k_p": factor_u * RIG["controller"]["k_p"], "k_i": factor_u * RIG["controller"]["k_i"]}
    plant = RIG["plant"] | {"input_gain": 1.0 / factor_u}
    return ss.Loop.from_dict(RIG | {"sample_rate": rate, "plant": plant, "controller": RIG["controller"] | gains})


def cylinder_recording(seed: int, seconds: float, amplitude: float, *faults: FaultEvent) -> ss.Recording:
    r = amplitude * cylinder_motion("production", seconds, 250.0, seed)
    return simulate_cylinder(r, CylinderRig(temperature=40.0), faults=faults, seed=seed)[0]


def cylinder_loop(_: float, rate: float) -> ss.Loop:
    plant = {"kind": "cylinder", "terms": ["spring", "overlap", "offset"]}
    return ss.Loop.from_dict({"sample_rate": rate, "plant": plant})


MACHINES = {
    "axis": Machine(
        axis_loop,
        axis_motion,
        100.0,
        16.0,
        {
            "lubrication": FaultEvent("viscous_friction", 1.5, 0.0),
            "dry_friction": FaultEvent("coulomb_friction", 1.5, 0.0),
            "payload": FaultEvent("inertia", 1.3, 0.0),
        },
        factor_y=-1000.0,
    ),
    "rig": Machine(
        rig_loop,
        rig_motion,
        100.0,
        30.0,
        {
            "leakage": FaultEvent("C_ie", 1.5, 0.0),
            "pump": FaultEvent("p_s", 0.8, 0.0),
            "friction": FaultEvent("b_p", 3.0, 0.0),
        },
        factor_y=-1.0,  # its physics are in m
    ),
    "cylinder": Machine(
        cylinder_loop,
        cylinder_recording,
        250.0,
        40.0,
        {
            "supply": FaultEvent("pump_pressure", 0.75, 0.0),
            "valve_forward": FaultEvent("gain_extend", 0.65, 0.0),
            "overlap": FaultEvent("overlap", 4.0, 0.0),
        },
        factor_y=-1000.0,
        mirrored={"valve_forward": "valve_backward"},
        rest_s=2.0,
    ),
}


@dataclass(frozen=True)
class Learned:
    machine: Machine
    healthy: list[ss.Recording]
    baseline: ss.Baseline
    diagnoses: dict[str | None, Diagnosis]

    def judge_changed(self, change: Change, loop: ss.Loop) -> dict[str | None, Diagnosis]:
        """Return the diagnoses of the same recordings where healthy ones and they are logged in another way."""
        baseline = ss.learn(loop, [change(recording) for recording in self.healthy])
        return {name: ss.diagnose(baseline, change(self.machine.recording(name))) for name in self.diagnoses}

    def judge_other(self, **motion: float) -> dict[str | None, Diagnosis]:
        """Return the diagnoses of other recordings of the machine."""
        return {name: ss.diagnose(self.baseline, self.machine.recording(name, **motion)) for name in self.diagnoses}


@pytest.fixture(scope="module", params=list(MACHINES))
def learned(request: pytest.FixtureRequest) -> Learned:
    """A machine, learned from three recordings, and the diagnoses that nothing may change."""
    machine = MACHINES[request.param]
    healthy = [machine.recording(None, seed=seed) for seed in range(3)]
    baseline = ss.learn(machine.loop(1.0, machine.rate), healthy)
    diagnoses = {name: ss.diagnose(baseline, machine.recording(name)) for name in (None, *machine.faults)}
    found = Learned(machine, healthy, baseline, diagnoses)
    check(found, diagnoses, SHARE * machine.seconds, 0.0)
    return found


def check(learned: Learned, diagnoses: Mapping[str | None, Diagnosis], onset_s: float, tolerance: float) -> None:
    """Check verdict and name of each, that its size agrees with the first one's, and that its onset is told."""
    unseen_s = learned.machine.rest_s + 2.0 / learned.machine.rate
    for name, diagnosis in diagnoses.items():
        if name is None:
            assert diagnosis.verdict == "healthy", diagnosis.headline
            continue
        (fault,), (known,) = diagnosis.faults, learned.diagnoses[name].faults
        assert fault.name in (name, learned.machine.mirrored.get(name)), diagnosis.headline
        assert fault.ratio == pytest.approx(known.ratio, rel=tolerance, abs=1e-9)
        low, _, high = diagnosis.onset_s
        assert low - unseen_s <= onset_s <= high + unseen_s, (name, diagnosis.onset_s)


def sized(learned: Learned, tolerance: float) -> float:
    """Return the tolerance of a size; that of an overlap, which is small, scatters with the motion."""
    return 0.2 if "overlap" in learned.machine.faults else tolerance


def test_units_signs_clock_and_order(learned: Learned) -> None:
    machine = learned.machine
    factor_u = -50.0 if machine.factor_y < 0.0 else 50.0

    def logged(recording: ss.Recording) -> ss.Recording:
        y = machine.factor_y
        return replace(recording, t=recording.t + 1e4, r=y * recording.r, u=factor_u * recording.u, y=y * recording.y)

    loop = machine.loop(factor_u / np.sign(machine.factor_y), machine.rate)
    other = replace(learned, healthy=learned.healthy[::-1])
    check(learned, other.judge_changed(logged, loop), 1e4 + SHARE * machine.seconds, 1e-3)


def test_a_recording_that_begins_later(learned: Learned) -> None:
    machine, begin = learned.machine, 0.1 * learned.machine.seconds
    diagnoses = {
        name: ss.diagnose(learned.baseline, machine.recording(name).part(begin, np.inf)) for name in learned.diagnoses
    }
    check(learned, diagnoses, SHARE * machine.seconds, 0.03)


def test_an_early_change_in_a_smaller_motion(learned: Learned) -> None:
    check(learned, learned.judge_other(share=0.15, amplitude=0.9), 0.15 * learned.machine.seconds, sized(learned, 0.05))


def test_a_late_change_in_a_longer_recording(learned: Learned) -> None:
    onset_s = 0.75 * 1.5 * learned.machine.seconds
    check(learned, learned.judge_other(share=0.75, length=1.5), onset_s, sized(learned, 0.05))


@pytest.mark.parametrize("learned", ["axis", "cylinder"], indirect=True)
def test_half_the_rate(learned: Learned) -> None:
    """u changes between two samples of such a log, of which the rig's exact predictor knows nothing."""
    machine = learned.machine

    def thinned(recording: ss.Recording) -> ss.Recording:
        return replace(recording[::2], sample_rate=0.5 * machine.rate)

    diagnoses = learned.judge_changed(thinned, machine.loop(1.0, 0.5 * machine.rate))
    check(learned, diagnoses, SHARE * machine.seconds, sized(learned, 0.05))  # reversals lie between samples
