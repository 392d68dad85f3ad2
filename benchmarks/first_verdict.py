"""What a first verdict costs after the installation, beside a second one, with and without kernels made ahead.

python benchmarks/first_verdict.py [--json]
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from tables import Table, parser, show

PROJECT = Path(__file__).resolve().parent.parent
REPEATS = 3  # of each; the least counts, for a busy machine only adds


def timings(work: Path) -> tuple[Table, dict[str, str]]:
    """Time commands whose caches are empty, then filled; on a copy of the sources with kernels and one without."""
    sys.path.insert(0, str(PROJECT))
    from hatch_build import KERNELS, compile_kernels, copy_sources  # what installing runs

    ahead, plain = work / "ahead", work / "plain"
    begin = _used()
    copy_sources(PROJECT / "src", plain)
    copy_sources(PROJECT / "src", ahead)
    compile_kernels(plain, ahead / KERNELS)
    made = _used() - begin
    size = sum(path.stat().st_size for path in (ahead / KERNELS).iterdir()) / 1e6
    commands = {"diagnose, healthy": "diagnose d/baseline.json d/healthy.csv"}
    commands |= {"diagnose, a fault": "diagnose d/baseline.json d/suspect.csv", "demo": "demo -o d"}
    _run(plain, work, work / "any", commands["demo"])
    rows = []
    for name, command in commands.items():
        cells, second = [], 0.0
        for sources, repeats in ((ahead, REPEATS), (plain, 1)):
            cache = work / f"{sources.name} {name}"
            first = min(_run(sources, work, cache / str(number), command) for number in range(repeats))
            second = min(_run(sources, work, cache / "0", command) for _ in range(REPEATS))
            cells += [f"{first:.1f} s", f"{second:.1f} s", f"{first / second:.2f}"]
        rows.append((name, *cells))
    note = f"Processor time from the start of Python to its end; the least of {REPEATS} if nothing compiles."
    columns = (
        "a minute at 100 Hz",
        "first",
        "second",
        "ratio",
        "first, compiling",
        "second, compiled",
        "ratio, compiling",
    )
    values = {"kernels.size": f"{size:.1f} MB", "kernels.time": f"{made:.0f} s"}
    return Table("First verdict", note, columns, tuple(rows)), values


def _run(sources: Path, work: Path, cache: Path, command: str) -> float:
    variables = {"PYTHONPATH": str(sources), "NUMBA_CACHE_DIR": str(cache), "MPLCONFIGDIR": str(cache)}
    cache.mkdir(parents=True, exist_ok=True)
    before = _used()
    argv = [sys.executable, "-m", "servoscope", *command.split()]
    subprocess.run(argv, cwd=work, env=os.environ | variables, check=True, capture_output=True)
    return _used() - before


def _used() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    asked = parser(__doc__).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        table, values = timings(Path(folder))
    show([table], asked.json, values)
