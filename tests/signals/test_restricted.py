"""Files read in a restricted process, as a service reads all of them: the same rows and errors, unpacking included."""

from __future__ import annotations

import gzip
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from shares import LOOP

from servoscope.core.errors import EmptyRecordingError, RecordingError
from servoscope.models.loop import Columns, Loop
from servoscope.service.sources.log_files import FileNames, FileVersion, FolderNames, LogFile, extract_rows, parse_file
from servoscope.service.sources.replay import ReplaySettings, ReplayTransport
from servoscope.signals.readers import archives, read, reader_process
from servoscope.signals.readers.formats import open_file
from servoscope.signals.readers.table import read_part

ROWS = [f"{k / 100},{k % 7},{k % 5 * 0.5},{k % 3}" for k in range(300)]
SETTINGS = FolderNames(kind="folder")


def outcome(path: Path, read_it: Callable[..., Any], loop: Loop = LOOP) -> Any:
    """Return what a file gives, the columns of its rows and what dates them, or its error."""
    file = LogFile(path.name, "press", "", FileVersion(path.stat().st_size, 0), 0.0)
    try:
        rows, failures = read_it(path.parent, file, FileNames(SETTINGS, ["press"]), SETTINGS, {"press": loop})
    except RecordingError as error:
        return type(error), str(error)
    found = {name: ([x.tolist() for x in one.samples.columns], one.offset) for name, one in rows.items()}
    return (
        found,
        failures,
        {name: {n: x.tolist() for n, x in one.samples.channels.items()} for name, one in rows.items()},
    )


def write(path: Path, *lines: str) -> None:
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("logs")
    write(made / "plain.csv", "t,r,u,y", *ROWS)
    write(made / "torn.csv", "# a comment", "t,r,u,y", *ROWS[:200], "2.0,1", *ROWS[200:])
    write(made / "word.csv", "t,r,u,y", *ROWS, "3.0,1,overrange,2")
    write(made / "empty.csv", "# nothing", "# at all")
    write(made / "not.parquet", "t,r,u,y", *ROWS)
    (made / "packed.csv.gz").write_bytes(gzip.compress((made / "plain.csv").read_bytes()))
    with zipfile.ZipFile(made / "packed.zip", "w") as archive:
        archive.write(made / "plain.csv", "day.csv")
    (made / "broken.csv.gz").write_bytes(b"\x1f\x8b" + bytes(100))
    (made / "swollen.csv.gz").write_bytes(gzip.compress(b"1,2\n" * 26_000_000, 1))
    pq.write_table(pa.table({name: np.zeros(4_000_000, np.int8) for name in "truy"}), made / "bomb.parquet")
    columns = {name: np.arange(3e5) + k for k, name in enumerate("truy")}
    pq.write_table(pa.table(columns), made / "long.parquet")
    return made


def test_the_outcome_is_the_same_and_nothing_is_done_with_a_file_here(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = sorted(path.name for path in folder.iterdir() if path.name != "long.parquet")
    plain = {name: outcome(folder / name, extract_rows) for name in names}
    for function in ("unpack", "_copy"):
        monkeypatch.setattr(archives, function, None)
    assert {name: outcome(folder / name, parse_file) for name in names} == plain
    assert plain["empty.csv"][0] is EmptyRecordingError and "row 302" in plain["word.csv"][1]
    assert "4000000 rows of 4 columns, 128 MB" in plain["bomb.parquet"][1]
    assert "MB when unpacked, unpack it yourself" in plain["swollen.csv.gz"][1]
    assert plain["packed.zip"] == plain["packed.csv.gz"] == plain["plain.csv"]
    assert len(plain["plain.csv"][0]["press"][0][0]) == 300
    assert not [*Path(reader_process._kept[(folder,)].name).iterdir()]  # what a file is unpacked to goes with it
    loop = LOOP.model_copy(update={"columns": Columns(covariates={"load": "10*u"})})
    assert outcome(folder / "plain.csv", parse_file, loop) == outcome(folder / "plain.csv", extract_rows, loop)


def test_a_link_that_leads_out_of_the_folder_cannot_be_read(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "link.csv").symlink_to(folder / "plain.csv")
    assert "cannot be read (Permission denied)" in outcome(tmp_path / "link.csv", parse_file)[1]


def test_recordings_are_replayed_as_they_are_read(folder: Path) -> None:
    settings, path = ReplaySettings(speed=0.0), folder / "packed.zip" / "day.csv"
    transport = ReplayTransport(settings, {"press": ((path,), LOOP)})
    (made,), expected = transport._streams["press"][0].recordings, read(path, LOOP)
    assert all(np.array_equal(x, y) for x, y in zip(made.columns, expected.columns, strict=True))
    assert (made.name, made.sample_rate) == (expected.name, expected.sample_rate)
    with pytest.raises(RecordingError, match=r"gone\.csv: no such file, check the path"):
        ReplayTransport(settings, {"press": ((folder / "gone.csv",), LOOP)})


def test_a_part_is_all_that_is_read_of_a_long_file(folder: Path) -> None:
    with read_part(1000) as part:
        opened = open_file(folder / "long.parquet")
        assert [table.rows for table in opened.iter_chunks(["t"])] == [65536]
    assert part.cut == {"long.parquet": 65536}
