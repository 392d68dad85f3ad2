"""STS3215, a hobby servo with a pendulum: payloads weighed by runs of six seconds, at one gain and across gains.

    python benchmarks public/sts3215 [--data DIR] [--count N] [--json]

The mass of the healthy runs stands in the loop file (`payload_mass`). Ten runs with it are learned; others with it, and
runs with another mass on the same arm, are judged. u is the controller's P law before its limit.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from tables import Table, parse_with_data, parser, show

import servoscope as ss
from servoscope.core.errors import ServoscopeError
from servoscope.core.verdict import FOUND
from servoscope.signals.readers import read_parts

LIMIT = 1.0 / 0.1649  # of u = kp (r - y), where the duty is 1 (the authors' law)
ARMS = {0.1: (0.535, 0.969), 0.15: (0.535, 1.1682)}  # arm [m]: masses of the healthy and of the changed runs [kg]
GAINS = {"kp 16": (16,), "kp 8 to 32": (8, 12, 16, 24, 32)}
MOTIONS = "sin_sin", "sin_time_square"
LEARNED = 10


def loop(arm: float, mass: float) -> ss.Loop:
    """Return the loop file of the servo on an arm [m], whose healthy mass [kg] is known."""
    terms = ["viscous", "coulomb", "gravity", "load_friction", "offset"]
    columns = {"time": "t", "reference": "r", "input": "u", "output": "y", "resample": True}
    return ss.Loop.from_dict(
        {
            **{"name": "servo", "sample_rate": 100.0, "columns": columns, "input_limits": [-LIMIT, LIMIT]},
            "input_logged": "before_limiter",
            "plant": {"kind": "axis", "terms": terms, "payload_arm": arm, "payload_mass": mass},
            "monitor": {"cutoff": 4.0, "memory": 1.0},
        }
    )


def runs(folder: Path, settings: ss.Loop, mass: float, arm: float, gains: tuple[int, ...]) -> list[ss.Recording]:
    """Return the runs of some gains, mixed."""
    parts = read_parts(folder / f"mass{mass:g}_arm{arm:g}.parquet", settings, by="run")
    wanted = tuple(f"run={motion}_kp{gain}_" for motion in MOTIONS for gain in gains)
    chosen = [part for part in parts if any(name in part.name for name in wanted)]
    return [chosen[k] for k in np.random.default_rng(0).permutation(len(chosen))]


def main() -> None:
    """Print the table."""
    command = parser(__doc__)
    command.add_argument("--count", type=int, default=10, help="runs of each mass that are judged")
    given = parse_with_data(command, "real/sts3215")
    folder, rows = given.data / "real" / "sts3215", []
    for arm, (own, other) in ARMS.items():
        settings = loop(arm, own)
        for what, gains in GAINS.items():
            healthy = runs(folder, settings, own, arm, gains)
            learned = min(LEARNED, len(healthy) - 2)
            try:
                baseline = ss.learn(settings, healthy[:learned])
            except ServoscopeError as error:
                rows.append((f"{arm:g} m", what, str(learned), str(error), *[""] * 4))
                continue
            held_out = healthy[learned:][: given.count]
            false = sum(ss.diagnose(baseline, run).verdict in FOUND for run in held_out)
            changed = runs(folder, settings, other, arm, gains)[: given.count]
            told = [ss.diagnose(baseline, run) for run in changed]
            found = sum(one.verdict in FOUND for one in told)
            masses = [f.mass_kg for one in told for f in one.faults if f.mass_kg is not None]
            inside = sum(low <= other - own <= high for _, low, high in masses)
            median = f"{np.median([mass for mass, _, _ in masses]):.3f} kg" if masses else ""
            rows.append(
                (
                    *(f"{arm:g} m", what, str(learned), f"{false} of {len(held_out)}", f"{found} of {len(told)}"),
                    *(str(len(masses)), f"{median} of {other - own:.3f} kg", f"{inside} of {len(masses)}"),
                )
            )
            print(rows[-1], file=sys.stderr, flush=True)
    heads = ("arm", "gains", "learned", "false", "found", "weighed", "median payload", "truth in 95 % interval")
    note = f"Runs of 6 s at 100 Hz, motions {' and '.join(MOTIONS)}; `payload_mass` stands in the loop file."
    show([Table("STS3215: payloads of a hobby servo", note, heads, tuple(rows))], given.json)
