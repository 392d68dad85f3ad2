"""A hydraulic cylinder as a linear plant, by columns, and as it is: how much of u each explains on a healthy day.

    python benchmarks accuracy/cylinder_plants [--picture FILE] [--json]

Seven production days are learned, a further one is compared: u behind the filters of the loop, beside what the healthy
coefficients make of y. What the rig adds to u itself are the steps of its 12 bits.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from tables import Table, parser, show

import servoscope as ss
from accuracy.cylinder import CYLINDER, loop_with
from accuracy.cylinder_days import RATE, day, learned_days
from servoscope.core.arrays import FloatArray
from servoscope.simulation import CylinderRig

SEED = 70000
BITS = 12
REST_SHARE = 0.02  # of the largest speed, below which the piston rests
PICTURE_S = (10.0, 25.0)
PLANTS: dict[str, dict[str, object]] = {
    "linear plant": {"kind": "polynomial", "order": 3},
    "columns": CYLINDER,
}


def inputs(baseline: ss.Baseline, recording: ss.Recording) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return filtered u [V] and what healthy coefficients make of y, each (N,), and where both are known."""
    g = baseline.pipeline().regression(recording.r, recording.u, recording.y, recording.restart)
    return g.eta, g.phi @ np.array(baseline.theta), g.ok


def phases(baseline: ss.Baseline, recording: ss.Recording) -> dict[str, FloatArray]:
    """Return masks (N,) of what the piston does."""
    y = recording.y
    speed = baseline.pipeline().kinematics.regression(y, y, y, recording.restart).phi[:, 1]
    slow = REST_SHARE * np.abs(speed).max()
    return {
        "extends": (speed > slow) & (y < CylinderRig.contact),
        "presses": (speed > slow) & (y >= CylinderRig.contact),
        "retracts": speed < -slow,
        "rests": np.abs(speed) <= slow,
        "all": np.ones(len(y), dtype=np.bool_),
    }


def main() -> None:
    """Print the table, and draw u."""
    command = parser(__doc__)
    command.add_argument("--picture", type=Path, help="draw u beside what each plant makes of y")
    given = command.parse_args()
    healthy, recording = learned_days(first=SEED), day("production", SEED + 100)
    # of the linear plant the inertia is negative
    baselines = {name: ss.learn(loop_with(plant), healthy, force=True) for name, plant in PLANTS.items()}
    explained = {name: inputs(baseline, recording) for name, baseline in baselines.items()}
    known = np.logical_and.reduce([ok for _, _, ok in explained.values()])
    u = explained["columns"][0]
    step = 2.0 * CylinderRig().limit / 2**BITS / np.sqrt(12.0)
    rows = []
    for phase, where in phases(baselines["columns"], recording).items():
        of = where & known
        left = [float(np.sqrt(np.mean((eta[of] - made[of]) ** 2))) for eta, made, _ in explained.values()]
        rows.append(
            (
                phase,
                f"{of.mean():.0%}",
                f"{np.sqrt(np.mean(u[of] ** 2)):.3f}",
                *(f"{x:.3f}" for x in left),
                f"{step:.4f}",
            )
        )
    heads = ("the piston", "of the time", "u, V", *(f"left by the {name}, V" for name in PLANTS), "steps of u, V")
    note = "Root mean squares behind the filters of the loop, one healthy day that was not learned."
    if given.picture is not None:
        draw(given.picture, recording, u, {name: made for name, (_, made, _) in explained.items()})
    values = dict(zip(("u", *PLANTS), rows[-1][2:], strict=False))
    show([Table("Cylinder, plants side by side", note, heads, tuple(rows))], given.json, values)


def draw(path: Path, recording: ss.Recording, u: FloatArray, made: dict[str, FloatArray]) -> None:
    """Draw a stretch of u, and what each plant leaves of it."""
    from matplotlib.figure import Figure

    at = slice(*(np.array(PICTURE_S) * RATE).astype(int).tolist())
    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    above.plot(recording.t[at], u[at], "k", label="u, the rig")
    for name, model in made.items():
        above.plot(recording.t[at], model[at], label=name)
        below.plot(recording.t[at], (u - model)[at], label=name)
    above.set_ylabel("u [V]")
    below.set(ylabel="u less the plant [V]", xlabel="t [s]")
    above.legend(loc="upper right")
    figure.savefig(path, metadata={"Software": None})
