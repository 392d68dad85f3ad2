"""Years of one machine: seasons, wear, two repairs, another tool; false alarms, faults found, slow wear refused.

python benchmarks studies/year [--years 1] [--weeks 52] [--hour] [--json]

The motor axis of the tutorial is recorded for a minute each week and diagnosed with the baseline in force. Its viscous
friction follows the season by 10 %, and both frictions scatter by 1 % between recordings. What is announced (a season,
a repair, another tool) is learned from recordings of that week. A healthy verdict is learned in three weeks. Another
machine wears by 1 % a week, and every fourth week somebody calls it healthy. A simple detector, T^2 of nine features,
learns from the same recordings at the same moments. With --hour, a baseline is relearned from an hour instead, and
timed.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from public.simple_detectors import FeatureT2, judge
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
SEEDS_PER_YEAR = 10_000
WINDOW_S = 10.0  # of the simple detector


def simulated(seed: int, ratios: dict[str, float]) -> ss.Recording:
    """Return a minute of the axis with parameters relative to the file's, and 1 % of scatter in both frictions."""
    rng = np.random.default_rng(seed)
    states = {"viscous_friction": 1.0, "coulomb_friction": 1.0, **ratios}
    for key in ("viscous_friction", "coulomb_friction"):
        states[key] *= 1.0 + 0.01 * rng.standard_normal()
    events = [FaultEvent.parse(f"{key}={ratio:.6f}@0") for key, ratio in states.items()]
    loop = ss.Loop.from_dict(AXIS)
    return simulate(loop, motion(seed), faults=events, noise_u_std=0.02, noise_y_std=5e-6, seed=seed)[0]


def record(folder: Path, name: str, seed: int, ratios: dict[str, float]) -> Path:
    """Write such a minute; return its path."""
    write_recording(folder / name, simulated(seed, ratios))
    return folder / name


def learn_first(folder: Path, seed: int) -> Path:
    """Learn the first baseline of a machine; return its file."""
    files = [record(folder, f"first-{i}.csv", seed + i, {}) for i in range(LEARNED)]
    ss.learn(ss.Loop.from_dict(AXIS), files).save(folder / "baseline.json")
    return folder / "baseline.json"


@dataclass
class Machine:
    """What is true of a machine in a week."""

    ratios: dict[str, float] = field(default_factory=lambda: {"viscous_friction": 1.0, "coulomb_friction": 1.0})
    wear: float = 0.0
    dry: bool = False
    worn: bool = False  # whether the wear was found
    planted: int = 0

    def advance(self, week: int) -> None:
        """Let a week pass."""
        if ANNOUNCED.get(week) == "tool":
            self.ratios["inertia"] = 1.3
        if week >= WEAR_FROM and not self.worn:
            self.wear += WEAR_PER_WEEK
        if week == DRY_FROM:
            self.ratios["coulomb_friction"] *= DRY
            self.dry = True
        self.planted += week in (WEAR_FROM, DRY_FROM)

    def at(self, week: int) -> dict[str, float]:
        """Return the parameters in a week."""
        season = 1.0 + SEASON * np.sin(2.0 * np.pi * week / 52.0)
        return {**self.ratios, "viscous_friction": self.ratios["viscous_friction"] * season * (1.0 + self.wear)}

    @property
    def fault(self) -> str:
        """What is wrong, empty where nothing is."""
        return "wear" if self.wear else "dry friction" if self.dry else ""

    def repair(self) -> None:
        """End a fault; a new seal is looser by a tenth."""
        self.worn, self.wear, self.dry = self.worn or self.wear > 0.0, 0.0, False
        self.ratios["coulomb_friction"] = 0.9


class Servoscope:
    """A baseline file, relearned."""

    name = "servoscope"

    def __init__(self, folder: Path, first: Sequence[Path]) -> None:
        self.path = folder / "baseline.json"
        ss.learn(ss.Loop.from_dict(AXIS), list(first)).save(self.path)

    def finds(self, file: Path) -> bool:
        """Return whether a recording is a fault."""
        return ss.diagnose(self.path, file).verdict == "fault"

    def learn(self, files: Sequence[Path], occasion: str | None) -> bool:
        """Learn again; return whether it was refused."""
        try:
            ss.relearn(self.path, list(files), after=occasion)
        except BaselineError:
            return True
        return False


class Simple:
    """T^2 of features, learned from the recordings since the last repair."""

    name = "T^2 of features"

    def __init__(self, folder: Path, first: Sequence[Path]) -> None:
        self.files = list(first)

    def finds(self, file: Path) -> bool:
        """Return whether a recording is a fault."""
        loop = ss.Loop.from_dict(AXIS)
        healthy = [ss.read(path, loop) for path in self.files]
        scores = judge(FeatureT2(WINDOW_S), healthy, [ss.read(file, loop)])
        return scores.largest[0] > scores.limit

    def learn(self, files: Sequence[Path], occasion: str | None) -> bool:
        """Learn again."""
        self.files = [*(self.files if occasion in (None, "season") else ()), *files]
        return False


