"""Signals as rows, vectors in cells, a block per variable: the same motion comes out of each layout."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from logs import refusal
from zoo import motion

from servoscope.core.arrays import FloatArray
from servoscope.learning.proposal import propose_columns
from servoscope.models.loop import Columns
from servoscope.signals import Recording
from servoscope.signals.readers import list_channels, read


def logged(rows: int, rate: float = 100.0) -> dict[str, FloatArray]:
    """Return t [s], r, u and y of the zoo's motion, of another length and at another rate."""
    t = np.arange(rows) / rate
    return {name: t if name == "t" else np.interp(t, motion()["t"], x, period=3.0) for name, x in motion().items()}


def as_logged(recording: Recording, expected: dict[str, FloatArray]) -> None:
    for name in "ruy":
        np.testing.assert_allclose(getattr(recording, name), expected[name], atol=1e-6)
    np.testing.assert_allclose(recording.t - recording.t[0], expected["t"], atol=1e-6)


def proposed(path: Path) -> Columns:
    return propose_columns(path, list_channels(path))


# Matrices


def save_mat(path: Path, arrays: dict[str, Any]) -> Path:
    scipy.io.savemat(path.with_suffix(".mat"), arrays)
    return path.with_suffix(".mat")


def save_npz(path: Path, arrays: dict[str, Any]) -> Path:
    np.savez(path.with_suffix(".npz"), **arrays)
    return path.with_suffix(".npz")


@pytest.mark.parametrize("save", [save_mat, save_npz])
@pytest.mark.parametrize("rows", [40, 300, 5000])
@pytest.mark.parametrize("name", ["ans", "data"])
def test_to_file_of_simulink(save: Callable[..., Path], rows: int, name: str, tmp_path: Path) -> None:
    """Signals are rows, the first of them the time (MathWorks, "To File", format Array)."""
    signals = logged(rows)
    path = save(tmp_path / "log", {name: np.vstack(list(signals.values()))})
    assert [channel.name for channel in list_channels(path)] == ["time", f"{name}[1]", f"{name}[2]", f"{name}[3]"]
    columns = Columns(time="time", reference=f"{name}[1]", input=f"{name}[2]", output=f"{name}[3]")
    as_logged(read(path, columns=columns), signals)


@pytest.mark.parametrize("save", [save_mat, save_npz])
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("rows", [40, 300])
@pytest.mark.parametrize("joints", [2, 7, 39])
def test_the_length_of_the_time_says_which_side_the_samples_are(
    save: Callable[..., Path], turned: bool, rows: int, joints: int, tmp_path: Path
) -> None:
    signals = logged(rows)
    matrices = {name: np.outer(signals[name], np.arange(1.0, joints + 1)) for name in "ruy"}
    arrays = {"t": signals["t"], **{name: x.T if turned else x for name, x in matrices.items()}}
    path = save(tmp_path / "log", arrays)
    as_logged(read(path, columns=Columns(reference="r[0]", input="u[0]", output="y[0]")), signals)
    last = read(
        path, columns=Columns(reference=f"r[{joints - 1}]", input=f"u[{joints - 1}]", output=f"y[{joints - 1}]")
    )
    np.testing.assert_allclose(last.y, joints * signals["y"], atol=1e-6)


# Traces of CODESYS


def trace(signals: dict[str, FloatArray], names: dict[str, str], late_ms: float = 0.0) -> str:
    """Return a trace as CODESYS saves it: keys and values, then a block per variable with stamps in ms."""
    lines = ["[key]; [value]", "Version; 0x03050000", "Name; Application.Trace", "EveryNCycles; 1"]
    for number, (letter, name) in enumerate(names.items()):
        stamps = 1e3 * signals["t"] + late_ms * number
        lines += [f"{number}.Variable; {name}", f"{number}.Class; 14", f"{number}.YAxis; 0", f"{number}.Data; "]
        lines += [f"; {t:.0f}; {x:.9g}" for t, x in zip(stamps, signals[letter], strict=True)]
    return "\r\n".join(lines)


@pytest.mark.parametrize("suffix", [".csv", ".txt", ".trace"])
@pytest.mark.parametrize("rate", [50.0, 250.0, 1000.0])
@pytest.mark.parametrize(
    "names",
    [
        {"r": "GVL.Axis1.fSetPosition", "y": "GVL.Axis1.fActPosition", "u": "GVL.Axis1.fActTorque"},
        {"u": "App.PLC_PRG.rCurrent", "r": "App.PLC_PRG.rSetVelocity", "y": "App.PLC_PRG.rActVelocity"},
    ],
)  # fmt: skip
def test_a_trace_of_codesys(suffix: str, rate: float, names: dict[str, str], tmp_path: Path) -> None:
    signals = logged(300, rate)
    path = tmp_path / f"axis{suffix}"
    path.write_text(trace(signals, names))
    columns = proposed(path)
    assert (columns.reference, columns.input, columns.output) == (names["r"], names["u"], names["y"])
    as_logged(read(path, columns=columns), signals)


def test_a_trace_without_samples_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "axis.csv"
    path.write_text(trace({name: x[:0] for name, x in logged(3).items()}, {"u": "u", "y": "y"}))
    assert "trace without samples" in refusal(path)


# Vectors in cells


def write_parquet(path: Path, records: list[dict[str, Any]], fixed: int = 0) -> Path:
    table = pa.Table.from_pylist(records)
    if fixed:
        kind = pa.list_(pa.float64(), fixed)
        columns = {n: table[n].cast(kind) if pa.types.is_list(table[n].type) else table[n] for n in table.column_names}
        table = pa.table(columns)
    pq.write_table(table, path.with_suffix(".parquet"))
    return path.with_suffix(".parquet")


def write_lines(path: Path, records: list[dict[str, Any]]) -> Path:
    path.with_suffix(".jsonl").write_text("\n".join(map(json.dumps, records)))
    return path.with_suffix(".jsonl")


WRITERS = {
    "list": write_parquet,
    "fixed": lambda path, records: write_parquet(path, records, 3),
    "json": write_lines,
}


@pytest.mark.parametrize("write", WRITERS)
@pytest.mark.parametrize("rows", [60, 300])
def test_vectors_of_joints_in_cells(write: str, rows: int, tmp_path: Path) -> None:
    """One row per frame, with the vectors of all joints in it (LeRobot, "LeRobotDataset format", version 2.1)."""
    signals = logged(rows)
    records = [
        {"timestamp": t, "action": [r, 0.0, 2.0 * r], "observation.effort": [u, 0.1, 2.0 * u],
         "observation.state": [y, 0.0, 2.0 * y], "task": "pick", "frame_index": k}
        for k, (t, r, u, y) in enumerate(zip(*signals.values(), strict=True))
    ]  # fmt: skip
    path = WRITERS[write](tmp_path / "episode", records)
    names = [channel.name for channel in list_channels(path)]
    assert "observation.state[2]" in names and "observation.state" not in names
    columns = Columns(
        time="timestamp", reference="action[0]", input="observation.effort[0]", output="observation.state[0]"
    )
    as_logged(read(path, columns=columns), signals)


def test_a_list_per_experiment_is_taken_element_by_element(tmp_path: Path) -> None:
    signals = logged(200)
    experiments = [{"name": f"run {k}", **{name: x.tolist() for name, x in signals.items()}} for k in range(3)]
    path = tmp_path / "experiments.json"
    path.write_text(json.dumps(experiments))
    recording = read(path, columns=Columns(segment=("record",)))
    assert recording.samples == 600 and int(recording.run[-1]) == 2
    np.testing.assert_allclose(recording.y[400:], signals["y"], atol=1e-9)
