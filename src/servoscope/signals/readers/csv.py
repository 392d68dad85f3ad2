"""Reads delimited text: finds delimiter, decimal sign, header and comments, then lets Arrow read chunk by chunk."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from servoscope.core.errors import RecordingError
from servoscope.signals.readers.table import NULL_TEXTS, Table, TableFile, is_number

COMMENTS = ("#", "%", "//")
HEAD_BYTES = 1 << 16  # that tell the layout
SNIFF_LINES = 20
CHUNK_BYTES = 1 << 23  # bytes that are read at a time
SINGLE_BLOCK_BYTES = 1 << 20  # bytes that Arrow parses as one block anyway
MAX_BROKEN_SHARE = 0.01  # share of rows that may not fit the columns


@dataclass(frozen=True)
class CsvLayout:
    """How a text file is laid out: delimiter, decimal sign, names of the columns, lines before the rows, encoding."""

    delimiter: str
    decimal: str
    names: tuple[str, ...]
    skip_rows: int
    encoding: str = "utf-8-sig"


def open_csv(path: Path) -> TableFile:
    """Open a text file, once its layout is known."""
    with path.open("rb") as file:
        layout = detect_layout(path, file.read(HEAD_BYTES))
    return TableFile(path, layout.names, lambda *wanted: read_csv(path, layout, *wanted))


def detect_layout(path: Path, head: bytes) -> CsvLayout:
    """Find out how a text file is laid out from its first bytes.

    Raises RecordingError if it is not a table.
    """
    encoding = _detect_encoding(head)
    lines = head.decode(encoding, errors="replace").splitlines()
    if len(head) == HEAD_BYTES:
        lines = lines[:-1] or lines
    return replace(_detect_header(lines, path), encoding=encoding)


def read_csv(path: Path, layout: CsvLayout, wanted: Sequence[str], texts: Collection[str] = ()) -> Iterator[Table]:
    """Yield the rows of a text file, chunk by chunk.

    `wanted`: names of the columns that are read; `texts`: names of those that are text even where they look like
    numbers; raises RecordingError if it is not a table.
    """
    rows = broken = 0
    odd: tuple[int, int] | None = None
    for text, before, last in _iter_text_chunks(path, layout):
        skip_rows = 0 if before else layout.skip_rows
        if before and not text.strip():
            continue
        columns, torn = _parse_chunk(path, layout, wanted, texts, text, skip_rows)
        told = [(number - skip_rows - 1 - index, before + number, line) for index, (number, _, line) in enumerate(torn)]
        table = Table(path.name, columns, before + skip_rows + 1, tuple(told))
        rows, broken = rows + table.rows, broken + len(torn)
        odd = odd or next(((before + number, actual) for number, actual, _ in torn), None)
        if last and odd is not None and broken > max(1, MAX_BROKEN_SHARE * rows):
            raise RecordingError(
                f"{path}: {broken} rows do not fit, first row {odd[0]} with {odd[1]} columns instead of"
                f" {len(layout.names)}: is it one table with one delimiter?"
            )
        yield table


def _iter_text_chunks(path: Path, layout: CsvLayout) -> Iterator[tuple[bytes, int, bool]]:
    """Yield whole lines, how many lines were before them, and whether they are the last ones."""
    before, held = 0, b""
    plain = layout.encoding == "utf-8-sig" and layout.delimiter != " "
    for text in _iter_utf8(path) if plain else _iter_recoded(path, layout):
        if held:
            yield held, before, False
            before += held.count(b"\n") or held.count(b"\r")
        held = text
    yield held, before, True


def _iter_utf8(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while text := file.read(CHUNK_BYTES):
            yield _replace_invalid(text if text.endswith(b"\n") else text + file.readline())


def _replace_invalid(text: bytes) -> bytes:
    """Return text with a replacement for what is none: Arrow cannot tell of rows that it cannot decode."""
    try:
        text.decode("utf-8")
    except UnicodeDecodeError:
        return text.decode("utf-8", errors="replace").encode()
    return text


def _iter_recoded(path: Path, layout: CsvLayout) -> Iterator[bytes]:
    """Yield lines as UTF-8 with single blanks: Arrow knows no runs of them as one delimiter."""
    with path.open(encoding=layout.encoding, errors="replace") as file:
        while lines := file.readlines(CHUNK_BYTES):
            if layout.delimiter == " ":
                lines = [re.sub(r"[ \t]+", " ", line.strip()) + "\n" for line in lines]
            yield "".join(lines).encode()


def _parse_chunk(
    path: Path, layout: CsvLayout, wanted: Sequence[str], texts: Collection[str], text: bytes, skip_rows: int
) -> tuple[dict[str, Any], list[tuple[int, int, str]]]:
    """Return columns, and the rows that do not fit: number of the line in the text, columns that it has, its text."""
    import pyarrow as pa
    import pyarrow.csv as pc

    torn: list[tuple[int, int, str]] = []
    comments = 0

    def invalid(row: Any) -> str:
        nonlocal comments
        if row.text.lstrip().startswith(COMMENTS):
            comments += 1
        else:
            torn.append((row.number, row.actual_columns, row.text))
        return "skip"

    def parse(threads: bool) -> Any:
        return pc.read_csv(
            pa.BufferReader(text),
            read_options=pc.ReadOptions(column_names=layout.names, skip_rows=skip_rows, use_threads=threads),
            parse_options=pc.ParseOptions(delimiter=layout.delimiter, invalid_row_handler=invalid),
            convert_options=pc.ConvertOptions(
                null_values=list(NULL_TEXTS),
                strings_can_be_null=True,
                decimal_point=layout.decimal,
                include_columns=list(wanted),
                column_types=dict.fromkeys(texts, pa.string()),
            ),
        )

    try:
        # threads that still let go of a small text while Python ends would abort the process
        table = parse(len(text) > SINGLE_BLOCK_BYTES)
        if torn or comments:
            # row numbers, which messages name, exist without threads only
            torn.clear()
            table = parse(False)
    except pa.ArrowInvalid as error:
        raise RecordingError(f"{path}: cannot be read as CSV ({' '.join(str(error).split())[:100]})") from None
    return {name: table.column(name) for name in wanted}, torn


def _detect_encoding(head: bytes) -> str:
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    try:
        head[: head.rfind(b"\n") + 1 or None].decode("utf-8")
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8-sig"


def _detect_header(lines: list[str], path: Path) -> CsvLayout:
    skipped = 0
    while skipped < len(lines) and (not lines[skipped].strip() or lines[skipped].lstrip().startswith(COMMENTS)):
        skipped += 1
    sample = [line for line in lines[skipped:] if line.strip() and not line.lstrip().startswith(COMMENTS)][:SNIFF_LINES]
    if not sample:
        raise RecordingError(f"{path}: holds comments only, no rows")
    delimiter = _detect_delimiter(sample)
    body = sample[1:] or sample
    decimal = "," if delimiter != "," and any(re.search(r"\d,\d|(?<!\d),\d", line) for line in body) else "."
    cells = _split_cells(sample[0], delimiter)
    if all(_is_value(cell, decimal) for cell in cells):
        return CsvLayout(delimiter, decimal, tuple(f"c{index}" for index in range(len(cells))), skipped)
    names = [cell or f"c{index}" for index, cell in enumerate(cells)]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise RecordingError(f"{path}: two columns are called {twice!r}, rename one of them")
    return CsvLayout(delimiter, decimal, tuple(names), skipped + 1)


def _detect_delimiter(sample: list[str]) -> str:
    for delimiter in (";", "\t", ","):
        if all(delimiter in line for line in sample):
            return delimiter
    # A torn row among the first ones must not hide the delimiter of all the others.
    for delimiter in (";", "\t", ","):
        if sum(delimiter in line for line in sample) > 0.8 * len(sample):
            return delimiter
    return " " if any(re.search(r"\S[ \t]+\S", line.strip()) for line in sample[1:]) else ","


def _split_cells(line: str, delimiter: str) -> list[str]:
    import csv

    cells = line.split() if delimiter == " " else next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    return [cell.strip().strip("'\"") for cell in cells]


def _is_value(cell: str, decimal: str) -> bool:
    """Tell whether a cell of the first line is a value, and not the name of a column."""
    return (
        cell in NULL_TEXTS
        or is_number(cell.replace(decimal, "."))
        or re.fullmatch(r"\d{4}-\d\d-\d\d[T ].*", cell) is not None
    )
