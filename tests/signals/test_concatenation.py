"""Several files that are one recording, and columns that are called otherwise in some files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from logs import lines, written

from servoscope.core.errors import LoopError, RecordingError
from servoscope.models.loop import Columns, TextLayout
from servoscope.signals.readers import list_channels, read


def day(folder: Path) -> list[str]:
    """Write 300 rows as three files, whose order of names is not that of their numbers, and return all of them."""
    header, *rows = lines()
    for number, begin in ((1, 0), (2, 100), (10, 200)):
        written(folder, [header, *rows[begin : begin + 100]], f"part-{number}.csv")
    return [header, *rows]


def test_files_of_a_folder_are_one_recording(tmp_path: Path) -> None:
    whole = read(written(tmp_path, day(tmp_path), "whole.txt"))
    pattern = f"join:{tmp_path}/part-*.csv"
    listed = "join:" + ",".join(str(tmp_path / f"part-{number}.csv") for number in (10, 2, 1))
    for address in (pattern, listed):
        found = read(address)
        assert found.name == "part-1.csv to part-10.csv" and not found.defects and found.restart.sum() == 1
        for joined, plain in zip(found.columns, whole.columns, strict=True):
            np.testing.assert_array_equal(joined, plain)
    assert [channel.name for channel in list_channels(pattern)] == ["t", "r", "u", "y"]
    layout = Columns(text=TextLayout(header_row=1))
    assert read(pattern, columns=layout).samples == whole.samples


def test_a_column_that_one_file_lacks_is_named(tmp_path: Path) -> None:
    header, *rows = lines()
    written(tmp_path, [header, *rows[:100]], "a.csv")
    written(tmp_path, [header.replace("y", "ActPos"), *rows[100:]], "b.csv")
    with pytest.raises(RecordingError, match=r"'y' is missing in b\.csv, give its files the same columns"):
        read(f"join:{tmp_path}/*.csv")
    with pytest.raises(RecordingError, match="no file has such a name"):
        read(f"join:{tmp_path}/*.mat")
    with pytest.raises(RecordingError, match=r"no column 'y', .*Where files differ, write y \| OTHER"):
        read(tmp_path / "b.csv", columns=Columns(reference="r", input="u", output="y"))
    either = Columns(time="clock | t", output="2 * (y | ActPos)", input="`motor current` | u")
    a, b = (read(tmp_path / name, columns=either) for name in ("a.csv", "b.csv"))
    assert a.samples + b.samples == 300
    with pytest.raises(LoopError, match=r"one \| other where files differ"):
        read(tmp_path / "a.csv", columns=Columns(output="y & u"))