@dataclass
class Year:
    """What became of a year."""

    false: list[str] = field(default_factory=list)
    found: list[str] = field(default_factory=list)
    planted: int = 0
    quiet: int = 0  # weeks without fault and announcement
    refused: int = 0


def follow_year(detector: Servoscope | Simple, folder: Path, seed: int, weeks: int, recordings: int) -> Year:
    """Follow a machine with repairs, another tool and seasons."""
    machine, year = Machine(), Year()
    for week in range(1, weeks + 1):
        machine.advance(week)
        now, occasion = machine.at(week), ANNOUNCED.get(week)
        file = record(folder, f"week-{week}.csv", seed + 100 + week, now)
        reported = detector.finds(file)
        year.quiet += occasion is None and not machine.fault
        if occasion is None and reported and machine.fault:
            year.found.append(f"{machine.fault} in week {week}")
            machine.repair()
            now, occasion = machine.at(week), "repair"
            file = record(folder, f"repaired-{week}.csv", seed + 200 + week, now)
        elif occasion is None and reported:
            year.false.append(str(week))
        if occasion is not None or (week in HEALTHY and not reported):
            files = [
                record(folder, f"{file.stem}-{i}.csv", seed + 400 + 10 * week + i, now) for i in range(1, recordings)
            ]
            year.refused += detector.learn([file, *files], occasion)
        print(f"{detector.name}, week {week}: {'fault' if reported else 'no fault'} {occasion or ''}", file=sys.stderr)
    year.planted = machine.planted
    return year


def follow_creep(folder: Path) -> str:
    """Let a machine wear by 1 % a week, and add every fourth week to the baseline; return when that is refused."""
    path = learn_first(folder, 50)
    for week in range(CREEP_EVERY, round(MAX_WEAR / CREEP_PER_WEEK), CREEP_EVERY):
        file = record(folder, f"week-{week}.csv", 300 + week, {"viscous_friction": 1.0 + CREEP_PER_WEEK * week})
        try:
            ss.relearn(path, [file])
        except BaselineError:
            return f"week {week}"
    return "never"


def time_hour(folder: Path) -> Table:
    """Relearn a baseline from an hour, as after a repair."""
    path = learn_first(folder, 1)
    loop = ss.Loop.from_dict(AXIS)
    r = np.concatenate([motion(seed) for seed in range(60)])
    recording, _ = simulate(loop, r, noise_u_std=0.02, noise_y_std=5e-6, seed=1)
    began = time.process_time()
    ss.relearn(path, [recording], after="repair")
    rows = (("CPU time, s", f"{time.process_time() - began:.1f}"), ("samples", str(recording.samples)))
    return Table("A baseline relearned from an hour", "One recording, after a repair.", ("", "measured"), rows)


def compare(years: int, weeks: int, recordings: int) -> Table:
    """Follow years of machines with both detectors, and the creep."""
    rows = []
    for detector in (Servoscope, Simple):
        each = []
        for number in range(years):
            with tempfile.TemporaryDirectory() as folder:
                place, seed = Path(folder), SEEDS_PER_YEAR * number
                first = [record(place, f"first-{i}.csv", seed + 1 + i, {}) for i in range(LEARNED)]
                each.append(follow_year(detector(place, first), place, seed, weeks, recordings))
        false = sum(len(year.false) for year in each)
        with tempfile.TemporaryDirectory() as folder:
            creep = follow_creep(Path(folder)) if detector is Servoscope else "never"
        counts = (
            (false, sum(year.quiet for year in each)),
            *((sum(len(year.found) for year in each), sum(year.planted for year in each)),),
        )
        found = "; ".join(", ".join(year.found) or "nothing" for year in each)
        print(f"{detector.name}: false in {[year.false for year in each]}, found {found}", file=sys.stderr)
        refused = str(sum(year.refused for year in each)) if detector is Servoscope else "-"
        rows.append((detector.name, *(f"{count} of {of}" for count, of in counts), refused, creep))
    heads = (
        "detector",
        "false alarms in weeks",
        "faults found",
        "healthy weeks refused",
        "creep of 1 % a week refused in",
    )
    note = f"{years} years of {weeks} weeks; each occasion is learned from {recordings} recordings of that week."
    return Table("Years of one machine", note, heads, tuple(rows))


def main() -> None:
    """Run the years and the creep, or the hour."""
    command = parser(__doc__)
    command.add_argument("--years", type=int, default=1)
    command.add_argument("--weeks", type=int, default=52)
    command.add_argument("--recordings", type=int, default=4, help="from how many recordings each occasion is learned")
    command.add_argument("--hour", action="store_true", help="time a relearning from an hour instead")
    options = command.parse_args()
    if options.hour:
        with tempfile.TemporaryDirectory() as folder:
            table = time_hour(Path(folder))
    else:
        table = compare(options.years, options.weeks, options.recordings)
    show([table], options.json)
