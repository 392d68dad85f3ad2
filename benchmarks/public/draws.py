"""Measured machines, learned from recordings that are drawn at random: false alarms, and what is found.

    python benchmarks public/draws [--data DIR] [--set NAME] [--draws 24] [--half tuning|judged] [--json]

The healthy recordings of a machine that were not drawn are judged in the order in which they were recorded, and so are
changed ones: QUBE with u times 1.1, seeded faults of the ball screw (two runs of each at each load), the hobby servos
with another mass, or twice the u. In a row: fault by what two recordings after each other say. The first half of the
draws is for tuning, the second for judging. Processor time: 4 minutes per machine on one core.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from tables import Table, parse_with_data, parser, show

import servoscope as ss
from public import cranfield, qube, sts3215, xl330
from public.servoscope_detector import ROOT, with_gain
from servoscope.core.errors import ServoscopeError

LEARNED = 4, 6, 8, 12
MIN_JUDGED = 2
MAX_JUDGED = 10  # healthy recordings of a draw that are judged, and changed ones
RUNS_OF_FAULT = 2


@dataclass(frozen=True)
class Machine:
    """One machine at one load: healthy recordings in order of time, and what makes changed ones of held-out ones."""

    loop: ss.Loop
    healthy: Sequence[ss.Recording]
    changed: Callable[[Sequence[ss.Recording]], Sequence[ss.Recording]]


@dataclass
class Counts:
    """What was said of healthy recordings, and of changed ones."""

    judged: int = 0
    changed: int = 0
    verdicts: dict[tuple[bool, str], int] = field(default_factory=dict)  # (changed, verdict): how many
    named: int = 0  # healthy ones
    pairs: int = 0  # of healthy ones after each other
    pairs_above: int = 0
    changed_pairs: int = 0
    changed_pairs_above: int = 0
    refused: int = 0  # draws that cannot be learned

    def add(self, diagnoses: Sequence[ss.Diagnosis], changed: bool) -> None:
        """Count what was said of recordings in order of time."""
        above = [one.verdict in ("suspect", "fault") for one in diagnoses]
        both = sum(a and b for a, b in pairwise(above))
        for one in diagnoses:
            key = changed, one.verdict
            self.verdicts[key] = self.verdicts.get(key, 0) + 1
        if changed:
            self.changed += len(diagnoses)
            self.changed_pairs += len(above) - 1
            self.changed_pairs_above += both
        else:
            self.judged += len(diagnoses)
            self.named += sum(bool(one.faults) for one in diagnoses)
            self.pairs += len(above) - 1
            self.pairs_above += both

    @property
    def cells(self) -> tuple[str, ...]:
        """Of healthy recordings: fault, named, suspect, twice in a row; of changed: found, fault, twice in a row."""
        known = self.verdicts.get
        fault, suspect = known((True, "fault"), 0), known((True, "suspect"), 0)
        return (
            f"{known((False, 'fault'), 0)} of {self.judged}",
            str(self.named),
            str(known((False, "suspect"), 0)),
            f"{self.pairs_above} of {self.pairs}",
            f"{fault + suspect} of {self.changed}",
            str(fault),
            f"{self.changed_pairs_above} of {self.changed_pairs}",
        )


def qube_machines(data: Path) -> Iterator[Machine]:
    """Yield the rotary pendulum; changed: u times 1.1."""
    loop = ss.Loop.load(ROOT / "examples" / "qube.toml")
    yield Machine(loop, qube.runs(data, loop), lambda held: [with_gain(run, qube.GAIN) for run in held])


def proposed_machines(data: Path) -> Iterator[Machine]:
    """Yield the rotary pendulum with the loop file that `init` writes, an axis."""
    loop = ss.Loop.load(ROOT / "examples" / "qube.toml")
    files = sorted((data / "real" / "qube").rglob("qube_*.*"))
    loop = ss.init(files, loop.columns).loop
    yield Machine(loop, qube.runs(data, loop), lambda held: [with_gain(run, qube.GAIN) for run in held])


def cranfield_machines(data: Path) -> Iterator[Machine]:
    """Yield the ball screw at each load; changed: seeded faults."""
    loop = ss.Loop.load(ROOT / "examples" / "cranfield.toml")
    for load in cranfield.LOADS:
        faulty = [run for name in cranfield.FAULTS for run in cranfield.runs(data, loop, name, load)[:RUNS_OF_FAULT]]
        yield Machine(loop, cranfield.runs(data, loop, "normal", load), lambda _, faulty=faulty: faulty)


def servo_machines(data: Path, gains: tuple[int, ...]) -> Iterator[Machine]:
    """Yield the hobby servo on each arm; changed: another mass."""
    for arm, (own, other) in sts3215.ARMS.items():
        loop, folder = sts3215.loop(arm, own), data / "real" / "sts3215"
        healthy, heavy = (sts3215.runs(folder, loop, mass, arm, gains) for mass in (own, other))
        yield Machine(loop, sorted(healthy, key=_name), lambda _, heavy=heavy: heavy[:MAX_JUDGED])


def _name(recording: ss.Recording) -> str:
    return recording.name


def xl330_machines(data: Path) -> Iterator[Machine]:
    """Yield the other hobby servo; changed: twice the u from one second on."""
    files = sorted((data / "real" / "xl330").glob("*.parquet"))
    loop = xl330.proposed_loop(files)
    runs = [ss.read(path, loop) for path in files]
    yield Machine(
        loop, runs, lambda held: [with_gain(run, xl330.GAIN, xl330.CHANGED_S / run.duration_s) for run in held]
    )


SETS: dict[str, Callable[[Path], Iterator[Machine]]] = {
    "qube": qube_machines,
    "qube, as proposed": proposed_machines,
    "cranfield": cranfield_machines,
    "sts3215, one gain": lambda data: servo_machines(data, sts3215.GAINS["kp 16"]),
    "sts3215, all gains": lambda data: servo_machines(data, sts3215.GAINS["kp 8 to 32"]),
    "xl330": xl330_machines,
}


def judge(machine: Machine, learned: int, numbers: Sequence[int], counts: Counts) -> None:
    """Judge what each draw of so many recordings leaves; a draw is the same whatever else is judged."""
    for number in numbers:
        rng = np.random.default_rng([learned, number])
        drawn = sorted(rng.choice(len(machine.healthy), learned, replace=False).tolist())
        held = [run for k, run in enumerate(machine.healthy) if k not in drawn][:MAX_JUDGED]
        try:
            baseline = ss.learn(machine.loop, [machine.healthy[k] for k in drawn])
        except ServoscopeError:
            counts.refused += 1
            continue
        counts.add([ss.diagnose(baseline, run) for run in held], changed=False)
        counts.add([ss.diagnose(baseline, run) for run in machine.changed(held)], changed=True)


def main() -> None:
    """Run the command line of this process."""
    command = parser(__doc__)
    command.add_argument("--set", choices=list(SETS), action="append", help="only this machine")
    command.add_argument("--draws", type=int, default=24, help="random draws of each number of recordings")
    command.add_argument("--learned", type=int, action="append", help="only so many recordings")
    command.add_argument("--half", choices=("tuning", "judged"), help="only this half of the draws")
    given = parse_with_data(command, "real/qube")
    numbers = range(given.draws)
    if given.half:
        numbers = numbers[: given.draws // 2] if given.half == "tuning" else numbers[given.draws // 2 :]
    rows, values = [], dict[str, str]()
    for name in given.set or SETS:
        machines = list(SETS[name](given.data))
        for learned in given.learned or LEARNED:
            counts = Counts()
            for machine in machines:
                if len(machine.healthy) - learned >= MIN_JUDGED:
                    judge(machine, learned, numbers, counts)
            if counts.judged:
                rows.append((name, str(learned), *counts.cells, str(counts.refused)))
                values |= {f"{name}.{learned}.false": rows[-1][2], f"{name}.{learned}.found": rows[-1][6]}
                print(rows[-1], file=sys.stderr, flush=True)
    heads = ("machine", "learned", "fault", "named", "suspect", "in a row", "found", "by fault", "in a row", "refused")
    note = "Healthy recordings: fault, named, suspect, in a row; changed ones: found, by fault alone, in a row."
    show([Table("Random draws", note, heads, tuple(rows))], given.json, values)


if __name__ == "__main__":
    main()
