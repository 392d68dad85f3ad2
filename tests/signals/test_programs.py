"""Logs of programs, after their makers' documents: halscope, frames with rows of names, lines with ISO times."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from logs import refusal
from zoo import motion
from zoo_outcomes import is_right

from servoscope.learning.proposal import propose_columns
from servoscope.models.loop import Columns
from servoscope.signals.readers import list_channels, read

HALSCOPE = Columns(time="time", reference="`joint.0.cmd`", input="`pid.0.output`", output="`joint.0.fb`")


def halscope(form: str) -> str:
    """Return a log of halscope (LinuxCNC, src/hal/utils/scope_files.c, write_log_file), new or earlier."""
    names, rows = ("joint.0.cmd", "pid.0.output", "joint.0.fb"), zip(*(motion()[name] for name in "ruy"), strict=True)
    if form == "new":
        head = f"# Sampling period is 10000000 ns\n{';'.join(names)}\n# Position: 0.5;0.5;0.5\n# Scale: 1;1;1\n"
        return head + "".join(";".join(f"{x:.14f}" for x in row) + "\n" for row in rows)
    lines = (" ".join(f"{name} {x:+.14f}" for name, x in zip(names, row, strict=True)) for row in rows)
    return "Sampling period is 10000000 nSec \n\n" + "".join(f"{line} \n" for line in lines)


@pytest.mark.parametrize("form", ["new", "by turns"])
@pytest.mark.parametrize("suffix", [".csv", ".log", ".txt"])
def test_halscope_of_linuxcnc(form: str, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"scope{suffix}"
    path.write_text(halscope(form))
    assert is_right(read(path, columns=HALSCOPE))


def test_a_damaged_log_of_halscope_is_refused(tmp_path: Path) -> None:
    for text, words in (
        ("# Sampling period is 10 ns\n", "without samples"),
        (halscope("new") + "1;2\n", "damaged log"),
    ):
        (tmp_path / "scope.csv").write_text(text)
        assert words in refusal(tmp_path / "scope.csv", columns=HALSCOPE)


@pytest.mark.parametrize("levels", [1, 2, 3])
@pytest.mark.parametrize("index", ["time", "Time [s]"])
def test_a_frame_with_several_rows_of_names(levels: int, index: str, tmp_path: Path) -> None:
    """pandas, "MultiIndex / advanced indexing": to_csv writes a row per level, and one for the name of the index."""
    groups = ["cmd", "drive", "axis"], ["a", "b", "c"]
    frame = pd.DataFrame({name: motion()[name] for name in "ruy"}, index=pd.Index(motion()["t"], name=index))
    names = [*zip(*groups[: levels - 1], ["setpoint", "current", "position"], strict=True)]
    frame.columns = pd.MultiIndex.from_tuples(names) if levels > 1 else [name for (name,) in names]
    frame.to_csv(tmp_path / "frame.csv")
    columns = propose_columns(tmp_path / "frame.csv", list_channels(tmp_path / "frame.csv"))
    assert is_right(read(tmp_path / "frame.csv", columns=columns))


@pytest.mark.parametrize("unit", ["ms", "[ms]", "(ms)"])
def test_a_row_of_units_that_holds_that_of_the_time_alone(unit: str, tmp_path: Path) -> None:
    """As TwinCAT Scope writes it where no channel has a unit."""
    rows = (",".join(map(str, row)) for row in zip(1e3 * motion()["t"], *(motion()[c] for c in "ruy"), strict=True))
    (tmp_path / "scope.csv").write_text("\n".join(["Time,SetPosition,ActTorque,ActPosition", f"{unit},,,", *rows]))
    columns = propose_columns(tmp_path / "scope.csv", list_channels(tmp_path / "scope.csv"))
    recording = read(tmp_path / "scope.csv", columns=columns)
    np.testing.assert_allclose(recording.t, motion()["t"], atol=1e-6)
    assert is_right(recording)


@pytest.mark.parametrize("zone", ["Z", "+00:00", "+02:00", ""])
@pytest.mark.parametrize("digits", [3, 6])
def test_lines_of_json_with_iso_times(zone: str, digits: int, tmp_path: Path) -> None:
    """ISO 8601, as loggers of messages write it beside the values."""
    stamps = (f"2024-01-31T12:00:{t:0{digits + 3}.{digits}f}{zone}" for t in motion()["t"])
    rows = zip(stamps, *(motion()[name] for name in "ruy"), strict=True)
    lines = (json.dumps(dict(zip(("time", "setpoint", "current", "position"), row, strict=True))) for row in rows)
    (tmp_path / "log.jsonl").write_text("\n".join(lines))
    columns = propose_columns(tmp_path / "log.jsonl", list_channels(tmp_path / "log.jsonl"))
    recording = read(tmp_path / "log.jsonl", columns=columns)
    np.testing.assert_allclose(recording.t, motion()["t"], atol=1e-6)
    assert is_right(recording)
