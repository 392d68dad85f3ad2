"""Reads delimited text: finds delimiter, decimal sign, header and comments, then lets Arrow do the work."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any, NamedTuple

from servoscope.errors import RecordingError

__all__ = ["NULLS", "CsvColumns", "read_csv"]

NULLS = (
    "",
    "NaN",
    "nan",
    "NAN",
    "-nan",
    "-NaN",
    "NA",
    "N/A",
    "#N/A",
    "#NA",
    "null",
    "NULL",
    "None",
    "-",
    "?",
    "1.#QNAN",
)
COMMENTS = ("#", "%", "//")
SNIFFED = 20  # lines
MOST_BROKEN = 0.01  # share of rows that may not fit the columns


class CsvColumns(NamedTuple):
    """Columns by name, number of the first row in the file, and the rows that did not fit (see `Table`)."""

    columns: dict[str, Any]
    first_row: int
    broken: list[tuple[int, int, str]]


class _Layout(NamedTuple):
    delimiter: str
    decimal: str
    names: list[str]
    skipped: int


def read_csv(path: Path, head: bytes) -> CsvColumns:
    """Read a text file with columns.

    Parameters
    ----------
    path
        The file.
    head
        Its first 64 kB.

    Raises
    ------
    RecordingError
        If it is not a table.
    """
    import pyarrow as pa
    import pyarrow.csv as pc

    encoding, source = _encoding(head), None
    lines = head.decode(encoding, errors="replace").splitlines()
    if len(head) == 65536:
        lines = lines[:-1] or lines
    layout = _layout(lines, path)
    if encoding in ("utf-16", "latin-1") or layout.delimiter == " ":
        text = path.read_bytes().decode(encoding)
        if layout.delimiter == " ":
            # Arrow knows no runs of blanks as one delimiter.
            text = "\n".join(re.sub(r"[ \t]+", " ", line.strip()) for line in text.splitlines())
        source = text.encode()
    broken: list[tuple[int, int, str]] = []
    comments = 0

    def invalid(row: Any) -> str:
        nonlocal broken, comments
        if row.text.lstrip().startswith(COMMENTS):
            comments += 1
        else:
            broken.append((row.number, row.actual_columns, row.text))
        return "skip"

    def parse(threads: bool) -> Any:
        return pc.read_csv(
            io.BytesIO(source) if source is not None else path,
            read_options=pc.ReadOptions(column_names=layout.names, skip_rows=layout.skipped, use_threads=threads),
            parse_options=pc.ParseOptions(delimiter=layout.delimiter, invalid_row_handler=invalid),
            convert_options=pc.ConvertOptions(
                null_values=list(NULLS), strings_can_be_null=True, decimal_point=layout.decimal
            ),
        )

    try:
        table = parse(True)
        if broken or comments:
            # row numbers, which messages name, exist without threads only
            broken, comments = [], 0
            table = parse(False)
    except pa.ArrowInvalid as error:
        raise RecordingError(f"{path}: cannot be read as CSV ({' '.join(str(error).split())[:100]})") from None
    if len(broken) > max(1, MOST_BROKEN * table.num_rows):
        number, actual, _ = broken[0]
        raise RecordingError(
            f"{path}: {len(broken)} rows do not fit, first row {number} with {actual} columns instead of"
            f" {len(layout.names)}: is it one table with one delimiter?"
        )
    first = layout.skipped + 1
    told = [(number - first - index, number, text) for index, (number, _, text) in enumerate(broken)]
    return CsvColumns({name: table.column(name) for name in layout.names}, first, told)


def _encoding(head: bytes) -> str:
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    try:
        head[: head.rfind(b"\n") + 1 or None].decode("utf-8")
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8-sig"


def _layout(lines: list[str], path: Path) -> _Layout:
    skipped = 0
    while skipped < len(lines) and (not lines[skipped].strip() or lines[skipped].lstrip().startswith(COMMENTS)):
        skipped += 1
    sample = [line for line in lines[skipped:] if line.strip() and not line.lstrip().startswith(COMMENTS)][:SNIFFED]
    if not sample:
        raise RecordingError(f"{path}: holds comments only, no rows")
    delimiter = _delimiter(sample)
    body = sample[1:] or sample
    decimal = "," if delimiter != "," and any(re.search(r"\d,\d|(?<!\d),\d", line) for line in body) else "."
    cells = _cells(sample[0], delimiter)
    if all(_is_number(cell, decimal) for cell in cells):
        return _Layout(delimiter, decimal, [f"c{index}" for index in range(len(cells))], skipped)
    names = [cell or f"c{index}" for index, cell in enumerate(cells)]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise RecordingError(f"{path}: two columns are called {twice!r}, rename one of them")
    return _Layout(delimiter, decimal, names, skipped + 1)


def _delimiter(sample: list[str]) -> str:
    for delimiter in (";", "\t", ","):
        if all(delimiter in line for line in sample):
            return delimiter
    # A torn row among the first ones must not hide the delimiter of all the others.
    for delimiter in (";", "\t", ","):
        if sum(delimiter in line for line in sample) > 0.8 * len(sample):
            return delimiter
    return " " if any(re.search(r"\S[ \t]+\S", line.strip()) for line in sample[1:]) else ","


def _cells(line: str, delimiter: str) -> list[str]:
    import csv

    cells = line.split() if delimiter == " " else next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    return [cell.strip().strip("'\"") for cell in cells]


def _is_number(cell: str, decimal: str) -> bool:
    if cell in NULLS:
        return True
    try:
        float(cell.replace(decimal, "."))
    except ValueError:
        return re.fullmatch(r"\d{4}-\d\d-\d\d[T ].*", cell) is not None
    return True
