"""Whether a diagnosis hangs on the last bits: u and y times 1 +- 1e-9, over plants and kinds of faults.

    python benchmarks studies/last_bits [--recordings 12] [--seed 1] [--json]

Each machine is learned from recordings as they are and from moved ones. A verdict, the name of a fault or of an
interval, a size in its third digit, or a date by 0.1 s that is another one afterwards is printed and counted.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from accuracy import axis, cylinder_days
from accuracy.cylinder import CYLINDER, loop_with
from accuracy.rig import loop as rig_loop
from accuracy.rig import record as rig_record
from tables import Table, parser, show

import servoscope as ss
from servoscope.diagnosis.result import Diagnosis
from servoscope.signals import clean
from servoscope.simulation import FaultEvent

RELATIVE = 1e-9
MOVES = ((1.0 + RELATIVE, 1.0 - RELATIVE), (1.0 - RELATIVE, 1.0), (1.0, 1.0 + RELATIVE))  # of u, of y
SIZE, DATE_S = 1e-3, 0.1  # what may differ: a relative size, a date
Generator = np.random.Generator


def moved(recording: ss.Recording, factors: tuple[float, float]) -> ss.Recording:
    """Return a recording whose u and y are times these factors."""
    of_u, of_y = factors
    return replace(recording, u=of_u * recording.u, y=of_y * recording.y)


def differences(one: Diagnosis, other: Diagnosis) -> list[str]:
    """Return what is said otherwise of two recordings that differ in their last bits only."""
    if one.verdict != other.verdict or len(one.intervals) != len(other.intervals):
        return [f"{one.headline} / {other.headline}"]
    found = []
    for a, b in zip(one.intervals, other.intervals, strict=True):
        if [fault.name for fault in a.faults] != [fault.name for fault in b.faults]:
            found.append(f"{[fault.name for fault in a.faults]} / {[fault.name for fault in b.faults]}")
            continue
        found += [
            f"{x.name} {x.ratio:.5g} / {y.ratio:.5g}"
            for x, y in zip(a.faults, b.faults, strict=True)
            if abs(x.ratio / y.ratio - 1.0) >= SIZE
        ]
        dates = zip((*a.onset_s, *(a.end_interval_s or ())), (*b.onset_s, *(b.end_interval_s or ())), strict=False)
        found += [f"date {x:.2f} / {y:.2f} s" for x, y in dates if abs(x - y) >= DATE_S]
    return found


@dataclass(frozen=True)
class Machine:
    """A machine: its loop, healthy recordings by seed, and others with faults that are drawn."""

    loop: ss.Loop
    healthy: Callable[[int], ss.Recording]
    drawn: Callable[[Generator, int], tuple[str, ss.Recording]]


def rig(kind: str) -> Machine:
    """Return the reference rig under one kind of reference: a fault, a small one, two, a drift, one that heals."""

    def drawn(rng: Generator, seed: int) -> tuple[str, ss.Recording]:
        names = rng.permutation(["p_s", "C_ie", "b_p", "beta"])
        sizes = {"p_s": (0.7, 1.3), "C_ie": (0.8, 3.0), "b_p": (0.5, 20.0), "beta": (0.1, 0.8)}
        a, b = (FaultEvent(str(name), float(np.exp(rng.uniform(*np.log(sizes[name])))), 30.0) for name in names[:2])
        courses = (
            (a,),
            (replace(a, ratio=a.ratio**0.1),),
            (a, b),
            (replace(a, ramp_s=10.0),),
            (a, replace(a, ratio=1.0, at_s=45.0)),
        )
        faults = courses[rng.integers(len(courses))]
        words = " ".join(map(str, faults))
        return words, rig_record(kind, 60.0, 7, seed, faults)

    return Machine(rig_loop(), lambda seed: rig_record(kind, 60.0, 6, seed), drawn)


def stage(name: str, plant: dict[str, object]) -> Machine:
    """Return one of the axes that are not quite their model, under a plant of the loop file."""
    loop = axis.loop().to_dict() | {"plant": plant}
    nominal = axis.AXES[name]

    def drawn(rng: Generator, seed: int) -> tuple[str, ss.Recording]:
        field = str(rng.choice(["mass", "viscous", "coulomb", "gain", "load", "all"]))
        ratio, at = float(np.exp(rng.uniform(-0.5, 0.5))), float(rng.choice([0.0, 0.3, 12.0, 35.0]))
        changes = {"all": {"mass": 0.7, "coulomb": 1.5}, "load": {"load": 4.0}}.get(field)
        faulty = replace(nominal, **(changes or {field: ratio * getattr(nominal, field)}))
        r = (axis.moves if seed % 2 else axis.random_motion)(seed, seconds=40.0)
        return f"{field} {ratio:.3f} at {at:g} s", axis.record(nominal, r, seed, faulty, at)

    return Machine(
        ss.Loop.from_dict(loop), lambda seed: axis.record(nominal, axis.moves(seed, seconds=40.0), seed), drawn
    )


def fed_forward(gain: float, seed: int) -> ss.Recording:
    """Return an axis whose controller knows the motion so well that the first samples say little."""
    rng, rate, steps = np.random.default_rng(seed), 100.0, 20
    t = np.arange(4000) / rate
    r = np.sin(np.pi * t) + 0.5 * np.sin(2.0 * np.pi * t / 0.74 + 1.0)
    x, v, h = 0.0, 0.0, 1.0 / (rate * steps)
    y, u = np.zeros(t.size), np.zeros(t.size)
    for k in range(t.size):
        y[k] = x + 1e-5 * rng.standard_normal()
        ahead = (r[k] - r[k - 1] - y[k] + y[k - 1]) * rate if k else 0.0
        u[k] = 8.0 * (r[k] - y[k]) + 0.6 * ahead
        for disturbance in 0.008 * rng.standard_normal(steps):
            v += h * (gain * u[k] - 0.1 * v - 0.05 * np.tanh(v / 0.01) + disturbance) / 0.02
            x += h * v
    return clean(t, r, u, y, name=f"ahead-{seed}", sample_rate=rate)


def ahead() -> Machine:
    """Return the axis that is fed forward, with another gain from its first sample on."""

    def drawn(rng: Generator, seed: int) -> tuple[str, ss.Recording]:
        gain = float(rng.uniform(0.7, 1.3))
        return f"gain {gain:.3f} from the start", fed_forward(gain, 100 + seed)

    loop = ss.Loop.from_dict({"name": "ahead", "sample_rate": 100.0, "plant": {"kind": "axis"}})
    return Machine(loop, lambda seed: fed_forward(1.0, seed), drawn)


def cylinder() -> Machine:
    """Return the cylinder, with a fault that comes within a production day."""

    def drawn(rng: Generator, seed: int) -> tuple[str, ss.Recording]:
        fault = str(rng.choice(list(cylinder_days.FAULTS)))
        names, ratios = cylinder_days.FAULTS[fault]
        ratio, at = ratios[rng.integers(3)], float(rng.choice([0.0, 20.0, 40.0]))
        return f"{fault} {ratio:g} at {at:g} s", cylinder_days.day("production", 100 + seed, names, ratio, at)

    return Machine(loop_with(CYLINDER), lambda seed: cylinder_days.day("production", seed), drawn)


MACHINES: dict[str, Callable[[], Machine]] = {
    **{f"rig, {kind}": lambda kind=kind: rig(kind) for kind in ("profile", "multisine", "trapezoid")},
    "axis, fed forward": ahead,
    "axis, ideal": lambda: stage("ideal", {"kind": "axis"}),
    "axis, Stribeck friction": lambda: stage("stribeck", {"kind": "axis"}),
    "axis on a belt, by its coefficients": lambda: stage("belt", axis.loop().to_dict()["plant"]),
    "cylinder": cylinder,
}


def judged(machine: Machine, recordings: int, seed: int, moves: int = len(MOVES)) -> list[tuple[str, list[str]]]:
    """Return what differs, by recording: of a healthy one and of those with faults."""
    rng = np.random.default_rng(seed)
    healthy = [machine.healthy(each) for each in range(2)]
    trials = [("healthy", machine.healthy(9)), *(machine.drawn(rng, 10 + i) for i in range(recordings - 1))]
    baseline, found = ss.learn(machine.loop, healthy), dict[str, list[str]]()
    before = [ss.diagnose(baseline, recording) for _, recording in trials]
    for k, factors in enumerate(MOVES[:moves]):
        learned = baseline if k else ss.learn(machine.loop, [moved(recording, factors) for recording in healthy])
        for (words, recording), told in zip(trials, before, strict=True):
            found.setdefault(f"{recording.name}, {words}", []).extend(
                differences(told, ss.diagnose(learned, moved(recording, factors)))
            )
    return list(found.items())


def main() -> None:
    """Run the command line of this process."""
    command = parser(__doc__)
    command.add_argument("--recordings", type=int, default=12, help="of each machine")
    command.add_argument("--seed", type=int, default=1)
    command.add_argument("--only", default="", help="machines whose names contain this")
    given = command.parse_args()
    rows = list[Sequence[str]]()
    for name, made in MACHINES.items():
        if given.only in name:
            found = judged(made(), given.recordings, given.seed)
            different = [one for one in found if one[1]]
            for words, said in different:
                print(f"{name}: {words}: {'; '.join(said)}", file=sys.stderr, flush=True)
            rows.append((name, f"{len(found)}", f"{len(different)}"))
    note = "Recordings of which verdict, name, a size (0.1 %) or a date (0.1 s) changed with u and y times 1 +- 1e-9."
    show([Table("Last bits", note, ("machine", "recordings", "changed"), tuple(map(tuple, rows)))], given.json)


if __name__ == "__main__":
    main()
