"""Payloads, friction, belt and backlash of an arm joint, beside simple detectors; simulated apart from the package.

    python benchmarks accuracy/arm [--count N] [--json]

A motor turns an arm through a belt: the encoder sits on the motor, and the plant of the loop file knows no belt. The
arm hangs, its joint has viscous and Coulomb friction, and friction in proportion to the force in the belt. A payload m
at the end adds the inertia m l^2 and the weight m g l behind the belt, and so friction. The belt may soften, and a gap
open between it and the arm. Four healthy recordings are learned; each change comes at its own time into moves of its
own.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numba
import numpy as np
from public.simple_detectors import detectors, judge
from tables import Table, parser, show

import servoscope as ss
from accuracy import axis
from accuracy.axis import RATE, SUBSTEPS, moves
from servoscope.signals import clean

EARTH = 9.81
LENGTH = 0.4  # of the arm, where the payload is [m]
BELT = 4000.0  # N m/rad
NOISE_Y, NOISE_U = 2e-5, 0.05  # rad, N m
LIMIT = 80.0  # of u [N m]
POSITION_GAIN, VELOCITY_GAIN, INTEGRAL_GAIN = 15.0, 30.0, 300.0
SIZE = 1.5  # of the moves [rad]
LEARNED = 4
WINDOW_S = 10.0  # of the simple detectors
TERMS = ("viscous", "coulomb", "gravity", "load_friction", "offset")


@dataclass(frozen=True)
class Arm:
    """The joint: u = (J_m + J_l) y'' + F_v y' + (F_c + mu |belt|) sign(y') + G sin(y), with a belt in between."""

    motor: float = 0.35  # inertia on the encoder's side [kg m^2]
    mass: float = 4.0  # of the arm [kg]
    centre: float = 0.25  # where its weight acts [m]
    load: float = 0.0  # payload [kg]
    viscous: float = 2.0  # N m s/rad
    coulomb: float = 1.5  # N m
    by_load: float = 0.04  # of the force in the belt
    gain: float = 1.0  # of what u does
    belt: float = BELT
    slack: float = 0.0  # between belt and arm, from one end of the gap to the other [rad]

    @property
    def numbers(self) -> tuple[float, ...]:
        """What the simulation takes."""
        link = 1.2 * self.mass * self.centre**2 + self.load * LENGTH**2
        weight = EARTH * (self.mass * self.centre + self.load * LENGTH)
        return (
            *(self.motor, link, weight, self.viscous, self.coulomb),
            *(self.by_load, self.gain, self.belt, self.slack),
        )


CHANGES = {
    "payload 0.25 kg": Arm(load=0.25),
    "payload 0.5 kg": Arm(load=0.5),
    "payload 1 kg": Arm(load=1.0),
    "payload 2 kg": Arm(load=2.0),
    "Coulomb friction + 30 %": Arm(coulomb=1.95),
    "viscous friction + 30 %": Arm(viscous=2.6),
    "motor constant - 10 %": Arm(gain=0.9),
    "belt 50 % softer": Arm(belt=0.5 * BELT),
    "backlash 2 mrad": Arm(slack=2e-3),
}
NAMES = {
    "Coulomb": "dry_friction",
    "viscous": "lubrication",
    "motor": "motor_constant",
    "payload": "payload",
    "belt": "vibration",
    "backlash": "vibration",
}
SLIDE = axis.AXES["belt"]  # half of a mass of 20 kg behind a belt, no load on it at rest
WORN = {
    **{
        f"belt {100 * share:g} % softer": replace(SLIDE, belt_hz=SLIDE.belt_hz * (1.0 - share) ** 0.5)
        for share in (0.1, 0.3, 0.5, 0.75)
    },
    **{f"backlash {1e6 * gap:g} um": replace(SLIDE, slack=gap) for gap in (1e-6, 1e-5, 2e-5, 5e-5, 1e-4, 5e-4)},
}
COMPARED = "payload 0.5 kg", "payload 2 kg"  # judged by every plant
VARIANTS: dict[str, dict[str, object]] = {
    "as simulated, but for the belt": {"terms": TERMS, "payload_arm": LENGTH},
    "without `load_friction`": {"terms": tuple(t for t in TERMS if t != "load_friction"), "payload_arm": LENGTH},
    "without `payload_arm`": {"terms": TERMS},
}


@numba.njit(cache=True)
def _run(r, p, q, switch, n_y, n_u):  # type: ignore[no-untyped-def]
    """Return u and y; cascade of position and velocity loop, semi-implicit Euler between the samples."""
    N = len(r)
    u, y = np.zeros(N), np.zeros(N)
    x, v, x_l, v_l, integral, before, speed = r[0], 0.0, r[0], 0.0, 0.0, r[0], 0.0
    dt = 1.0 / RATE
    h = dt / SUBSTEPS
    for k in range(N):
        motor, link, weight, viscous, coulomb, by_load, gain, stiffness, slack = p if k < switch else q
        y[k] = x + n_y[k]
        speed += 0.5 * ((y[k] - before) / dt - speed)
        before = y[k]
        error = (r[min(k + 1, N - 1)] - r[k]) / dt + POSITION_GAIN * (r[k] - y[k]) - speed
        want = VELOCITY_GAIN * error + integral
        u[k] = min(max(want, -LIMIT), LIMIT)
        if want == u[k]:
            integral += INTEGRAL_GAIN * error * dt
        for _ in range(SUBSTEPS):
            twist = x_l - x - min(max(x_l - x, -0.5 * slack), 0.5 * slack)
            touching = twist != 0.0 or slack == 0.0
            belt = stiffness * twist + (0.002 * BELT * (v_l - v) if touching else 0.0)
            v_l -= h * (belt + weight * np.sin(x_l)) / link
            x_l += h * v_l
            free = v + h * (gain * (u[k] + n_u[k]) - viscous * v + belt) / motor
            stop = h * (coulomb + by_load * abs(belt)) / motor
            v = free - stop if free > stop else (free + stop if free < -stop else 0.0)
            x += h * v
    return u, y


def record(seed: int, changed: Arm | None = None) -> ss.Recording:
    """Simulate the joint under moves of its own, changed at a time between a third and two thirds."""
    rng, r = np.random.default_rng([seed, 1]), moves(seed, SIZE)
    noises = NOISE_Y * rng.normal(size=len(r)), NOISE_U * rng.normal(size=len(r))
    switch = int(len(r) * rng.uniform(1.0 / 3.0, 2.0 / 3.0))
    u, y = _run(r, Arm().numbers, (changed or Arm()).numbers, switch, *noises)
    return clean(np.arange(len(r)) / RATE, r, u, y, name=f"seed {seed}", sample_rate=RATE)


def loop(**plant: object) -> ss.Loop:
    """Return the loop file of the joint."""
    settings = {"name": "arm", "sample_rate": RATE, "plant": {"kind": "axis", **plant}, "monitor": {"cutoff": 10.0}}
    return ss.Loop.from_dict(settings)


def found_table(
    title: str,
    note: str,
    healthy: Sequence[ss.Recording],
    recordings: Mapping[str, Sequence[ss.Recording]],
    said: Mapping[str, Sequence[ss.Diagnosis]],
) -> Table:
    """Return what was found and named of each change, beside simple detectors."""
    simple = [judge(one, healthy, [r for some in recordings.values() for r in some]) for one in detectors(WINDOW_S, 10)]
    rows, begin = [], 0
    for what, told in said.items():
        own, begin = slice(begin, begin + len(told)), begin + len(told)
        names = [{fault.name for fault in one.faults} for one in told]
        right, wrong = sum(one == {_name(what)} for one in names), sum(bool(one) for one in names)
        rows.append((
            *(what, f"{len(told)}", f"{sum(one.verdict == 'fault' for one in told)}"),
            *(("", "") if what == "none" else (f"{right}", f"{wrong - right}")),
            *(f"{sum(x > one.limit for x in one.largest[own])}" for one in simple),
        ))  # fmt: skip
    heads = (
        "change",
        "recordings",
        "found",
        "named right",
        "named wrong",
        "rms of u",
        "T^2 of features",
        "inverse + CUSUM",
    )
    return Table(title, note, heads, tuple(rows))


def _name(what: str) -> str:
    return NAMES.get(what.split()[0], "")


def _rights(what: str, plant: Mapping[str, object]) -> list[set[str]]:
    """Return what a payload may be called: the load's share of friction is dry friction to a plant without it."""
    if "payload_arm" not in plant:
        return [{"payload", "gravity"}]
    return [{"payload"}] if plant["terms"] == TERMS else [{"payload"}, {"payload", "dry_friction"}]


