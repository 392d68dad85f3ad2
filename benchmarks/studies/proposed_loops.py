"""What init proposes for logs of one axis, and from the raw files of measured machines to a baseline.

    python benchmarks studies/proposed_loops [--data DIR] [--seeds 24] [--json]

The axis: a motor that moves a load by a belt, under a P-PI cascade, with dry friction, along moves that do not repeat
(tests/support/belt_axis.py). Each log is proposed for by itself, and learned from with what was proposed. Of measured
machines, `init` and the command that it names are run on the files as they are.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from belt_axis import INERTIA, write_belt_axis
from tables import Table, parser, show

import servoscope as ss
from servoscope.core.errors import ServoscopeError

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"
SHOWN = 60  # characters of a list of terms
# the files of a machine, and what its owner has to say: units that no name has, and which columns mean what
MACHINES: dict[str, tuple[str, str]] = {
    "cranfield": (
        "cranfield/normal.csv",
        "--columns 't=time,r=1e-3*set_point,u=current,y=1e-3*set_point - 1e-3*position_error' --where load=40",
    ),
    "eha_pump": (
        "eha_pump/exp_data_1_*.csv",
        "--columns 't=time[ms],r=2.5e-5*ADC1_Channel_13,u=ADC1_Channel_8,y=2.5e-5*ADC1_Channel_14'",
    ),
    "emps": ("emps/DATA_EMPS.mat", ""),
    "faster": ("faster/faster.parquet", ""),
    "qube": ("qube/*.csv", ""),
    "sts3215": ("sts3215/mass0.535_arm0.1.parquet", "--where trajectory=sin_sin,kp=16"),
    "xl330": ("xl330/*.parquet", ""),
    "ur10e": ("ur10e/identification_data__ur-20_02_06-20sec_10harm.parquet", "--urdf ur10e/*.urdf"),
    "tx40": ("tx40/tx40.parquet", "--urdf tx40/*.urdf"),
}


def belt_tables(seeds: int) -> list[Table]:
    """Return what is proposed for logs of the axis, and what is learned with it."""
    rows, cutoffs, inertias = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(seeds):
            log = write_belt_axis(Path(folder) / f"{seed}.csv", seed)
            proposal = ss.init(log)
            cutoff, plant = proposal.loop.cutoff, proposal.candidates[0].words
            try:
                learned = ss.learn(proposal.loop, [ss.read(log, proposal.loop)])
                inertia = dict(zip(learned.names, learned.theta, strict=True)).get("inertia", np.nan) / INERTIA
                gain = min((c.change for c in learned.detectability.changes if c.change is not None), default=np.nan)
            except ServoscopeError as error:
                inertia = gain = np.nan
                plant = f"{plant}: {error}"[-2 * SHOWN :]
            cutoffs.append(cutoff)
            inertias.append(inertia)
            rows.append((str(seed), f"{cutoff:g}", plant, f"{inertia:.3f}", f"{100.0 * gain:.0f} %"))
    spread = (
        f"{min(cutoffs):g} to {max(cutoffs):g} Hz",
        f"{max(cutoffs) / min(cutoffs):.2f}",
        f"{np.nanmin(inertias):.3f} to {np.nanmax(inertias):.3f}",
        str(int(np.sum(~(np.abs(np.array(inertias) - 1.0) <= 0.05)))),
    )
    heads = "cutoff", "largest / smallest", "inertia / truth", "logs that are off by more than 5 %, or not learned"
    note = "60 s at 250 Hz each; dry friction of 1.0, inertia 0.625, a belt that resonates at 45 Hz."
    columns = "log", "cutoff [Hz]", "plant", "inertia / truth", "smallest change that is detected"
    return [
        Table("Proposals for an axis with dry friction", note, heads, (spread,)),
        Table("Log by log", "The smallest change: of the fault that is detected best.", columns, tuple(rows)),
    ]


def run_command(words: list[str], folder: Path) -> tuple[int, str, float]:
    """Run a command of servoscope; return its exit code, what it printed, and its processor time [s]."""
    before = os.times()
    environment = {**os.environ, "COLUMNS": "160"}
    command = [sys.executable, "-m", "servoscope", *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=environment, check=False)
    after = os.times()
    return done.returncode, done.stdout + done.stderr, after.children_user - before.children_user


def machine_row(name: str, data: Path) -> tuple[str, ...]:
    """Return the two commands for the raw files of a machine, and what came of them."""
    pattern, options = MACHINES[name]
    files = sorted(data.glob(pattern))
    given = [str(next(data.glob(word))) if "*" in word and "urdf" in word else word for word in shlex.split(options)]
    with tempfile.TemporaryDirectory() as folder:
        _, told, seconds = run_command(["init", *map(str, files), *given, "--yes"], Path(folder))
        following = [line.strip() for line in told.splitlines() if line.strip().startswith("servoscope ")]
        learns = [words for line in following if (words := shlex.split(line)[1:])[:1] in (["learn"], ["arm"])]
        if learns:
            code, said, _ = run_command(learns[-1], Path(folder))
            outcome = "baseline" if code == 0 else said.strip()[:300]
        else:
            outcome = told.strip()[-300:]
        lines = len(told.splitlines())
    first = f"servoscope init {pattern} {options} --yes".replace("  ", " ")
    second = " ".join(learns[-1]).replace(f"{data}/", "") if learns else "-"
    return name, f"`{first}`", f"`servoscope {second}`"[:200], outcome, str(lines), f"{seconds:.1f}"


def cost_row() -> tuple[str, str]:
    """Return the processor time [s] of `init` of a minute at 1 kHz, with its imports and kernels from the cache."""
    with tempfile.TemporaryDirectory() as folder:
        log = write_belt_axis(Path(folder) / "minute.csv", 1, 60.0, 1000.0)
        words = ["init", str(log), "--yes", "-o", str(Path(folder) / "loop.toml")]
        run_command(words, Path(folder))
        return "init of a minute at 1 kHz, CSV", f"{min(run_command(words, Path(folder))[2] for _ in range(3)):.2f} s"


def main() -> None:
    """Run the command line of this process."""
    command = parser(__doc__)
    command.add_argument("--data", type=Path, default=DATA, help="folder of the recordings")
    command.add_argument("--seeds", type=int, default=24, help="logs of the axis")
    given = command.parse_args()
    started = time.process_time()
    made = belt_tables(given.seeds) if given.seeds else []
    heads = "machine", "first command", "second command", "outcome", "lines of init", "processor time of init [s]"
    data = given.data / "real"
    if data.is_dir():
        rows = tuple(machine_row(name, data) for name in MACHINES)
        made.append(Table("From raw files to a baseline", "Files as their authors published them.", heads, rows))
    made.append(Table("Cost", "Processor time, the best of three.", ("what", "time"), (cost_row(),)))
    show(made, given.json, {"seconds": f"{time.process_time() - started:.0f}"})


if __name__ == "__main__":
    main()
