"""Tables of one value per row, records and databases: what comes out of them, and what is refused in one line."""

from __future__ import annotations

import json
import sqlite3
import zipfile
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from logs import as_expected, lines, refusal, signals, written

from servoscope.core.errors import RecordingError
from servoscope.models.loop import Columns
from servoscope.signals.readers import list_channels, read


def long_rows(names: dict[str, str], quality: str = "Good") -> list[str]:
    data = signals()
    return [f"{t};{names[k]};{x};{quality}" for k in names for t, x in zip(data["t"], data[k], strict=True)]


def test_values_of_bad_quality_are_missing(tmp_path: Path) -> None:
    rows = ["time;tag;value;quality", *long_rows({"r": "r", "u": "u", "y": "y"})]
    rows[20] = rows[20].replace("Good", "Bad")
    recording = read(written(tmp_path, rows), columns=Columns(time="time"))
    assert recording.samples == len(signals()["t"]) - 1
    assert [defect.kind for defect in recording.defects] == ["nan"]


def test_machines_under_one_name_are_told_apart_by_their_tags(tmp_path: Path) -> None:
    data = signals()
    rows = [f"{t},{m},{k},{x}" for m in ("p1", "p2") for k in "ruy" for t, x in zip(data["t"], data[k], strict=True)]
    path = written(tmp_path, ["_time,machine,_field,_value", *rows])
    names = [channel.name for channel in list_channels(path)]
    assert names == ["_time", "p1.r", "p2.r", "p1.u", "p2.u", "p1.y", "p2.y"]
    as_expected(read(path, columns=Columns(time="_time", reference="p2.r", input="p2.u", output="p2.y")))


def test_signals_of_different_clocks_are_refused(tmp_path: Path) -> None:
    data = signals()
    rows = [f"{t + 1e-3 * n};{k};{x}" for n, k in enumerate("ruy") for t, x in zip(data["t"], data[k], strict=True)]
    text = refusal(written(tmp_path, ["time;name;value", *rows]), columns=Columns(time="time"))
    assert "0% of their time stamps in common" in text


def test_a_log_beside_a_name_column_is_no_long_table(tmp_path: Path) -> None:
    path = written(tmp_path, [f"{line},{'name' if k == 0 else k}" for k, line in enumerate(lines())])
    assert [channel.name for channel in list_channels(path)] == ["t", "r", "u", "y", "name"]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("x.json", b'{"a": 3}', "no table in JSON"),
        ("x.jsonl", b'{"a": 1}\n{"a": ', "no table in JSON"),
        ("x.npz", b"PK\x03\x04 torn", "no plain arrays"),
        ("x.feather", b"ARROW1 torn", "damaged Feather"),
        ("x.db", b"SQLite format 3\0 torn", "damaged SQLite"),
        ("x.bag", b"#ROSBAG V2.0\n", "damaged bag"),
        ("x.db3", b"plain text", "is not SQLite"),
    ],
)
def test_what_is_damaged_is_refused_in_one_line(name: str, content: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    assert words in refusal(tmp_path / name)


def test_pickles_are_not_read(tmp_path: Path) -> None:
    np.save(tmp_path / "x.npy", np.array([{"t": 1}], dtype=object))
    assert "no plain arrays" in refusal(tmp_path / "x.npy")


def test_a_database_of_several_tables_is_read_table_by_table(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "x.db")) as database, database:
        for table in ("axis", "other"):
            database.execute(f"CREATE TABLE {table}(t REAL, r REAL, u REAL, y REAL)")
            values = zip(*(x.tolist() for x in signals().values()), strict=True)
            database.executemany(f"INSERT INTO {table} VALUES (?, ?, ?, ?)", values)
    columns = Columns(time="axis.t", reference="axis.r", input="axis.u", output="axis.y")
    as_expected(read(tmp_path / "x.db", columns=columns))
    apart = columns.model_copy(update={"output": "other.y"})
    assert "'other.y' was not sampled together with axis.r" in refusal(tmp_path / "x.db", columns=apart)


def test_a_bag_without_definitions_says_how_to_convert_it(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "x.db3")) as bag, bag:
        bag.execute("CREATE TABLE topics(id INTEGER, name TEXT, type TEXT, serialization_format TEXT)")
        bag.execute("CREATE TABLE messages(id INTEGER, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        bag.execute("INSERT INTO topics VALUES (1, '/axis', 'rig_msgs/msg/State', 'cdr')")
        bag.execute("INSERT INTO messages VALUES (1, 1, 0, x'00')")
    assert "ros2 bag convert" in refusal(tmp_path / "x.db3")


def test_records_under_the_suffix_of_a_text_file(tmp_path: Path) -> None:
    rows = [dict(zip("truy", map(float, row), strict=True)) for row in zip(*signals().values(), strict=True)]
    as_expected(read(written(tmp_path, [json.dumps(row) for row in rows], "x.log")))


def test_two_logs_in_an_archive_are_not_guessed(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as archive:
        for name in ("a.csv", "b.csv", "readme.md"):
            archive.writestr(name, "\n".join(lines()))
    assert "holds 2 files" in refusal(tmp_path / "x.zip")


def test_a_unit_in_a_cell_counts_beside_that_of_the_name(tmp_path: Path) -> None:
    data = signals()
    rows = [f"{t};{r};{u};{1e3 * y:.9f} mm" for t, r, u, y in zip(*data.values(), strict=True)]
    as_expected(read(written(tmp_path, ["t;r;u;y", *rows])))
    as_expected(read(written(tmp_path, ["t;r;u;y [cm]", *rows]), columns=Columns(output="0.01 * `y [cm]`")))


def test_a_protected_workbook_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "x.xlsx").write_bytes(
        b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(600) + "EncryptedPackage".encode("utf-16-le")
    )
    assert "protected by a password" in refusal(tmp_path / "x.xlsx")


def test_dates_count_from_the_first_row(tmp_path: Path) -> None:
    rows = [f"{1_772_784_000 + t:.2f},{r},{u},{y}" for t, r, u, y in zip(*signals().values(), strict=True)]
    recording = read(written(tmp_path, ["t,r,u,y", *rows]))
    assert recording.t[0] == 0.0 and (recording.began, recording.zone) == (1_772_784_000.0, "UTC")
    assert read(written(tmp_path, lines())).began is None


def test_a_frame_without_a_column_says_which_is_meant() -> None:
    with pytest.raises(RecordingError, match="did you mean Posn"):
        read({**signals(), "Posn": signals()["y"]}, columns=Columns(output="Pos"))
