"""Files read in a restricted process, as a service reads all of them: the same rows, numbers of rows and errors."""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from servoscope.core.errors import EmptyRecordingError, RecordingError
from servoscope.models.loop import TextLayout
from servoscope.signals.readers import csv
from servoscope.signals.readers.formats import open_file
from servoscope.signals.readers.reader_process import is_restricted, read_restricted
from servoscope.signals.readers.table import number_column, read_part

ROWS = [f"{k / 100},{k % 7},{k % 5 * 0.5},0" for k in range(300)]


def outcome(path: Path, text: TextLayout | None = None) -> Any:
    """Return what a file gives: of each piece the rows, their numbers, torn ones and columns; or its error."""
    try:
        opened = open_file(path, text)
        names = opened.columns[:4]
        return opened.columns, [
            (one.first_row, one.broken, one.share, [number_column(one, name, name).tolist() for name in names])
            for one in opened.iter_chunks(names)
        ]
    except RecordingError as error:
        return type(error), str(error)


def write(path: Path, *lines: str) -> None:
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("logs")
    write(made / "plain.csv", "t,r,u,y", *ROWS)
    write(made / "torn.csv", "# a comment", "t,r,u,y", *ROWS[:200], "2.0,1", *ROWS[200:])
    write(made / "turns.csv", "t,r,u,y", *ROWS, *(f"{k / 100},0.5,1,0.25" for k in range(300, 400)))
    write(made / "word.csv", "t,r,u,y", *ROWS, "3.0,1,overrange,2")
    write(made / "semicolons.txt", "t;r;u;y", *(row.replace(",", ";") for row in ROWS))
    write(made / "empty.csv", "# nothing", "# at all")
    write(made / "not.parquet", "t,r,u,y", *ROWS)
    columns = {name: np.arange(3e5) + k for k, name in enumerate("truy")}
    pq.write_table(pa.table(columns), made / "long.parquet")
    pq.write_table(pa.table({name: np.zeros(4_000_000, np.int8) for name in "truy"}), made / "bomb.parquet")
    return made


def test_the_outcome_is_the_same(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(csv, "CHUNK_BYTES", 2000)
    names = sorted(path.name for path in folder.iterdir())
    plain = {name: outcome(folder / name) for name in names}
    with read_restricted(folder):
        restricted = {name: outcome(folder / name) for name in names}
        commented = outcome(folder / "plain.csv", TextLayout(comment="t"))
    assert {name: whole(found) for name, found in restricted.items()} == {
        name: whole(found) for name, found in plain.items()
    }
    assert plain["empty.csv"][0] is EmptyRecordingError and "row 302" in plain["word.csv"][1]
    assert "4000000 rows of 4 columns, 128 MB" in plain["bomb.parquet"][1]
    assert len(restricted["long.parquet"][1]) == 5 and restricted["torn.csv"][1][0][1] == ((200, 203, "2.0,1"),)
    assert commented[0] == ("c0", "c1", "c2", "c3") and not is_restricted()


def whole(found: Any) -> Any:
    """Return an outcome without the pieces that it came in: processes read text in pieces of their own."""
    if not isinstance(found[1], list) or not found[1]:
        return found
    columns, pieces = found
    return (
        columns,
        [[*chain.from_iterable(one[-1][k] for one in pieces)] for k in range(4)],
        sum(len(one[1]) for one in pieces),
    )


def test_a_part_is_all_that_is_read_of_a_long_file(folder: Path) -> None:
    with read_restricted(folder), read_part(1000) as part:
        opened = open_file(folder / "long.parquet")
        assert [table.rows for table in opened.iter_chunks(["t"])] == [65536]
    assert part.cut == {"long.parquet": 65536}
