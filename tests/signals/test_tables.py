"""Files of every kind, and files that are not what they seem."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from logs import as_expected, lines, mat5, mat73, parquet, refusal, signals, written

from servoscope.core.errors import NotEnoughError
from servoscope.models.loop import Columns
from servoscope.signals.readers import list_channels, read

# Kinds of text


@pytest.mark.parametrize(
    ("delimiter", "decimal"),
    [(",", "."), (", ", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), ("   ", ".")],
)
def test_delimiters_and_decimal_signs(tmp_path: Path, delimiter: str, decimal: str) -> None:
    as_expected(read(written(tmp_path, lines(delimiter, decimal))))


@pytest.mark.parametrize("name", ["x.CSV", "x.txt", "x.tsv", "x.dat"])
def test_text_under_other_suffixes(tmp_path: Path, name: str) -> None:
    as_expected(read(written(tmp_path, lines(), name)))


def test_the_name_is_the_files(tmp_path: Path) -> None:
    assert read(written(tmp_path, lines())).name == "x.csv"


def test_a_file_without_a_header_has_numbered_columns(tmp_path: Path) -> None:
    path = written(tmp_path, lines(header=False))
    assert [info.name for info in list_channels(path)] == ["c0", "c1", "c2", "c3"]
    as_expected(read(path, columns=Columns(time="c0", reference="c1", input="c2", output="c3")))
    assert "no column 'r'; say where the signals stand: --columns 't=..., r=..., u=..., y=...'" in refusal(path)
    assert "or [columns] in the loop file; the file has c0, c1, c2, c3; if a line of it has their names" in refusal(
        path
    )


def test_blanks_in_the_header_do_not_matter(tmp_path: Path) -> None:
    as_expected(read(written(tmp_path, [" t , r,u ,\ty", *lines()[1:]])))


def test_quotes_in_the_header_do_not_matter(tmp_path: Path) -> None:
    as_expected(read(written(tmp_path, ['"t","r","u","y"', *lines()[1:]])))


def test_a_byte_order_mark_does_not_matter(tmp_path: Path) -> None:
    as_expected(read(written(tmp_path, lines(), encoding="utf-8-sig")))


def test_utf_16_is_read(tmp_path: Path) -> None:
    as_expected(read(written(tmp_path, lines("\t"), encoding="utf-16")))


def test_latin_1_is_read(tmp_path: Path) -> None:
    path = written(tmp_path, [*lines()[:1][0].replace("u", "µ").split("|"), *lines()[1:]], encoding="latin-1")
    as_expected(read(path, columns=Columns(input="µ")))


def test_comments_do_not_matter(tmp_path: Path) -> None:
    rows = lines()
    as_expected(read(written(tmp_path, ["# rig 7", "% 100 Hz, after service", *rows[:50], "# pause", *rows[50:]])))


@pytest.mark.parametrize("line", ["# " + "x" * 1000, "key {}," + "x" * 1000])
def test_much_text_above_the_table_does_not_matter(tmp_path: Path, line: str) -> None:
    as_expected(read(written(tmp_path, [*map(line.format, range(100)), *lines()])))
    as_expected(read(written(tmp_path, [*(line.format(k)[:9] for k in range(500)), *lines()])))


def test_a_line_without_an_end_is_refused(tmp_path: Path) -> None:
    assert "first line is longer than 4 MB" in refusal(written(tmp_path, [",".join(2**20 * ["abcd"]), *lines()]))


def test_windows_line_ends_and_blank_lines_do_not_matter(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_bytes(("\r\n".join(["", *lines(), "", ""])).encode())
    as_expected(read(path))


def test_numbers_in_quotes_are_numbers(tmp_path: Path) -> None:
    rows = lines()
    as_expected(read(written(tmp_path, [rows[0], *(",".join(f'" {c}"' for c in row.split(",")) for row in rows[1:])])))


@pytest.mark.parametrize("empty", ["", "NaN", "nan", "null", "N/A", "-"])
def test_words_for_nothing_drop_the_row(tmp_path: Path, empty: str) -> None:
    rows = lines()
    rows[101] = ",".join([*rows[101].split(",")[:3], empty])
    recording = read(written(tmp_path, rows))
    assert [(d.kind, d.from_s, d.count) for d in recording.defects] == [("nan", 1.0, 1)]


def test_a_torn_last_row_is_dropped_and_told(tmp_path: Path) -> None:
    rows = lines()
    rows[-1] = rows[-1].split(",")[0]
    recording = read(written(tmp_path, rows))
    assert [(d.kind, d.from_s, d.count) for d in recording.defects] == [("text", 2.98, 1)]
    assert "row 301" in recording.defects[0].message
    assert recording.samples == 299


def test_a_column_that_turns_from_whole_to_broken_numbers_is_read(tmp_path: Path) -> None:
    u = [str(k % 7) for k in range(299)] + ["0.5"]
    assert read(written(tmp_path, lines(u=u))).u[-1] == 0.5


def test_duplicated_column_names_are_refused(tmp_path: Path) -> None:
    assert "two columns are called 'u'" in refusal(written(tmp_path, ["t,r,u,u", *lines()[1:]]))


def test_a_ragged_file_is_refused(tmp_path: Path) -> None:
    rows = [row if k % 3 else f"{row},7" for k, row in enumerate(lines())]
    assert "is it one table with one delimiter?" in refusal(written(tmp_path, [lines()[0], *rows[1:]]))


@pytest.mark.parametrize("late", [False, True])
def test_text_in_a_column_of_numbers_is_named(tmp_path: Path, late: bool) -> None:
    rows = lines()
    at = 250 if late else 1
    cells = rows[at].split(",")
    rows[at] = ",".join([*cells[:2], "overrange", cells[3]])
    text = refusal(written(tmp_path, ["# one comment", *rows]))
    assert f"row {at + 2}, column 'u': 'overrange' is not a number" in text


def test_text_in_a_column_that_is_not_used_does_not_matter(tmp_path: Path) -> None:
    as_expected(read(written(tmp_path, lines(note=["fine"] * 300))))


def test_a_missing_column_names_the_nearest(tmp_path: Path) -> None:
    text = refusal(written(tmp_path, lines(Velocity=[0] * 300)), columns=Columns(output="velocty"))
    assert "[columns] output: no column 'velocty', did you mean Velocity, y?" in text


def test_upper_and_lower_case_differ(tmp_path: Path) -> None:
    path = written(tmp_path, ["t,r,U,y", *lines()[1:]])
    assert "no column 'u', did you mean U?" in refusal(path)


def test_utf_8_with_a_mark_in_the_middle_is_not_binary(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_bytes(b"\xef\xbb\xbf" + "# °C\n".encode() + "\n".join(lines()).encode())
    as_expected(read(path))


# Files that are not what they seem


def test_a_missing_file_is_told(tmp_path: Path) -> None:
    assert "no such file" in refusal(tmp_path / "x.csv")


def test_a_directory_is_told(tmp_path: Path) -> None:
    assert "is a directory" in refusal(tmp_path)


@pytest.mark.parametrize("content", ["", "\n\n  \n"])
def test_an_empty_file_is_told(tmp_path: Path, content: str) -> None:
    path = tmp_path / "x.csv"
    path.write_text(content)
    assert "is empty" in refusal(path)


def test_a_header_alone_is_told(tmp_path: Path) -> None:
    assert "holds no rows" in refusal(written(tmp_path, ["t,r,u,y"]))


def test_comments_alone_are_told(tmp_path: Path) -> None:
    assert "comments only" in refusal(written(tmp_path, ["# t,r,u,y", "# nothing"]))


def test_too_few_rows_are_told(tmp_path: Path) -> None:
    with pytest.raises(NotEnoughError, match="10 usable rows are too few"):
        read(written(tmp_path, lines()[:11]))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"\x89PNG\r\n\x1a\n\x00\x00", "is not CSV but a PNG image: export it as CSV"),
        (b"<!DOCTYPE html>\n<html><body>404</body></html>", "is not CSV but a HTML or XML page"),
        (b"PK\x03\x04\x14\x00", "Excel workbook"),
        (b"%PDF-1.7 abc", "a PDF"),
        (b"1.0,2.0\x00\x01\x02", "a binary file"),
        (b"\x1f\x8b\x08\x00", "a gzip archive"),
    ],
)
def test_other_things_called_csv_are_named(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "x.csv"
    path.write_bytes(content)
    assert said in refusal(path)


def test_prose_called_csv_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, ["Dear reader,", "this is a letter, not a table.", "Yours"])
    assert "no column" in refusal(path) or "do not fit" in refusal(path)


def test_parquet_called_csv_is_named(tmp_path: Path) -> None:
    path = parquet(tmp_path, signals()).rename(tmp_path / "x.csv")
    assert "is not CSV but a Parquet: rename it to .parquet" in refusal(path)


@pytest.mark.parametrize("name", ["x.parquet", "x.mat"])
def test_csv_called_otherwise_is_named(tmp_path: Path, name: str) -> None:
    assert "but a text file" in refusal(written(tmp_path, lines(), name))


def test_an_unknown_suffix_is_told(tmp_path: Path) -> None:
    assert "unknown kind of file '.docx'" in refusal(written(tmp_path, lines(), "x.docx"))


@pytest.mark.parametrize("name", ["x.parquet", "x.mat"])
def test_a_file_cut_short_is_told(tmp_path: Path, name: str) -> None:
    path = parquet(tmp_path, signals()) if name == "x.parquet" else mat5(tmp_path, signals())
    path.write_bytes(path.read_bytes()[:200])
    assert "damaged" in refusal(path)


# Parquet and MAT


@pytest.mark.parametrize("write", [parquet, mat5, mat73])
def test_binary_formats(tmp_path: Path, write: Any) -> None:
    as_expected(read(write(tmp_path, signals())))


def test_parquet_of_single_precision_nulls_and_dictionaries(tmp_path: Path) -> None:
    import pyarrow as pa

    u: list[float | None] = signals()["u"].tolist()
    u[100] = None
    data = signals() | {"u": pa.array(u, pa.float32()), "load": pa.array(["a"] * 300).dictionary_encode()}
    recording = read(parquet(tmp_path, data), where={"load": "a"})
    assert [(d.kind, d.from_s) for d in recording.defects] == [("nan", 1.0)]


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
def test_parquet_with_time_stamps(tmp_path: Path, unit: str) -> None:
    stamps = np.datetime64("2024-01-01T00:00:00", unit) + np.round(signals()["t"] * 1e3).astype("timedelta64[ms]")
    as_expected(read(parquet(tmp_path, signals() | {"t": stamps})))


def test_a_column_with_lists_is_taken_by_its_elements(tmp_path: Path) -> None:
    assert "did you mean u[0]" in refusal(parquet(tmp_path, signals() | {"u": [[1.0]] * 300}))


def test_parquet_with_times_for_numbers_is_refused(tmp_path: Path) -> None:
    stamps = np.datetime64("2024-01-01", "ms") + np.arange(300)
    assert "holds times, not numbers" in refusal(parquet(tmp_path, signals() | {"u": stamps}))


def test_mat_with_structs_matrices_and_scalars(tmp_path: Path) -> None:
    data = signals()
    both = np.column_stack([data["r"], data["u"]])
    path = mat5(tmp_path, {"t": data["t"], "log": {"motor": {"y": data["y"]}}, "both": both, "gain": 3.0, "who": "me"})
    assert [info.name for info in list_channels(path)] == ["t", "log.motor.y", "both[0]", "both[1]"]
    as_expected(read(path, columns=Columns(reference="both[0]", input="1*both[1]", output="log.motor.y")))
    assert "'gain' has 1 values, the channels have 300" in refusal(path, columns=Columns(reference="gain"))


def test_mat_without_vectors_is_refused(tmp_path: Path) -> None:
    assert "holds no columns of numbers" in refusal(mat5(tmp_path, {"who": "me"}))
