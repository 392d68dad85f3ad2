"""What the first command on a fresh machine costs beside the second; prints a Markdown table.

python benchmarks speed/first_verdict [--json]

Processor time of whole commands, children included, in processes of their own: with an empty cache of compiled code,
and again with what the first has left there.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from importlib.resources import files
from pathlib import Path

from tables import Table, parser, show

from servoscope.cli.exit import RAN

RIG = Path(str(files("servoscope"))) / "simulation" / "reference-rig.toml"


def rows() -> list[tuple[str, ...]]:
    """Time the commands."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        healthy, worn, learned = (str(Path(folder) / name) for name in ("healthy.csv", "worn.csv", "baseline.json"))
        run(["simulate", str(RIG), "-o", healthy, "--seed", "1"], folder)
        run(["simulate", str(RIG), "-o", worn, "--seed", "2", "--fault", "C_ie=1.2@30"], folder)
        run(["learn", str(RIG), healthy, "-o", learned], folder)
        commands = {
            "diagnose a minute, healthy": ["diagnose", learned, healthy],
            "diagnose a minute, a fault": ["diagnose", learned, worn],
            "demo": ["demo", "-o", str(Path(folder) / "demo")],
        }
        for words, command in commands.items():
            with tempfile.TemporaryDirectory() as fresh:
                (first, wall), (second, _) = (run(command, fresh) for _ in range(2))
            found.append((words, f"{first:.2f}", f"{second:.2f}", f"{first / second:.2f}", f"{wall:.1f}"))
    return found


def run(command: list[str], cache_folder: str) -> tuple[float, float]:
    """Return processor time and wall time of a command [s]."""
    before, begin = used(), time.monotonic()
    start = [sys.executable, "-m", "servoscope", *command]
    environment = os.environ | {"NUMBA_CACHE_DIR": cache_folder}
    done = subprocess.run(start, check=False, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    if done.returncode not in RAN:
        raise SystemExit(f"{' '.join(command)}: exit code {done.returncode}")
    return used() - before, time.monotonic() - begin


def used() -> float:
    """Return the processor time of all children so far [s]."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def main() -> None:
    """Run the command line of this process."""
    given = parser(__doc__).parse_args()
    heads = "processor time", "first, s", "second, s", "first over second", "first, wall, s"
    note = f"Caches empty for the first; load average before {os.getloadavg()[0]:.1f}."
    show([Table("First verdict", note, heads, tuple(rows()))], given.json)