def main() -> None:
    """Print the tables."""
    command = parser(__doc__)
    command.add_argument("--count", type=int, default=10, help="recordings of each change")
    given = command.parse_args()
    healthy = [record(seed) for seed in range(LEARNED)]
    recordings = {
        what: [record(100 * (1 + i) + k, changed) for k in range(given.count)]
        for i, (what, changed) in enumerate({"none": None, **CHANGES}.items())
    }
    weighed, said = [], dict[str, list[ss.Diagnosis]]()
    for i, (words, plant) in enumerate(VARIANTS.items()):
        baseline = ss.learn(loop(**plant), healthy)
        for what, judged in recordings.items():
            if i and what not in COMPARED:
                continue
            told = [ss.diagnose(baseline, one) for one in judged]
            if not i:
                said[what] = told
            if what.startswith("payload"):
                named = [one for one in told if {fault.name for fault in one.faults} in _rights(what, plant)]
                weighed.append((words, what, *_weights(named, CHANGES[what].load), len(named), len(told)))
            print(words, what, "done", file=sys.stderr, flush=True)
    note = (
        f"60 s at {RATE:g} Hz each, four healthy recordings learned; the simple detectors look at windows of"
        f" {WINDOW_S:g} s. Found in the row without a change: false."
    )
    tables = [found_table("Arm joint: found and named", note, healthy, recordings, said)]
    heads = ("plant", "change", "named right", "error of the mass: median", "largest", "mass in 95 %")
    cells = tuple(
        (words, what, f"{named} of {count}", median, largest, inside)
        for words, what, median, largest, inside, named, count in weighed
    )
    about = (
        "By the plant of the loop file; errors and intervals are those of payloads named right."
        " Without `payload_arm` payload and gravity together are right; without `load_friction` dry friction may be"
        " named beside the payload, which has brought some."
    )
    tables.append(Table("Arm joint: the payload's mass", about, heads, cells))
    healthy = [axis.record(SLIDE, moves(seed), seed) for seed in range(LEARNED)]
    recordings = {
        what: [_worn(100 * (1 + i) + k, changed) for k in range(given.count)]
        for i, (what, changed) in enumerate({"none": SLIDE, **WORN}.items())
    }
    baseline = ss.learn(ss.Loop.from_dict(axis.loop().to_dict() | {"plant": {"kind": "axis"}}), healthy)
    said = {what: [ss.diagnose(baseline, one) for one in judged] for what, judged in recordings.items()}
    note += f" Noise of y: {1e6 * axis.NOISE_Y:g} um."
    tables.append(found_table("Slide on a belt: found and named", note, healthy, recordings, said))
    show(tables, given.json)


def _worn(seed: int, changed: axis.Axis) -> ss.Recording:
    at = axis.SECONDS * np.random.default_rng([seed, 2]).uniform(1.0 / 3.0, 2.0 / 3.0)
    return axis.record(SLIDE, moves(seed), seed, changed, at)


def _weights(named: list[ss.Diagnosis], true: float) -> tuple[str, str, str]:
    """Return median and largest relative error of the mass, and how often its interval holds it."""
    told = [next((f.mass_kg for f in one.faults if f.mass_kg is not None), None) for one in named]
    known = [mass for mass in told if mass is not None]
    if not known:
        return "", "", ""
    errors = np.abs(np.array([mass[0] for mass in known]) / true - 1.0)
    inside = sum(low <= true <= high for _, low, high in known)
    return f"{100 * np.median(errors):.1f} %", f"{100 * errors.max():.1f} %", f"{inside} of {len(known)}"
