"""Makes small lakes: Parquet by asset and day, with a leak, a corrupt file and an asset of garbage where wanted."""

from __future__ import annotations

import datetime
import os
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from servoscope.models.loop import Loop
from servoscope.signals import Recording
from servoscope.simulation import FaultEvent, reference, simulate

LOOP = Path(__file__).parents[2] / "src/servoscope/simulation/reference-rig.toml"
DAYS = ("2026-11-01", "2026-11-02")
ILL, CORRUPT, GARBAGE = "P1", "P2", "P3"


def loop() -> Loop:
    return Loop.load(LOOP)


def recorded(asset: int, day: int, seconds: float, leak: float = 1.0) -> Recording:
    faults = (FaultEvent("C_ie", leak, seconds / 2.0),) if leak != 1.0 else ()
    r = reference("multisine", seconds, 100.0)
    return simulate(loop(), r, faults=faults, seed=10 * asset + day)[0]


def table_of(x: Recording, day: int) -> pa.Table:
    begin = datetime.datetime.fromisoformat(DAYS[day]) + datetime.timedelta(hours=6)
    t = np.datetime64(begin, "us") + np.round(1e6 * x.t).astype("timedelta64[us]")
    return pa.table({"t": t, "r": x.r, "u": x.u, "y": x.y})


def write(path: Path, table: pa.Table, rows_per_group: int = 400) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path, row_group_size=rows_per_group)


def make(folder: Path, seconds: float = 15.0) -> Path:
    """Four assets on two supplies, two days each; the second day of three of them has something wrong."""
    for asset, supply in enumerate(("A", "A", "B", "B")):
        for day in (0, 1):
            path = folder / f"supply={supply}" / f"asset=P{asset}" / f"day={DAYS[day]}" / "part-0.parquet"
            leak = 1.5 if (f"P{asset}", day) == (ILL, 1) else 1.0
            table = table_of(recorded(asset, day, seconds, leak), day)
            if f"P{asset}" == GARBAGE and day == 1:  # a channel that is stuck
                table = table.set_column(3, "y", pa.array(np.zeros(table.num_rows)))
            write(path, table)
            os.utime(path, (1e9 + day, 1e9 + day))
    ruin(folder / "supply=B" / f"asset={CORRUPT}" / f"day={DAYS[1]}" / "part-0.parquet")
    return folder


def ruin(path: Path) -> None:
    """Overwrite the middle of a file, where its rows are."""
    content = bytearray(path.read_bytes())
    content[len(content) // 4 : len(content) // 2] = bytes(len(content) // 4)
    path.write_bytes(content)
