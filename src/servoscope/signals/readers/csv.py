"""Reads delimited text: finds delimiter, decimal sign, header and comments, then lets Arrow read chunk by chunk."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from servoscope.core.errors import EmptyRecordingError, RecordingError
from servoscope.models.loop import TextLayout
from servoscope.signals.readers.column_words import known_words
from servoscope.signals.readers.layout import (
    HEAD_ROWS,
    THOUSANDS,
    TableShape,
    check_names,
    find_table,
    table_shape,
)
from servoscope.signals.readers.table import NULL_TEXTS, Table, TableFile, is_number, one_line_errors

COMMENTS = ("#", "%", "//")
DELIMITERS = {  # each with what a line holds that it splits
    **{sign: re.compile(re.escape(sign)) for sign in (";", "\t", ",", "|")},
    " ": re.compile(r"\S\s+\S"),
}
HEAD_BYTES = 1 << 16  # that tell the layout, where the table begins in them
MIN_HEAD_LINES = 8  # a file of thousands of columns has fewer in so many bytes
MAX_HEAD_BYTES = 1 << 22  # that are looked at otherwise: of long lines, or of many above the table
LINE_ENDS = ";%"  # that stand behind each row in files of some programs
CHUNK_BYTES = 1 << 23  # bytes that are read at a time
SINGLE_BLOCK_BYTES = 1 << 20  # bytes that Arrow parses as one block anyway
MAX_BROKEN_SHARE = 0.01  # share of rows that may not fit the columns
CHINESE_CHARACTER = re.compile("[一-鿿]")


@dataclass(frozen=True)
class CsvLayout:
    """How a text file is laid out: delimiter, decimal sign, names of the columns, lines before the rows, encoding.

    `line_end`: what stands behind each row, if anything does; columns without a name are empty. `thousands`: the sign
    between thousands, empty where numbers have none.
    """

    delimiter: str
    decimal: str
    names: tuple[str, ...]
    skip_rows: int
    encoding: str = "utf-8-sig"
    comments: tuple[str, ...] = COMMENTS
    line_end: str = ""
    thousands: str = ""

    @property
    def columns(self) -> tuple[str, ...]:
        """The names that are some."""
        return tuple(name for name in self.names if name)


def open_csv(path: Path, text: TextLayout | None = None) -> TableFile:
    """Open a text file, once its layout is known; `text`: what the user says of it."""
    with path.open("rb") as file:
        head, rows = file.read(HEAD_BYTES), HEAD_ROWS
        while (layout := detect_layout(path, head, rows, text or TextLayout(), cut=bool(file.peek(1)))) is None:
            head += file.read(len(head))
            rows *= 2
    return TableFile(path, layout.columns, lambda *wanted: read_csv(path, layout, *wanted))


@lru_cache(maxsize=4)  # a log is opened once for its columns, and again for each use of its rows
def detect_layout(path: Path, head: bytes, most: int, text: TextLayout, cut: bool) -> CsvLayout | None:
    """Find out how a text file is laid out from its first bytes, and `most` lines of them; `cut`: it has more.

    None: no table begins there, and it has more. Raises RecordingError if it is not a table.
    """
    encoding = _detect_encoding(head)
    lines = head.decode(encoding, errors="replace").splitlines()
    if cut and len(lines) < 2 and len(head) >= MAX_HEAD_BYTES:
        raise RecordingError(f"{path}: its first line is longer than {len(head) / 1e6:.0f} MB, is it a table?")
    has_more = (cut or len(lines) > most) and len(head) < MAX_HEAD_BYTES
    lines = lines[: len(lines) - cut][:most]
    if has_more and len(lines) < MIN_HEAD_LINES:
        return None
    comments = (text.comment,) if text.comment else COMMENTS
    plain = ["" if line.lstrip().startswith(comments) else line for line in lines]
    plain[: text.skip_rows] = [""] * min(text.skip_rows, len(plain))
    if not any(line.strip() for line in plain):
        if has_more:
            return None
        raise EmptyRecordingError(f"{path}: holds comments only, no rows")
    header = None if text.header_row is None else text.header_row - 1
    if header is not None and not (header < len(plain) and lines[header].strip()):
        if has_more and header >= len(plain):
            return None
        raise RecordingError(f"{path}: --header-row {text.header_row}: there is no text in this line, name another")
    if header is not None:
        plain[header] = (
            lines[header].lstrip().removeprefix(next(filter(lines[header].lstrip().startswith, comments), ""))
        )
    ends = [line.rstrip()[-1:] for line in plain if line.strip()]
    line_end = next((end for end in LINE_ENDS if ends.count(end) > 0.8 * len(ends)), "")
    split = _split_by_each(plain, line_end)
    delimiter, (rows, shape) = max(split.items(), key=lambda tried: tried[1][1].score)
    table = find_table(rows, shape, str(path), header)
    used = "" if delimiter == line_end else line_end
    if table is None and has_more:
        return None
    if table is None:  # no row of numbers: the first line says what the columns are, and what follows is told later
        delimiter = max(split, key=lambda candidate: len(next(filter(None, split[candidate][0]), [])))
        first, cells = next((i, row) for i, row in enumerate(split[delimiter][0]) if row)
        check_names(cells, str(path))
        named = tuple(cell or f"c{index}" for index, cell in enumerate(cells))
        return CsvLayout(delimiter, ".", named, first + 1, encoding, comments, used)
    decimal, thousands = _detect_decimal(rows[table.first :])
    names = table.names
    above = next((row for row in reversed(rows[: table.first]) if row), [])
    if header is None and delimiter == "," and not any(map(is_number, above)) and 2 * len(above) == len(names):
        raise RecordingError(
            f"{path}: {len(names)} numbers stand under {len(above)} names: commas are decimal signs and delimiters at"
            " once; export with ; between the columns, or with decimal points"
        )
    commented = [line.lstrip().lstrip("".join(comments)) for line in lines[: table.first] if line.strip()]
    if names == tuple(f"c{index}" for index in range(len(names))) and commented and not above:
        told = _split_lines(commented[-1:], delimiter, used)[0]  # the names may stand in the last comment
        if len(told) == len(names) and all(told) and len(set(told)) == len(told) and not any(map(is_number, told)):
            names = tuple(told)
    return CsvLayout(delimiter, decimal, names, table.first, encoding, comments, used, thousands)


def _split_by_each(lines: list[str], line_end: str) -> dict[str, tuple[list[list[str]], TableShape]]:
    """Return the cells of lines by each delimiter, and their shape; by those that lines hold if one makes a table."""
    delimiters = [delimiter for delimiter in DELIMITERS if delimiter != line_end]
    if line_end == ";":  # it is the delimiter where it also stands between cells
        delimiters.append(";")

    def split_by(delimiter: str) -> tuple[list[list[str]], TableShape]:
        rows = _split_lines(lines, delimiter, "" if delimiter == line_end else line_end)
        return rows, table_shape(rows)

    held = [delimiter for delimiter in delimiters if any(map(DELIMITERS[delimiter].search, lines))]
    split = {delimiter: split_by(delimiter) for delimiter in held}
    if any(len(shape.numeric) > 1 for _, shape in split.values()):
        return split
    return {delimiter: split.get(delimiter) or split_by(delimiter) for delimiter in delimiters}


def _split_lines(lines: list[str], delimiter: str, line_end: str) -> list[list[str]]:
    return [_split_cells(_strip_end(line, line_end), delimiter) if line.strip() else [] for line in lines]


def _strip_end(line: str, end: str) -> str:
    return line.rstrip().removesuffix(end) if end else line


def _detect_decimal(rows: list[list[str]]) -> tuple[str, str]:
    """Return the decimal sign, and the one between thousands, empty where there is none."""
    cells = [cell for row in rows for cell in row]
    if not any("," in cell for cell in cells):
        return ".", ""
    if (grouped := next(filter(THOUSANDS.fullmatch, cells), None)) is not None:
        return (",", ".") if grouped.rfind(",") > grouped.rfind(".") else (".", ",")
    comma = sum(re.fullmatch(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?", cell) is not None for cell in cells)
    point = sum("." in cell and is_number(cell) for cell in cells)
    return ("," if comma > point else "."), ""


def read_csv(path: Path, layout: CsvLayout, wanted: Sequence[str], texts: Collection[str] = ()) -> Iterator[Table]:
    """Yield the rows of a text file, chunk by chunk.

    `wanted`: names of the columns that are read; `texts`: names of those that are text even where they look like
    numbers; raises RecordingError if it is not a table.
    """
    rows = broken = done = 0
    size, width = path.stat().st_size, 2 if "16" in layout.encoding else 1
    odd: tuple[int, int] | None = None
    for text, before, last in _iter_text_chunks(path, layout):
        skip_rows = 0 if before else layout.skip_rows
        if before and not text.strip():
            continue
        columns, torn = _parse_chunk(path, layout, wanted, texts, text, skip_rows)
        told = [(number - skip_rows - 1 - index, before + number, line) for index, (number, _, line) in enumerate(torn)]
        done += len(text) * width
        table = Table(path.name, columns, before + skip_rows + 1, tuple(told), min(done / size, 1.0))
        rows, broken = rows + table.rows, broken + len(torn)
        odd = odd or next(((before + number, actual) for number, actual, _ in torn), None)
        if last and odd is not None and broken > max(1, MAX_BROKEN_SHARE * rows):
            raise RecordingError(
                f"{path}: {broken} rows do not fit, first row {odd[0]} with {odd[1]} columns instead of"
                f" {len(layout.names)}: is it one table with one delimiter?"
                " --header-row says which line names its columns"
            )
        yield table
    if size > CHUNK_BYTES:
        import pyarrow as pa

        pa.system_memory_pool().release_unused()


def _iter_text_chunks(path: Path, layout: CsvLayout) -> Iterator[tuple[bytes, int, bool]]:
    """Yield whole lines, how many lines were before them, and whether they are the last ones."""
    before, held = 0, b""
    for text in _iter_utf8(path, layout):
        if held:
            yield held, before, False
            before += held.count(b"\n")
        held = text
    yield held, before, True


def _iter_utf8(path: Path, layout: CsvLayout) -> Iterator[bytes]:
    """Yield lines as UTF-8 with single blanks: Arrow knows no runs of them as one delimiter, and no thousands.

    What cannot be decoded is replaced: Arrow cannot tell of rows that it cannot decode.
    """
    begin = '(?<=")' if layout.delimiter == layout.thousands else f'(?<![^"\\s{re.escape(layout.delimiter)}])'
    grouped = re.compile(rf"{begin}[-+]?\d{{1,3}}(?:{re.escape(layout.thousands)}\d{{3}})+(?!\d)")
    by_line = layout.comments != COMMENTS or layout.line_end or layout.delimiter == " "
    with path.open(encoding=layout.encoding, errors="replace") as file:
        while text := file.read(CHUNK_BYTES) + file.readline():
            lines = text.split("\n") if by_line else [text]
            if layout.comments != COMMENTS:  # what the user calls a comment may have as many cells as a row
                lines = ["" if line.lstrip().startswith(layout.comments) else line for line in lines]
            if layout.line_end:
                lines = [_strip_end(line, layout.line_end) for line in lines]
            if layout.delimiter == " ":
                lines = [re.sub(r"[ \t]+", " ", line.strip()) for line in lines]
            text = "\n".join(lines)
            if layout.thousands:
                text = grouped.sub(lambda cell: cell[0].replace(layout.thousands, ""), text)
            yield text.encode()


def _parse_chunk(
    path: Path, layout: CsvLayout, wanted: Sequence[str], texts: Collection[str], text: bytes, skip_rows: int
) -> tuple[dict[str, Any], list[tuple[int, int, str]]]:
    """Return columns, and the rows that do not fit: number of the line in the text, columns that it has, its text."""
    import pyarrow as pa
    import pyarrow.csv as pc

    torn: list[tuple[int, int, str]] = []
    comments = 0
    # columns without a name are empty; Arrow wants one that no other has
    columns = [name or f"\0{index}" for index, name in enumerate(layout.names)]

    def invalid(row: Any) -> str:
        nonlocal comments
        if row.text.lstrip().startswith(layout.comments):
            comments += 1
        else:
            torn.append((row.number, row.actual_columns, row.text))
        return "skip"

    def parse(threads: bool) -> Any:
        return pc.read_csv(
            pa.BufferReader(text),
            read_options=pc.ReadOptions(column_names=columns, skip_rows=skip_rows, use_threads=threads),
            parse_options=pc.ParseOptions(delimiter=layout.delimiter, invalid_row_handler=invalid),
            convert_options=pc.ConvertOptions(
                null_values=list(NULL_TEXTS),
                strings_can_be_null=True,
                decimal_point=layout.decimal,
                include_columns=list(wanted),
                column_types=dict.fromkeys(texts, pa.string()),
            ),
            memory_pool=pa.system_memory_pool(),  # others keep a hundred megabytes once they are not used any more
        )

    with one_line_errors(path, "cannot be read as CSV", kinds=(pa.ArrowInvalid,)):
        # threads that still let go of a small text while Python ends would abort the process
        table = parse(len(text) > SINGLE_BLOCK_BYTES)
        if torn or comments:
            # row numbers, which messages name, exist without threads only
            torn.clear()
            table = parse(False)
    return {name: table.column(name) for name in wanted}, torn


def _detect_encoding(head: bytes) -> str:
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    if is_utf16(head):
        return "utf-16-le" if head[1:2] == b"\0" else "utf-16-be"
    lines = head[: head.rfind(b"\n") + 1 or None]
    try:
        lines.decode("utf-8")
    except UnicodeDecodeError:
        # two bytes of Chinese are two letters of Latin: words that names of columns have tell
        told = lines.decode("gb18030", errors="replace")
        words = (word for word in known_words() if CHINESE_CHARACTER.search(word))
        return "gb18030" if any(word in told for word in words) else "latin-1"
    return "utf-8-sig"


def is_utf16(head: bytes) -> bool:
    """Tell whether bytes are UTF-16 without its mark: every other one is zero, and the others are text."""
    for first in (0, 1):
        zeros, others = head[first::2], head[1 - first :: 2]
        if len(head) >= 8 and zeros.count(0) > 0.9 * len(zeros) and not any(byte < 9 for byte in others):
            return True
    return False


def _split_cells(line: str, delimiter: str) -> list[str]:
    import csv

    if delimiter == " ":
        cells = line.split()
    elif '"' not in line:
        cells = line.split(delimiter)
    else:
        try:
            cells = next(csv.reader([line[:MAX_HEAD_BYTES]], delimiter=delimiter, skipinitialspace=True), [])
        except csv.Error:
            cells = line.split(delimiter)
    return [cell.strip().strip("'\"") for cell in cells]
