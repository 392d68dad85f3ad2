"""What the first command on a fresh machine costs beside the second; prints a Markdown table.

python benchmarks/speed.py first_verdict [--json]

Processor time of whole commands, children included, in processes of their own: with an empty cache of compiled code,
again with what the first has left there, and with an empty cache and without the kernels that come with an
installation. The kernels are made when the package is installed; without them the program says so and stops.
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

from servoscope.core.jit import cache

RIG = Path(str(files("servoscope"))) / "simulation" / "reference-rig.toml"
BARE = (  # the same command line, blind to the kernels that came with the installation
    "import sys, pathlib; from servoscope.core.jit import cache; cache.SHIPPED = pathlib.Path('/nowhere');"
    "from servoscope.cli import main; main()"
)


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
            times = []
            for bare in (False, True):
                with tempfile.TemporaryDirectory() as fresh:
                    times += [run(command, fresh, bare) for _ in range(1 if bare else 2)]
            (first, wall), (second, _), (alone, _) = times
            found.append(
                (words, f"{first:.2f}", f"{second:.2f}", f"{first / second:.2f}", f"{alone:.1f}", f"{wall:.1f}")
            )
    return found


def run(command: list[str], cache_folder: str, bare: bool = False) -> tuple[float, float]:
    """Return processor time and wall time of a command [s]."""
    before, begin = used(), time.monotonic()
    start = [sys.executable, *(("-c", BARE) if bare else ("-m", "servoscope")), *command]
    environment = os.environ | {"NUMBA_CACHE_DIR": cache_folder}
    subprocess.run(start, check=True, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return used() - before, time.monotonic() - begin


def used() -> float:
    """Return the processor time of all children so far [s]."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def main() -> None:
    """Run the command line of this process."""
    given = parser(__doc__).parse_args()
    if not cache.SHIPPED.is_dir():
        sys.exit("this installation has no kernels: install it again, without SERVOSCOPE_KERNELS=none")
    heads = (
        "processor time",
        "first, s",
        "second, s",
        "first over second",
        "first, without these kernels, s",
        "first, wall, s",
    )
    note = f"Caches empty for the first; load average before {os.getloadavg()[0]:.1f}."
    show([Table("First verdict", note, heads, tuple(rows()))], given.json)
