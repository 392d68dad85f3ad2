"""What like machines are worth to a new one: detection and false alarms by what it is learned from; a Markdown table.

python benchmarks studies/population [--machines 20] [--json]

The parameters of each machine are off by 4 % (standard deviation, each by itself), and those of each of its recordings
by another 1 %. Twenty machines with four healthy recordings each are known; new ones have few of their own. The
reference rig is known by its parameters, of the motor axis nothing is given. Judged are ten healthy recordings of each
new machine, and ten with a fault from the middle on. Beside it a baseline of one recording of each known machine, with
none of the new one: the detector that knows the kind and not the machine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
from rich.progress import Progress
from tables import Table, parser, show

import servoscope as ss
from servoscope.core.blas import with_one_blas_thread
from servoscope.simulation import FaultEvent, reference, simulate
from servoscope.simulation.tutorial import AXIS, motion

RIG = Path(str(files("servoscope"))) / "simulation" / "reference-rig.toml"
KNOWN, EACH = 20, 4  # machines, and their recordings
BETWEEN, WITHIN = 0.04, 0.01  # standard deviations of a parameter's logarithm, between machines and their recordings
JUDGED = 10
OWN = 8, 4, 2, 1  # recordings of a new machine
Draw = Callable[[dict[str, float], int, str], ss.Recording]


@dataclass(frozen=True)
class Kind:
    """One kind of machine."""

    name: str
    loop: ss.Loop
    parameters: tuple[str, ...]
    draw: Draw  # a recording of a machine with such ratios, with a seed and a fault
    fault: str


def kinds() -> Iterator[Kind]:
    """Yield the kinds of machines."""
    rig = ss.Loop.load(RIG)

    def rig_recording(ratios: dict[str, float], seed: int, fault: str) -> ss.Recording:
        loop = rig.model_copy(update={"plant": rig.plant.with_ratios(ratios)})
        events = [FaultEvent.parse(f"{fault}@30")] if fault else []
        return simulate(loop, reference("profile", 60.0, rig.sample_rate), faults=events, seed=seed)[0]

    yield Kind("reference rig", rig, rig.plant.parameters, rig_recording, "C_ie=1.2")
    axis = ss.Loop.from_dict(AXIS)
    plain = {**AXIS, "plant": {"kind": "polynomial", "order": 2, "friction": "coulomb", "offset": True}}

    def axis_recording(ratios: dict[str, float], seed: int, fault: str) -> ss.Recording:
        loop = axis.model_copy(update={"plant": axis.plant.with_ratios(ratios)})
        events = [FaultEvent.parse(f"{fault}@30")] if fault else []
        return simulate(loop, motion(seed), faults=events, noise_u_std=0.02, noise_y_std=5e-6, seed=seed)[0]

    names = ("inertia", "viscous_friction", "coulomb_friction")
    yield Kind("motor axis", ss.Loop.from_dict(plain), names, axis_recording, "viscous_friction=1.1")


def machine(kind: Kind, seed: int, count: int, fault: str = "") -> list[ss.Recording]:
    """Return recordings of one machine; the machine is drawn from `seed`, and its recordings go on from there."""
    rng = np.random.default_rng([seed, 7])
    own = rng.normal(0.0, BETWEEN, len(kind.parameters))
    found = []
    for i in range(count):
        x = own + rng.normal(0.0, WITHIN, len(kind.parameters))
        ratios = dict(zip(kind.parameters, np.exp(x).tolist(), strict=True))
        found.append(kind.draw(ratios, 1000 * seed + i, fault if i >= count - JUDGED else ""))
    return found


@with_one_blas_thread
def rows(machines: int, advance: Callable[[], None]) -> Iterator[tuple[str, ...]]:
    """Judge the recordings of new machines by what each was learned from; `advance` after each machine."""
    for kind in kinds():
        known = [machine(kind, seed, EACH) for seed in range(1, KNOWN + 1)]
        population = {f"machine {i}": ss.learn(kind.loop, some) for i, some in enumerate(known, 1)}
        common = ss.learn(kind.loop, [some[0] for some in known])
        counts = {(own, how): np.zeros(2, int) for own in OWN for how in ("alone", "with the population")}
        counts[0, "with no recording of its own"] = np.zeros(2, int)
        for seed in range(KNOWN + 1, KNOWN + 1 + machines):
            everything = machine(kind, seed, OWN[0] + 2 * JUDGED, kind.fault)
            own, judged = everything[: OWN[0]], everything[OWN[0] :]
            for (size, how), count in counts.items():
                like = population if how == "with the population" else {}
                count += alarms(common if not size else ss.learn(kind.loop, own[:size], population=like), judged)
            advance()
        total = machines * JUDGED
        for (size, how), (false, found) in counts.items():
            yield kind.name, f"{size}", how, f"{false} of {total}", f"{found} of {total}"


def alarms(baseline: ss.Baseline, recordings: Sequence[ss.Recording]) -> tuple[int, int]:
    """Return in how many healthy and in how many faulty recordings the monitor raises an alarm."""
    monitor = ss.Monitor(baseline)
    raised = [bool(monitor.run(monitor.init(), one.r, one.u, one.y)[1].exceeded.any()) for one in recordings]
    return sum(raised[:JUDGED]), sum(raised[JUDGED:])


def main() -> None:
    """Run the command line of this process."""
    command = parser(__doc__)
    command.add_argument("--machines", type=int, default=20, help="new machines of each kind")
    given = command.parse_args()
    heads = ("machines", "recordings of its own", "learned", "alarms, healthy", "alarms, fault")
    with Progress(transient=True) as bar:
        task = bar.add_task("new machines", total=2 * given.machines)
        found = tuple(rows(given.machines, lambda: bar.advance(task)))
    note = f"{given.machines} new machines of each kind beside {KNOWN} known ones."
    show([Table("Population", note, heads, found)], given.json)
