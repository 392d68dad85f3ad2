"""How long `servoscope diagnose` takes from a start, and over a long recording; prints Markdown tables.

python benchmarks speed/from_file [--rows 10000000] [--fault] [--json]
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from importlib.resources import files
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as csv
import pyarrow.parquet as pq
from tables import Table, parser, show

import servoscope as ss
from servoscope.cli.exit import RAN
from servoscope.simulation import reference
from servoscope.simulation.closed_loop import LoopSimulation
from servoscope.simulation.measurement import NOISE_U_STD, NOISE_Y_STD

RIG = Path(str(files("servoscope"))) / "simulation" / "reference-rig.toml"
PIECE = 600_000  # rows that are simulated and written at a time
WIDER = 1.2  # of the leakage, from the middle of the recording on


def written(folder: Path, rows: int, fault: bool) -> list[Path]:
    """Write a recording of the reference rig as Parquet and as CSV; the motion repeats every minute."""
    loop = ss.Loop.load(RIG)
    minute = reference("profile", 60.0, loop.sample_rate)
    plants = [loop.plant, loop.plant.with_ratios({"C_ie": WIDER})]
    simulation, rng = LoopSimulation(loop, plants), np.random.default_rng(5)
    schema = pa.schema([(name, pa.float64()) for name in ("t", "r", "u", "y")])
    paths = [folder / "long.parquet", folder / "long.csv"]
    with pq.ParquetWriter(paths[0], schema) as columns, csv.CSVWriter(str(paths[1]), schema) as text:
        for begin in range(0, rows, PIECE):
            k = np.arange(begin, min(begin + PIECE, rows))
            r = minute[k % len(minute)]
            n_u, n_y = NOISE_U_STD * rng.standard_normal(len(k)), NOISE_Y_STD * rng.standard_normal(len(k))
            u, _, y = simulation.run((fault * (k >= rows // 2)).astype(np.int64), r, n_u, n_y)
            table = pa.table([k / loop.sample_rate, r, u, y + n_y], schema=schema)
            columns.write_table(table)
            text.write_table(table)
    return paths


def start(repeats: int = 9) -> Table:
    """Diagnose a minute, with no code compiled yet and with all of it."""
    imports = [_run("-c", "import servoscope")[0] for _ in range(repeats)]
    cells = [("import servoscope", *_spread(imports))]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        baseline, short = str(folder / "b.json"), {fault: str(folder / f"{fault}.parquet") for fault in (False, True)}
        for fault, path in short.items():
            _servoscope("simulate", str(RIG), "-o", path, "--seed", "1", *(["--fault", "C_ie=1.2@30"] * fault))
        _servoscope("learn", str(RIG), short[False], "-o", baseline)
        for fault, path in short.items():
            what = "diagnose a minute, a fault" if fault else "diagnose a minute, healthy"
            cold = []
            for number in range(3):
                cache = {"NUMBA_CACHE_DIR": str(folder / f"cache-{fault}-{number}")}
                cold.append(_servoscope("diagnose", baseline, path, **cache)[0])
            warm = [_servoscope("diagnose", baseline, path, **cache)[0] for _ in range(repeats)]
            cells += [(f"{what}, never run before", *_spread(cold)), (what, *_spread(warm))]
    note = "Whole commands, from the start of Python to its end; the package's byte code is there, as pip leaves it."
    return Table("Start", f"{note} {_load()}", ("command", "s, median", "s, least to most"), tuple(cells))


def _spread(times: list[float]) -> tuple[str, str]:
    return f"{sorted(times)[len(times) // 2]:.2f}", f"{min(times):.2f} to {max(times):.2f}"


def _load() -> str:
    return f"Load average {os.getloadavg()[0] if hasattr(os, 'getloadavg') else 0.0:.1f}."


def from_file(rows: int, fault: bool) -> Table:
    """Diagnose the files, each in a process of its own that has its code compiled already."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        baseline, short = str(folder / "b.json"), str(folder / "short.parquet")
        _servoscope("simulate", str(RIG), "-o", short, "--seed", "1")
        _servoscope("learn", str(RIG), short, "-o", baseline)
        _servoscope("simulate", str(RIG), "-o", short, "--seed", "2", *(["--fault", "C_ie=1.2@30"] * fault))
        _servoscope("diagnose", baseline, short)
        bare = _servoscope("diagnose", baseline, short)
        cells = [("Parquet, a minute", *_said(bare, 6000, Path(short)))]
        for path in written(folder, rows, fault):
            found = _servoscope("diagnose", baseline, str(path))
            cells.append((f"{path.suffix[1:]}, {rows} rows", *_said(found, rows, path)))
    note = f"Whole commands, {'a fault in the middle' if fault else 'healthy'}. {_load()}"
    return Table(
        "From file", note, ("file", "MB", "s", "s of processor time", "rows/s of it", "MB of memory"), tuple(cells)
    )


def _said(found: tuple[float, float, int], rows: int, path: Path) -> tuple[str, ...]:
    wall, cpu, memory = found
    return f"{path.stat().st_size / 1e6:.0f}", f"{wall:.1f}", f"{cpu:.1f}", f"{rows / cpu:.3g}", f"{memory / 1e6:.0f}"


def _servoscope(*words: str, **environment: str) -> tuple[float, float, int]:
    """Run a command; return its time, processor time [s] and largest resident memory [bytes]."""
    return _run("-m", "servoscope", *words, **environment)


def _run(*words: str, **environment: str) -> tuple[float, float, int]:
    given = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    begin = time.perf_counter()
    child = subprocess.Popen([sys.executable, *words], stdout=subprocess.DEVNULL, env=given | environment)
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode not in RAN:
        raise SystemExit(f"{' '.join(words)}: exit code {child.returncode}")
    memory = used.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return time.perf_counter() - begin, used.ru_utime + used.ru_stime, memory


def main() -> None:
    """Measure and print."""
    command = parser(__doc__)
    command.add_argument("--rows", type=int, default=10_000_000)
    command.add_argument("--fault", action="store_true", help="with a leak from the middle on")
    given = command.parse_args()
    show([start(), from_file(given.rows, given.fault)], given.json)
