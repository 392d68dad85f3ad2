"""From a log of five formats to a verdict: a fresh environment, an empty home, pip, three commands.

    python benchmarks studies/newcomer [--json] [--source PATH]

The logs are those of the tutorial, Monday's healthy one and Friday's, whose guide runs dry in its 40th second, as other
programs write them. A time is that of three commands; what the very first one compiles is in it.
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from tables import Table, parser, show

from servoscope.cli.exit import RAN
from servoscope.core.arrays import FloatArray
from servoscope.simulation.tutorial import HEADER, tutorial_log

ROOT = Path(__file__).resolve().parents[2]
DAYS = {"healthy": "monday", "suspect": "friday"}
Log = Mapping[str, FloatArray]  # name of a column -> its values


def read_day(day: str) -> Log:
    """Return the columns of a log of the tutorial."""
    names = HEADER.splitlines()[-1].split(";")
    rows = np.loadtxt(io.StringIO(tutorial_log(day)), delimiter=";", skiprows=HEADER.count("\n"))
    return dict(zip(names, rows.T, strict=True))


def write_csv(path: Path, log: Log) -> None:
    """Write what a German drive exports: decimal commas, a line of units."""
    lines = ["Achse 1", "Zeit;Sollposition;Istposition;Motorspannung", "ms;mm;mm;V"]
    lines += [";".join(f"{x:.4f}".replace(".", ",") for x in row) for row in zip(*log.values(), strict=True)]
    path.write_text("\n".join(lines), encoding="latin-1")


def write_mdf(path: Path, log: Log) -> None:
    """Write an ASAM MDF 4 file, its time in seconds."""
    from asammdf import MDF, Signal

    t, *others = log.items()
    signals = [Signal(x, t[1] / 1e3, name=name.split(" (")[0], unit=name[-3:-1].strip("(")) for name, x in others]
    with MDF(version="4.10") as file:
        file.append(signals)
        file.save(path)


def write_tdms(path: Path, log: Log) -> None:
    """Write a file of LabVIEW."""
    from nptdms import ChannelObject, TdmsWriter

    with TdmsWriter(str(path)) as file:
        file.write_segment([ChannelObject("Axis", name, x) for name, x in log.items()])


def write_sheet(path: Path, log: Log) -> None:
    """Write an Excel workbook: a title, names, rows."""
    import xlsxwriter

    with xlsxwriter.Workbook(str(path)) as book:
        sheet = book.add_worksheet("Log")
        sheet.write_row(0, 0, ["Axis X1"])
        sheet.write_row(1, 0, list(log))
        for column, x in enumerate(log.values()):
            sheet.write_column(2, column, x)


def write_mat(path: Path, log: Log) -> None:
    """Write a file of MATLAB: vectors under short names, SI units."""
    from scipy.io import savemat

    t, r, y, u = log.values()
    savemat(path, {"time": t / 1e3, "reference": r / 1e3, "position": y / 1e3, "voltage": u})


FORMATS: dict[str, tuple[str, Callable[[Path, Log], None]]] = {
    "CSV, decimal comma, units in a row": (".csv", write_csv),
    "MDF 4": (".mf4", write_mdf),
    "TDMS": (".tdms", write_tdms),
    "Excel": (".xlsx", write_sheet),
    "MATLAB": (".mat", write_mat),
}


def run(command: list[str], folder: Path, home: Path) -> tuple[str, float]:
    """Return what a command prints, and how many seconds it took; ends the program where it fails."""
    kept = {name: value for name, value in os.environ.items() if name.startswith(("PIP_", "SSL_", "http", "HTTP"))}
    start = time.perf_counter()
    done = subprocess.run(
        command,
        cwd=folder,
        env={**kept, "HOME": str(home), "PATH": os.environ["PATH"], "LANG": "C.UTF-8"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode not in RAN:
        sys.exit(f"{' '.join(command)}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout, time.perf_counter() - start


def judge(program: str, folder: Path, home: Path, suffix: str) -> tuple[str, float, int]:
    """Return the verdict on the suspect log, the seconds until then, and how many commands that took."""
    commands = (
        ["init", f"healthy{suffix}", "--yes"],
        ["learn", "loop.toml", f"healthy{suffix}", "-o", "baseline.json"],
        ["diagnose", "baseline.json", f"suspect{suffix}"],
    )
    told = [run([program, *command], folder, home) for command in commands]
    verdict = " ".join(told[-1][0].split("\n  What to check")[0].split("\n", 1)[1].split())
    return verdict, sum(seconds for _, seconds in told), len(commands)


def main() -> None:
    """Parse the command line, try all formats, print the table."""
    command = parser(__doc__)
    command.add_argument("--source", default=str(ROOT), help="what pip installs, with [formats] behind it")
    given = command.parse_args()
    with tempfile.TemporaryDirectory(prefix="newcomer-") as name:
        folder, home = Path(name), Path(name) / "home"
        home.mkdir()
        run([sys.executable, "-m", "venv", "venv"], folder, home)
        _, installed = run(["venv/bin/python", "-m", "pip", "install", "-q", f"{given.source}[formats]"], folder, home)
        rows, longest = [], 0.0
        for title, (suffix, write) in FORMATS.items():
            place = folder / suffix[1:]
            place.mkdir()
            for stem, day in DAYS.items():
                write(place / f"{stem}{suffix}", read_day(day))
            verdict, seconds, commands = judge(str(folder / "venv/bin/servoscope"), place, home, suffix)
            rows.append((title, str(commands), f"{seconds:.0f} s", verdict))
            longest = max(longest, seconds)
    note = "Monday's log of the tutorial is learned from, Friday's is judged."
    made = Table("From a log to a verdict", note, ("log", "commands", "time", "verdict"), tuple(rows))
    show([made], given.json, {"install": f"{installed:.0f} s", "longest": f"{longest:.0f} s"})
