"""Folders, patterns and archives stand for the files in them; what hangs or swells is refused in time."""

from __future__ import annotations

import gzip
import os
import zipfile
from pathlib import Path

import pytest
from commands import one_line, run
from logs import as_expected, lines, written

from servoscope.core.errors import RecordingError
from servoscope.core.workers import Workers
from servoscope.signals.readers import archives, read, readable_suffixes, reader_process
from servoscope.signals.readers.archives import expand_paths


def packed(path: Path, *names: str) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in names:
            archive.writestr(name, "\n".join(lines()))
    return path


def test_folders_patterns_and_archives_stand_for_their_files(tmp_path: Path) -> None:
    a, b = (written(tmp_path, lines(), name) for name in ("a.csv", "b.csv"))
    written(tmp_path, ["nothing"], "notes.docx")
    two = packed(tmp_path / "two.zip", "x/1.csv", "x/2.csv")
    suffixes = readable_suffixes()
    inside = [two / "x/1.csv", two / "x/2.csv"]
    assert expand_paths([tmp_path], suffixes) == [a, b, *inside]
    assert expand_paths([tmp_path / "[ab].*"], suffixes) == [a, b]
    as_expected(read(inside[1]))
    with pytest.raises(RecordingError, match=r"holds 2 files, name one of them: two\.zip/x/1\.csv"):
        read(two)
    with pytest.raises(RecordingError, match="no file has such a name"):
        expand_paths([tmp_path / "z*.csv"], suffixes)
    told = run("inspect", tmp_path / "*.csv")
    assert told.code == 0 and "a.csv" in told.out and "b.csv" in told.out


def test_the_directory_of_an_archive_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, opened = packed(tmp_path / "many.zip", *map("{}.csv".format, range(9))), []
    original = zipfile.ZipFile
    monkeypatch.setattr(archives.zipfile, "ZipFile", lambda *given: opened.append(given) or original(*given))
    for each in expand_paths([path], readable_suffixes()):
        as_expected(read(each))
    assert len(opened) == 1
    packed(path, "other.csv")  # a new archive under the same name is another one
    assert expand_paths([path], readable_suffixes()) == [path]
    as_expected(read(path))


def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "log.csv")
    one_line(run("inspect", tmp_path / "log.csv"), "is a pipe", "to a file first")


def test_what_swells_when_unpacked_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archives, "MIN_UNPACKED_LIMIT_BYTES", 1000)
    path = tmp_path / "x.csv.gz"
    path.write_bytes(gzip.compress(b"1,2\n" * 5_000_000))
    with pytest.raises(RecordingError, match="MB when unpacked, unpack it yourself"):
        read(path)


def test_a_reader_that_hangs_is_stopped_and_the_next_file_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "hanging.py").write_text("def open_it(path):\n    while True:\n        pass\n")
    path = written(tmp_path, lines(), "x.bin")
    monkeypatch.setattr(
        reader_process, "_workers", Workers(reader_process.LIMITS)
    )  # a worker finds what is on the path when it starts
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]))
    monkeypatch.setattr(reader_process, "BASE_S", 0.5)
    with pytest.raises(RecordingError, match=r"x\.bin: is a damaged Odd file \(it takes more than 0\.5 s of"):
        reader_process.open_bounded(path, "Odd", "hanging", "open_it", "hanging")
    monkeypatch.setattr(reader_process, "BASE_S", 30.0)
    opened = reader_process.open_bounded(path, "CSV", "servoscope.signals.readers.csv", "open_csv", "pyarrow")
    assert opened.columns == ("t", "r", "u", "y")
    assert sum(table.rows for table in opened.iter_chunks(opened.columns)) == 300
    reader_process._workers.close()


def test_help_groups_the_commands_and_shows_one() -> None:
    told = run("help")
    assert told.code == 0 and "Begin" in told.out and "Judge recordings" in told.out
    assert "BASELINE" in run("help", "verify").out
    assert run("help", "nothing").code == 2
