"""A simulated axis of two masses: what is found with the temperature and without it, beside simple detectors.

python benchmarks studies/two_mass [--seed 0] [--faults 42] [--healthy 32] [--json]

The axis (`benchmarks/tools/two_mass.py`) has LuGre friction, clearance, cogging and torque ripple, at 18 to 34 degC.
Seven healthy days are learned; further healthy days and one day per fault are judged. The loop file is what `init`
proposes for the seven days. Named right: one fault, and the right one, of those that the plant has a name for.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from public.simple_detectors import detectors, judge
from tables import Table, parser, show
from tools import two_mass

import servoscope as ss
from servoscope.core.blas import with_one_blas_thread

LOOP = {
    "name": "axis of two masses",
    "sample_rate": two_mass.RATE,
    "plant": {"kind": "axis", "terms": ["viscous_by_direction", "coulomb", "offset"]},
    "monitor": {
        "cutoff": 3.5,
        "memory": 3.2,
        "frequencies": [1.0],
        "update_when": "moving",
        "rest_speed": 0.0095,
    },
}
COVARIATES = {"columns": {"covariates": {"temperature": "temperature"}}}
CUTOFF_HZ = 3.5  # of the inverse among the simple detectors
HALF_SPEED = 0.5
MASS = two_mass.HEALTHY.motor + two_mass.HEALTHY.load


class Name(NamedTuple):
    """What a fault of the table is called by the plant, and its size there."""

    faults: tuple[str, ...]
    ratio: float


def right_name(change: two_mass.Change) -> Name | None:
    """Return the name of a fault; None where the plant has none."""
    if change.kind == "friction":
        return Name(("dry_friction", "coulomb_friction"), change.size)
    if change.kind == "payload":
        return Name(("payload", "inertia"), 1.0 + two_mass.HEALTHY.load * (change.size - 1.0) / MASS)
    if change.kind == "motor constant":
        return Name(("motor_constant", "input_gain"), 1.0 / change.size)
    return None


class Score(NamedTuple):
    """What a detector said of all days."""

    name: str
    false: int
    found: tuple[bool, ...]
    named: int | None = None
    wrong: int | None = None
    inside: int | None = None  # sizes within their interval, of those named right


def product_score(
    name: str,
    baseline: ss.Baseline,
    healthy: Sequence[ss.Recording],
    faulty: Sequence[ss.Recording],
    changes: Sequence[two_mass.Change],
) -> Score:
    """Return the score of servoscope with a baseline."""
    false = sum(ss.diagnose(baseline, day).verdict == "fault" for day in healthy)
    found, named, wrong, inside = [], 0, 0, 0
    for day, change in zip(faulty, changes, strict=True):
        said = ss.diagnose(baseline, day)
        found.append(said.verdict in ("suspect", "fault"))
        if not said.faults:
            continue
        expected, fault = right_name(change), said.faults[0]
        if expected is None or len(said.faults) > 1 or fault.name not in expected.faults:
            wrong += 1
            continue
        named += 1
        low, high = fault.interval
        inside += low <= expected.ratio <= high
    return Score(name, false, tuple(found), named, wrong, inside)


def half_speed(baseline: ss.Baseline, healthy: Sequence[ss.Recording], worn: ss.Recording) -> tuple[int, str]:
    """Return how many healthy days at half the speed are called faulty, and the verdict on doubled friction there."""
    return sum(ss.diagnose(baseline, day).verdict == "fault" for day in healthy), ss.diagnose(baseline, worn).verdict


@with_one_blas_thread
def main() -> None:
    """Run the command line of this process."""
    command = parser(__doc__)
    command.add_argument("--seed", type=int, default=0, help="other days of the same axis")
    command.add_argument("--faults", type=int, default=len(two_mass.FAULTS), help="the first so many of the table")
    command.add_argument("--healthy", type=int, default=32, help="healthy days that are judged")
    command.add_argument("--half", type=int, default=20, help="healthy days at half speed")
    given = command.parse_args()
    learned, healthy = two_mass.learned_days(seed=given.seed), two_mass.healthy_days(given.healthy, seed=given.seed)
    changes = two_mass.FAULTS[: given.faults]
    faulty = two_mass.faulty_days(changes, seed=given.seed)
    baselines = {
        "servoscope": ss.learn(ss.Loop.from_dict(LOOP), learned),
        "servoscope, temperature logged": ss.learn(ss.Loop.from_dict(LOOP | COVARIATES), learned),
    }
    scores = [product_score(name, baseline, healthy, faulty, changes) for name, baseline in baselines.items()]
    for detector in detectors(two_mass.CYCLE_S, CUTOFF_HZ):
        judged = judge(detector, learned, [*healthy, *faulty])
        above = [score > judged.limit for score in judged.largest]
        scores.append(Score(detector.name, sum(above[: len(healthy)]), tuple(above[len(healthy) :])))
    summary = [
        (
            score.name,
            f"{score.false} of {len(healthy)}",
            f"{sum(score.found)} of {len(changes)}",
            *("-" if count is None else f"{count}" for count in (score.named, score.wrong)),
            "-" if score.inside is None else f"{score.inside} of {score.named}",
        )
        for score in scores
    ]
    kinds = []
    for kind in dict.fromkeys(change.kind for change in changes):
        cells = []
        for score in scores:
            hits = [hit for hit, change in zip(score.found, changes, strict=True) if change.kind == kind]
            cells.append(f"{sum(hits)} of {len(hits)}")
        kinds.append((kind, *cells))
    slow = [two_mass.record_day(1000 * given.seed + 900 + k, speed=HALF_SPEED) for k in range(given.half)]
    worn = two_mass.record_day(1000 * given.seed + 950, two_mass.Change("friction", 2.0), speed=HALF_SPEED)
    halves = []
    for name, baseline in baselines.items():
        false, verdict = half_speed(baseline, slow, worn)
        halves.append((name, f"{false} of {given.half}", verdict))
    heads = "detector", "false", "found", "named right", "named wrong", "sizes within their interval"
    tables = [
        Table(
            "Two masses: detectors",
            f"{len(learned)} healthy days learned; {len(healthy)} healthy days and {len(changes)} faults judged.",
            heads,
            tuple(summary),
        ),
        Table(
            "Two masses: faults",
            "How many of each kind are found, in three sizes, from the start and from the middle.",
            ("fault", *(score.name for score in scores)),
            tuple(kinds),
        ),
        Table(
            "Two masses: half speed",
            "Healthy days called faulty, and the verdict on doubled friction.",
            ("detector", "false", "doubled friction"),
            tuple(halves),
        ),
    ]
    show(tables, given.json, {f"{score.name}.found": row[2] for score, row in zip(scores, summary, strict=True)})
