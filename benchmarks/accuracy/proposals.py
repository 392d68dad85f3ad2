"""From logs to a size by `init` alone: a slide and a joint, whose friction grows; simulated apart from the package.

    python benchmarks accuracy/proposals [--count N] [--json]

Three healthy logs are written as CSV; `init` makes the loop, nothing is edited, `learn` and `diagnose` follow. The
slide of `axis.py` has Coulomb friction that grows to 1.1 to 2 times its value within each log; that of the joint of
`arm.py`, with gravity and a belt, grows to 1.5 times. Healthy logs are judged as well.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from tables import Table, parser, show

import servoscope as ss
from accuracy import arm, axis

LEARNED = 3
RATIOS = 1.1, 2.0  # of Coulomb friction
JOINT_RATIO = 1.5
HEAD = "time [s],target position [{0}],torque [Nm],actual position [{0}]"


def slide(seed: int, ratio: float = 1.0) -> ss.Recording:
    """Return a log of the slide, whose Coulomb friction changes between a third and two thirds of it."""
    healthy = axis.AXES["ideal"]
    at = axis.SECONDS * np.random.default_rng([seed, 3]).uniform(1.0 / 3.0, 2.0 / 3.0)
    return axis.record(healthy, axis.moves(seed), seed, replace(healthy, coulomb=ratio * healthy.coulomb), at)


def joint(seed: int, ratio: float = 1.0) -> ss.Recording:
    """Return a log of the joint, whose Coulomb friction changes within it."""
    return arm.record(seed, arm.Arm(coulomb=ratio * arm.Arm().coulomb))


def write_log(recording: ss.Recording, path: Path, unit: str) -> Path:
    """Write a recording as CSV."""
    rows = np.column_stack([recording.t, recording.r, recording.u, recording.y])
    np.savetxt(path, rows, delimiter=",", header=HEAD.format(unit), comments="", fmt="%.9g")
    return path


def learn_by_init(record: Callable[[int], ss.Recording], unit: str) -> tuple[ss.Baseline, str]:
    """Return the baseline that `init` and `learn` make of logs, and the plant that was proposed."""
    with tempfile.TemporaryDirectory() as folder:
        logs = [write_log(record(seed), Path(folder) / f"{seed}.csv", unit) for seed in range(LEARNED)]
        proposal = ss.init(logs)
        return ss.learn(proposal.loop, [ss.read(log, proposal.loop) for log in logs]), proposal.candidates[0].words


def judged(
    baseline: ss.Baseline, record: Callable[[int, float], ss.Recording], ratios: Sequence[float]
) -> tuple[int, int, int, list[float]]:
    """Return how many logs were found, named `dry_friction` alone, with the truth in the interval; half-widths."""
    found, named, inside, widths = 0, 0, 0, []
    for k, ratio in enumerate(ratios):
        said = ss.diagnose(baseline, record(100 + k, ratio))
        found += said.verdict in ("suspect", "fault")
        if [fault.name for fault in said.faults] == ["dry_friction"]:
            low, high = said.faults[0].interval
            named += 1
            inside += low <= ratio <= high
            widths.append(0.5 * (high - low) / ratio)
    return found, named, inside, widths


def main() -> None:
    """Print the table."""
    command = parser(__doc__)
    command.add_argument("--count", type=int, default=40, help="logs of the slide; a quarter as many of the joint")
    given = command.parse_args()
    few = max(1, given.count // 4)
    machines = {
        "slide": (slide, "m", np.linspace(*RATIOS, given.count)),
        "joint with gravity": (joint, "rad", np.full(few, JOINT_RATIO)),
    }
    rows, values = [], {}
    for name, (record, unit, ratios) in machines.items():
        baseline, plant = learn_by_init(record, unit)
        false = judged(baseline, record, [1.0] * few)[0]
        found, named, inside, widths = judged(baseline, record, ratios.tolist())
        width = f"{100.0 * np.median(widths):.2f} %" if widths else ""
        cells = f"{found} of {len(ratios)}", f"{named} of {found}", f"{inside} of {named}"
        rows.append((name, plant, f"{false} of {few}", *cells, width))
        values |= {f"{name}.{what}": cell for what, cell in zip(("found", "named", "inside"), cells, strict=True)}
        values[f"{name}.half width"] = width
    heads = ("machine", "plant of `init`", "false", "found", "named", "truth in 95 % interval", "median half-width")
    note = f"60 s at {axis.RATE:g} Hz each, {LEARNED} healthy logs. Coulomb friction x {RATIOS[0]:g} to {RATIOS[1]:g}"
    note += f" on the slide, x {JOINT_RATIO:g} on the joint."
    show([Table("Logs to sizes by `init`", note, heads, tuple(rows))], given.json, values)
