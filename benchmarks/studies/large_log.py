"""Logs of 1 GB through `init`, `inspect`, `learn` and `diagnose`: times, and the largest resident size of each.

    python benchmarks studies/large_log [--json] [--rows N]

A log is a CSV of t, r, u and y of the reference rig at 100 Hz, whose motion repeats every 10 s. One is healthy; in the
other, leakage is doubled from the middle on. The files are in the cache of the system.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
from tables import Table, parser, show

from servoscope.cli.exit import RAN
from servoscope.models.loop import Loop
from servoscope.simulation import FaultEvent, reference, simulate

LOOP = Path(__file__).resolve().parents[2] / "src" / "servoscope" / "simulation" / "reference-rig.toml"
PERIODS = 420  # of 10 s, that are simulated; the log repeats them
GOAL_MB = 600


def periods(loop: Loop, faults: tuple[FaultEvent, ...]) -> dict[str, np.ndarray]:
    """Return r, u and y of the periods that a log repeats; the start of the simulation, from rest, is left out."""
    motion = np.tile(reference("multisine", 10.0, loop.sample_rate), PERIODS + 6)
    recording = simulate(loop, motion, faults=faults, seed=1)[0].rows(slice(motion.size - PERIODS * 1000, None))
    return {name: getattr(recording, name).round(7) for name in "ruy"}


def write_log(path: Path, rows: int, faults: tuple[FaultEvent, ...]) -> None:
    """Write a log of so many rows, with the faults in its second half."""
    loop = Loop.load(LOOP)
    healthy, later, length = periods(loop, ()), periods(loop, faults), PERIODS * 1000
    with path.open("wb") as file:
        file.write(b"t,r,u,y\n")
        for begin in range(0, rows, length):
            t = (np.arange(begin, begin + length) / loop.sample_rate).round(4)
            columns = later if begin >= rows / 2 else healthy
            table = pa.table({"t": t, **columns}).slice(0, rows - begin)
            pyarrow.csv.write_csv(table, file, pyarrow.csv.WriteOptions(include_header=False))


def run(*command: str, folder: Path) -> tuple[str, float, float, int]:
    """Return what a command of servoscope prints, its wall time [s], its CPU time [s], and its largest size [MB]."""
    start = time.perf_counter()
    with (folder / "printed").open("w+") as printed:
        process = subprocess.Popen([sys.executable, "-m", "servoscope", *command], cwd=folder, stdout=printed)
        _, status, usage = os.wait4(process.pid, 0)
        printed.seek(0)
        text = printed.read()
    if os.waitstatus_to_exitcode(status) not in RAN:
        sys.exit(f"{' '.join(command)}: status {status}\n{text}")
    return text, time.perf_counter() - start, usage.ru_utime + usage.ru_stime, round(usage.ru_maxrss * 1024 / 1e6)


def main() -> None:
    """Write the log, run the three commands, print what they took."""
    command = parser(__doc__)
    command.add_argument("--rows", type=int, default=27_000_000)
    given = command.parse_args()
    with tempfile.TemporaryDirectory(prefix="large-log-") as name:
        folder = Path(name)
        write_log(folder / "day.csv", given.rows, ())
        write_log(folder / "leak.csv", given.rows, (FaultEvent("leakage", 2.0, 0.0),))
        size = (folder / "day.csv").stat().st_size
        steps = (
            ("init", "day.csv", "--yes"),
            ("inspect", "day.csv", "--loop", "loop.toml"),
            ("learn", "loop.toml", "day.csv", "-o", "baseline.json"),
            ("diagnose", "baseline.json", "day.csv"),
            ("diagnose", "baseline.json", "leak.csv"),
        )
        rows, largest = [], 0
        for step in steps:
            text, wall, cpu, peak = run(*step, folder=folder)
            diagnosis = next(line.strip() for line in text.splitlines() if line.startswith("  "))
            verdict = diagnosis if step[0] == "diagnose" else ""
            label = f"{step[0]} {step[-1]}" if verdict else step[0]
            rows.append((label, f"{wall:.0f} s", f"{cpu:.0f} s", f"{peak} MB", verdict))
            largest = max(largest, peak)
    log = f"{given.rows / 1e6:.0f} million rows, {size / 1e9:.2f} GB"
    note = f"{log}; goal: {GOAL_MB} MB. Load of the machine: {os.getloadavg()[0]:.0f} on {os.cpu_count()} cores."
    made = Table("A log of 1 GB", note, ("command", "wall", "CPU", "largest size", "verdict"), tuple(rows))
    show([made], given.json, {"log": log, "largest": f"{largest} MB"})
