"""How much processor time commands and a monitor take; prints a Markdown table.

python benchmarks speed/timings [--json]
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from importlib.resources import files
from pathlib import Path

from accuracy.unknown import changed
from tables import Table, parser, show

import servoscope as ss
from servoscope.cli.exit import RAN

RIG = Path(str(files("servoscope"))) / "simulation" / "reference-rig.toml"
REPEATS = 5


def timings() -> Table:
    """Time commands in processes of their own, and the recursion in this one."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        healthy, suspect, learned = (str(Path(folder) / name) for name in ("healthy.csv", "suspect.csv", "b.json"))
        _servoscope("simulate", str(RIG), "-o", healthy, "--seed", "1")
        _servoscope("simulate", str(RIG), "-o", suspect, "--seed", "2", "--fault", "C_ie=1.2@30")
        _servoscope("learn", str(RIG), healthy, "-o", learned)
        late = str(Path(folder) / "late.csv")  # u acts a sample later from half-way on: no fault of the list
        changed("delay", "profile", 0, 3).to_frame().to_csv(late, index=False)
        bare = _median(lambda: _python("-c", "pass"))
        rows.append(("a bare interpreter", bare))
        rows.append(("import servoscope, beyond that", _median(lambda: _python("-c", "import servoscope")) - bare))
        jobs = (
            ("servoscope --help", ["--help"]),
            ("servoscope inspect, 60 s at 100 Hz", ["inspect", healthy, "--loop", str(RIG)]),
            ("servoscope learn, 60 s at 100 Hz", ["learn", str(RIG), healthy, "-o", str(Path(folder) / "again.json")]),
            ("servoscope diagnose, 60 s at 100 Hz, healthy", ["diagnose", learned, healthy]),
            ("servoscope diagnose, 60 s at 100 Hz, fault", ["diagnose", learned, suspect]),
            ("servoscope diagnose, 60 s at 100 Hz, unknown change", ["diagnose", learned, late]),
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
    cells.append(("load average of the machine before", f"{load:.1f}"))
    note = (
        f"Processor time, median of {REPEATS} after a run that is not counted; each command in a process of its own, "
        "with the reference rig. The first run after installation compiles in addition. On a machine that is busy with "
        "other work even processor time is longer."
    )
    return Table("Timings", note, ("what", "time"), tuple(cells))


def figures(table: Table) -> dict[str, str]:
    """Return the times that stand alone in sentences of documents."""
    times = dict(table.rows)
    return {
        "diagnose.healthy": times["servoscope diagnose, 60 s at 100 Hz, healthy"],
        "diagnose.fault": times["servoscope diagnose, 60 s at 100 Hz, fault"],
        "monitor.step": times["Monitor.step, per sample, called from Python"],
        "monitor": times["Monitor.run, per sample, a block of 6000"],
    }


def _python(*words: str) -> None:
    done = subprocess.run([sys.executable, *words], check=False, stdout=subprocess.DEVNULL)
    if done.returncode not in RAN:
        raise SystemExit(f"{' '.join(words)}: exit code {done.returncode}")


def _servoscope(*words: str) -> None:
    _python("-m", "servoscope", *words)


def _processor_time() -> float:
    """Return the processor time of this process and of those that it waited for [s]; others do not count."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def _median(job: Callable[[], object]) -> float:
    seconds = []
    for _ in range(REPEATS + 1):
        start = _processor_time()
        job()
        seconds.append(_processor_time() - start)
    return sorted(seconds[1:])[REPEATS // 2]


def main() -> None:
    """Measure and print."""
    given = parser(__doc__).parse_args()
    table = timings()
    show([table], given.json, figures(table))
