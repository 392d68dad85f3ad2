"""Writes the files of this folder; it was run once, on version 0.1.0, before the modules were moved and renamed.

    PYTHONPATH=src:tests python -m golden.write

They are what that version wrote, and `test_compatibility.py` holds all later code to them. So this is not run again
when the test fails; only when a format gets a new version, on purpose, and then for the files of that format. Loop
files (`*.toml`) were written by hand.
"""

from __future__ import annotations

import gzip
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import servoscope as ss
from golden import results
from golden.results import FOLDER
from servoscope.simulation import FaultEvent, reference, simulate

STOPPED_AT = 2500  # samples of each asset that the store has seen; the fault comes later


def table(path: Path, recordings: dict[str, ss.Recording], *, asset: bool = False) -> None:
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(one, name) for one in recordings.values()]) for name in "truy"
    }
    columns["t"] = np.round(columns["t"], 9)
    if asset:
        columns["asset"] = [name for name, one in recordings.items() for _ in range(one.samples)]
    split = {"use_dictionary": ["r", "asset"], "use_byte_stream_split": ["t", "u", "y"]}  # takes half the room
    pq.write_table(pa.table(columns), path, compression="zstd", compression_level=19, **split)


def recordings() -> None:
    rig, axis = ss.Loop.load(FOLDER / "rig.toml"), ss.Loop.load(FOLDER / "axis.toml")

    def record(seed: int, seconds: float, *faults: str, of: ss.Loop = rig) -> ss.Recording:
        events = [FaultEvent.parse(text) for text in faults]
        r = reference("multisine", seconds, of.sample_rate)
        noise = {"noise_u_std": 0.05, "noise_y_std": 1e-5} if of is axis else {}
        made, _ = simulate(of, r, faults=events, seed=seed, **noise)
        return results.quantised(made, 10 if of is axis else 20, 22 if of is axis else 18)

    for name, recording in {
        "healthy": record(1, 60.0),
        "suspect": record(2, 60.0, "C_ie=1.2@30"),
        "warm": record(3, 30.0, "C_ie=1.3@0"),
        "worn": record(4, 30.0, "p_s=0.85@0"),
        "axis": record(5, 40.0, of=axis),
        "axis-suspect": record(6, 40.0, "inertia=1.2@20", of=axis),
    }.items():
        table(FOLDER / f"{name}.parquet", {name: recording})
    fleet = {"a": record(7, 20.0), "b": record(8, 20.0, "p_s=0.8@8"), "c": record(9, 20.0, "beta=0.7@8")}
    table(FOLDER / "fleet.parquet", fleet, asset=True)


def baselines() -> None:
    results.command(FOLDER, "learn", "rig.toml", "healthy.parquet", "-o", "rig.json")
    results.command(FOLDER, "learn", "axis.toml", "axis.parquet", "-o", "axis.json")
    at = ("cold=healthy.parquet", "warm=warm.parquet", "--fault", "wear@cold=worn.parquet")
    results.command(FOLDER, "learn", "rig.toml", *at, "-o", "points.json")


def store(folder: Path) -> None:
    """Write the store of a service whose recordings were cut before the fault, and what a later run adds."""
    results.hall(folder)
    for name in ("healthy.parquet", "suspect.parquet"):
        whole = pq.read_table(FOLDER / name)
        pq.write_table(whole.slice(0, STOPPED_AT), folder / name)
    results.command(folder, "run", "hall.toml")
    halfway = FOLDER / "history.sqlite.gz"
    halfway.write_bytes(gzip.compress((folder / "history.sqlite").read_bytes(), mtime=0))
    write("history-halfway", results.history(folder))
    results.hall(folder, halfway)
    results.command(folder, "run", "hall.toml")
    write("history", results.history(folder))


def write(name: str, document: Any) -> None:
    text = json.dumps(document, separators=(",", ":"), sort_keys=True)
    (FOLDER / f"{name}.json.gz").write_bytes(gzip.compress(text.encode(), mtime=0))


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recordings()
        baselines()
        digests: dict[str, dict[str, str]] = {}
        kept: dict[str, Any] = {}
        for what, fleet, arrays in results.traces(folder):
            digests[what] = {key: results.digest(array) for key, array in arrays.items()}
            kept |= {f"{what}|{key}": results.thin(key, array, fleet) for key, array in arrays.items()}
        np.savez_compressed(FOLDER / "traces.npz", **kept)
        write("digests", {"arithmetic": results.arithmetic(), "traces": digests})
        write("commands", {key: results.documents(key, folder) for key in results.COMMANDS})
        loops = {path.name: ss.Loop.load(path) for path in sorted(FOLDER.glob("*.toml")) if path.stem != "service"}
        write("loops", {key: {"hash": loop.hash(), "loop": loop.to_dict()} for key, loop in loops.items()})
        shutil.rmtree(folder / "hall", ignore_errors=True)
        (folder / "hall").mkdir()
        store(folder / "hall")


if __name__ == "__main__":
    main()
