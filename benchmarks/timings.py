"""How long commands take as a user sees them, and samples as a monitor does; prints a Markdown table.

python benchmarks/timings.py [--json]
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from importlib.resources import files
from pathlib import Path

from tables import Table, parser, show

import servoscope as ss

RIG = Path(str(files("servoscope"))) / "examples" / "reference-rig.toml"
REPEATS = 9
BUSY = 1.0  # load average from which a table is marked


def timings() -> Table:
    """Time commands in processes of their own, and the recursion in this one."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        healthy, suspect, learned = (str(Path(folder) / name) for name in ("healthy.csv", "suspect.csv", "b.json"))
        _servoscope("simulate", str(RIG), "-o", healthy, "--seed", "1")
        _servoscope("simulate", str(RIG), "-o", suspect, "--seed", "2", "--fault", "C_ie=1.2@30")
        _servoscope("learn", str(RIG), healthy, "-o", learned)
        bare = _median(lambda: _python("-c", "pass"))
        rows.append(("a bare interpreter", bare))
        rows.append(("import servoscope, beyond that", _median(lambda: _python("-c", "import servoscope")) - bare))
        jobs = (
            ("servoscope --help", ["--help"]),
            ("servoscope inspect, 60 s at 100 Hz", ["inspect", healthy, "--loop", str(RIG)]),
            ("servoscope learn, 60 s at 100 Hz", ["learn", str(RIG), healthy, "-o", str(Path(folder) / "again.json")]),
            ("servoscope diagnose, 60 s at 100 Hz, healthy", ["diagnose", learned, healthy]),
            ("servoscope diagnose, 60 s at 100 Hz, fault", ["diagnose", learned, suspect]),
        )
        rows += [(words, _median(partial(_servoscope, *arguments))) for words, arguments in jobs]
        monitor = ss.Monitor(ss.Baseline.load(learned))
        recording = ss.read(suspect, monitor.loop)
    signals = (recording.r, recording.u, recording.y)
    cells = [(words, f"{seconds:.3f} s") for words, seconds in rows]
    whole = _median(lambda: monitor.run(monitor.init(), *signals)) / recording.samples
    cells.append(("Monitor.run, per sample, a block of 6000", f"{1e6 * whole:.2f} us"))
    state = monitor.init()
    single = _median(lambda: [monitor.step(state, *w) for w in zip(*signals, strict=True)]) / recording.samples
    cells.append(("Monitor.step, per sample, called from Python", f"{1e6 * single:.2f} us"))
    busy = f" **The machine was busy (load {load:.1f}): to be repeated.**" if load >= BUSY else ""
    note = (
        f"Wall time, median of {REPEATS} after a run that is not counted; each command in a process of its own, with "
        f"the reference rig. The first run after installation compiles in addition.{busy}"
    )
    return Table("Timings", note, ("what", "time"), tuple(cells))


def _python(*words: str) -> None:
    subprocess.run([sys.executable, *words], check=True, stdout=subprocess.DEVNULL)


def _servoscope(*words: str) -> None:
    _python("-m", "servoscope", *words)


def _median(job: Callable[[], object]) -> float:
    seconds = []
    for _ in range(REPEATS + 1):
        start = time.perf_counter()
        job()
        seconds.append(time.perf_counter() - start)
    return sorted(seconds[1:])[REPEATS // 2]


if __name__ == "__main__":
    given = parser(__doc__).parse_args()
    show([timings()], given.json)
