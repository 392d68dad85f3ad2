"""A year of one machine: seasons, wear, two repairs, another tool; false alarms, faults found, slow wear refused.

python benchmarks/year.py [--weeks 52] [--hour] [--json]

The motor axis of the tutorial is recorded for a minute each week and diagnosed with the baseline in force. Its viscous
friction follows the season by 10 %, and both frictions scatter by 1 % between recordings. What is announced (a season,
a repair, another tool) is learned from recordings of that week. A healthy verdict is learned in three weeks. Another
machine wears by 1 % a week, and every fourth week somebody calls it healthy. With --hour, a baseline is relearned from
an hour instead, and timed.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from tables import Table, parser, show

import servoscope as ss
from servoscope.core.errors import BaselineError
from servoscope.signals.writers import write_recording
from servoscope.simulation import FaultEvent, simulate
from servoscope.simulation.tutorial import AXIS, motion

LEARNED = 4  # recordings of the first baseline
SEASON = 0.10  # of the viscous friction
ANNOUNCED = {8: "season", 24: "tool", 34: "season"}
HEALTHY = (3, 28, 46)  # weeks whose recording joins, if it is healthy
WEAR_FROM, WEAR_PER_WEEK = 14, 0.06  # of the viscous friction, until it is found
DRY_FROM, DRY = 40, 1.6  # Coulomb friction, over before
CREEP_PER_WEEK, CREEP_EVERY = 0.01, 4
MAX_WEAR = 0.5


def record(folder: Path, name: str, seed: int, ratios: dict[str, float]) -> Path:
    """Write a minute of the axis with parameters relative to the file's; return its path."""
    rng = np.random.default_rng(seed)
    states = {"viscous_friction": 1.0, "coulomb_friction": 1.0, **ratios}
    for key in ("viscous_friction", "coulomb_friction"):
        states[key] *= 1.0 + 0.01 * rng.standard_normal()
    events = [FaultEvent.parse(f"{key}={ratio:.6f}@0") for key, ratio in states.items()]
    loop = ss.Loop.from_dict(AXIS)
    recording, _ = simulate(loop, motion(seed), faults=events, noise_u_std=0.02, noise_y_std=5e-6, seed=seed)
    write_recording(folder / name, recording)
    return folder / name


def learn_first(folder: Path, seed: int) -> Path:
    """Learn the first baseline of a machine; return its file."""
    files = [record(folder, f"first-{i}.csv", seed + i, {}) for i in range(LEARNED)]
    ss.learn(ss.Loop.from_dict(AXIS), files).save(folder / "baseline.json")
    return folder / "baseline.json"


def follow_year(folder: Path, weeks: int, recordings: int) -> dict[str, str]:
    """Follow a machine with repairs, another tool and seasons; return counts."""
    path, ratios, wear = learn_first(folder, 1), {"viscous_friction": 1.0, "coulomb_friction": 1.0}, 0.0
    planted, detected, false, refused, reported = 0, list[str](), list[int](), 0, False
    for week in range(1, weeks + 1):
        occasion = ANNOUNCED.get(week)
        if occasion == "tool":
            ratios["inertia"] = 1.3
        if week >= WEAR_FROM and not any(one.startswith("wear") for one in detected):
            wear += WEAR_PER_WEEK
        if week == DRY_FROM:
            ratios["coulomb_friction"] *= DRY
        planted += week in (WEAR_FROM, DRY_FROM)
        faulty = wear > 0.0 or (week >= DRY_FROM and not any(one.startswith("dry") for one in detected))
        season = 1.0 + SEASON * np.sin(2.0 * np.pi * week / 52.0)
        now = {**ratios, "viscous_friction": ratios["viscous_friction"] * season * (1.0 + wear)}
        file = record(folder, f"week-{week}.csv", 100 + week, now)
        reported = ss.diagnose(path, file).verdict == "fault"
        if occasion is None and reported and faulty:
            detected.append(f"{'wear' if wear else 'dry friction'} in week {week}")
            wear, ratios["coulomb_friction"] = 0.0, 0.9  # a new seal is tighter, or less so
            now = {**ratios, "viscous_friction": season}
            file, occasion = record(folder, f"repaired-{week}.csv", 200 + week, now), "repair"
        elif occasion is None and reported:
            false.append(week)
        if occasion is not None or (week in HEALTHY and not reported):
            more = [record(folder, f"{file.stem}-{i}.csv", 400 + 10 * week + i, now) for i in range(1, recordings)]
            try:
                ss.relearn(path, [file, *more], after=occasion)
            except BaselineError:
                refused += 1
        print(f"week {week}: {'fault' if reported else 'no fault'} {occasion or ''}", file=sys.stderr)
    return {
        "false alarms": ", ".join(map(str, false)) or "0",
        "faults planted": str(planted),
        "found": "; ".join(detected),
        "healthy weeks refused": str(refused),
    }


def follow_creep(folder: Path) -> dict[str, str]:
    """Let a machine wear by 1 % a week, and add every fourth week to the baseline until that is refused."""
    path = learn_first(folder, 50)
    for week in range(CREEP_EVERY, round(MAX_WEAR / CREEP_PER_WEEK), CREEP_EVERY):
        file = record(folder, f"week-{week}.csv", 300 + week, {"viscous_friction": 1.0 + CREEP_PER_WEEK * week})
        try:
            ss.relearn(path, [file])
        except BaselineError:
            return {"creep refused in week": str(week)}
    return {"creep refused in week": "never"}


def time_hour(folder: Path) -> dict[str, str]:
    """Relearn a baseline from an hour, as after a repair."""
    path = learn_first(folder, 1)
    loop = ss.Loop.from_dict(AXIS)
    r = np.concatenate([motion(seed) for seed in range(60)])
    recording, _ = simulate(loop, r, noise_u_std=0.02, noise_y_std=5e-6, seed=1)
    began = time.perf_counter()
    ss.relearn(path, [recording], after="repair")
    return {"relearn of an hour, s": f"{time.perf_counter() - began:.1f}", "samples": str(recording.samples)}


def main() -> None:
    """Run the year, the creep or the hour."""
    command = parser(__doc__)
    command.add_argument("--weeks", type=int, default=52)
    command.add_argument("--recordings", type=int, default=4, help="from how many recordings each occasion is learned")
    command.add_argument("--hour", action="store_true", help="time a relearning from an hour instead")
    options = command.parse_args()
    with tempfile.TemporaryDirectory() as year, tempfile.TemporaryDirectory() as creep:
        if options.hour:
            found = time_hour(Path(year))
        else:
            found = {**follow_year(Path(year), options.weeks, options.recordings), **follow_creep(Path(creep))}
    show(
        [
            Table(
                "A year of one machine",
                f"Learned from {options.recordings} recordings each.",
                ("", "measured"),
                tuple(found.items()),
            )
        ],
        options.json,
    )


if __name__ == "__main__":
    main()
