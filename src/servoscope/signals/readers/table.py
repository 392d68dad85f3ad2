"""Columns of a file, or of a piece of it, as Arrow read them: numbers and times of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import EmptyRecordingError, IrregularTimeError, RecordingError
from servoscope.signals.readers.clock import ZONED, ClockParser, ZoneOffset, is_clock
from servoscope.signals.readers.units import parse_quantity

NULL_TEXTS = (
    *("", "NaN", "nan", "NAN", "-nan", "-NaN", "NA", "N/A", "#N/A", "#NA", "null", "NULL", "None", "-", "?"),
    "1.#QNAN",
)
SAMPLE_TOGETHER = "--resample (resample = true in [columns]) puts them on one clock"
NUMBER_BYTES = 8
MAX_UNPACKED_RATIO = 200  # times its size, that a file may have when it is unpacked; measured values shrink to a tenth
MIN_UNPACKED_LIMIT_BYTES = 100_000_000  # that any file may have when it is unpacked
CHUNK_ROWS = 1 << 16  # that are read at a time
MAX_COLUMNS = 20_000  # of a file: beyond that the description of the columns is what fills the memory
TIME_UNITS_BY_NAME = {"millitm": "ms", "msec": "ms", "ms": "ms", "milliseconds": "ms"}  # beside a time of day
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of a file, all of its rows or a piece of them."""

    name: str  # what errors call the file
    columns: dict[str, Any]  # name -> Arrow column; all of equal length
    first_row: int = 1  # number of the first row in the file, as an editor counts
    # rows that could not be split into the columns: (rows read before it, number in the file, text)
    broken: tuple[tuple[int, int, str], ...] = ()
    share: float = math.nan  # of the file, that has been read with it; NaN where nobody knows

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(next(iter(self.columns.values()), ()))

    def row_number(self, index: int) -> int:
        """Return where row `index` stands in the file, broken rows before it counted."""
        return self.first_row + index + sum(before <= index for before, _, _ in self.broken)


def check_width(path: Path, count: int) -> None:
    """Refuse a file with too many columns; raises RecordingError."""
    if count > MAX_COLUMNS:
        raise RecordingError(f"{path}: has {count} columns, more than {MAX_COLUMNS}: leave out what is not needed")


def check_size(path: Path, rows: int, columns: int) -> None:
    """Refuse a file whose numbers would need improbably more memory than the file itself; raises RecordingError."""
    check_bytes(path, NUMBER_BYTES * rows * columns, f"{rows} rows of {columns} columns")


def check_bytes(path: Path, size: int, what: str) -> None:
    """Refuse a file of which `what` it holds needs improbably more memory [B] than the file; raises RecordingError."""
    if size > (most := unpacked_limit(path)):
        raise RecordingError(
            f"{path}: claims {what}, {size / 1e6:.0f} MB, and a file of its size"
            f" has at most {most / 1e6:.0f} MB: write it in parts"
        )


def unpacked_limit(path: Path) -> int:
    """Return how large a file may be when it is unpacked [B]."""
    return max(MIN_UNPACKED_LIMIT_BYTES, MAX_UNPACKED_RATIO * path.stat().st_size)


def number_column(table: Table, name: str, what: str) -> FloatArray:
    """Return a column as numbers, shape (N,), NaN where a cell is empty.

    `what`: what the column is wanted for, for messages; raises RecordingError if a cell holds text; it names row,
    column and text.
    """
    import pyarrow as pa

    column = table.columns[name]
    kind = column.type
    if pa.types.is_dictionary(kind):
        column, kind = column.cast(kind.value_type), kind.value_type
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        return _parse_numbers(table, name, column.to_pylist())
    if pa.types.is_temporal(kind):
        raise RecordingError(f"{table.name}: {what}: column {name!r} holds times, not numbers, choose another column")
    try:
        if pa.types.is_boolean(kind):
            column = column.cast(pa.int8())
        if not pa.types.is_float64(kind):  # Arrow's functions take a while to import
            column = column.cast(pa.float64(), safe=False)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
        raise RecordingError(f"{table.name}: {what}: column {name!r} holds {kind}, not numbers") from None
    # not to_numpy: it imports pandas where it finds it, a fifth of a second
    chunks = (column.fill_null(np.nan) if column.null_count else column).chunks
    return np.concatenate([np.zeros(0), *(np.from_dlpack(chunk) for chunk in chunks if len(chunk))])


class TimeColumn:
    """The time in seconds, chunk by chunk; dates and times count from the first row that has them.

    `columns`: names of a column, or of several that make one clock together: a date, a time of day, milliseconds;
    `unit`: of numbers in one column; `zone`: of dates and times that are local; None: they count as they are written.
    """

    def __init__(self, columns: Sequence[str], unit: str, zone: str | None = None) -> None:
        self.columns, self._unit = tuple(columns), unit
        self._zone = ZoneOffset(zone) if zone is not None else None
        self._first_offset: float | None = None
        self._origin: tuple[int, float] | None = None
        self._has_zone = False  # whether dates that are text end in their offset from UTC
        self._dated = self._naive = False  # whether the column holds dates and times, and those without a zone
        self._begin: float | None = None
        self._clocks = {column: ClockParser() for column in self.columns}

    def seconds(self, table: Table) -> FloatArray:
        """Return the time of a piece's rows [s], shape (N,).

        Raises RecordingError if a cell holds text that is neither number nor time.
        """
        if len(self.columns) == 1:
            return self._elapsed(self._column_seconds(table, self.columns[0], self._unit))
        parts = [
            self._column_seconds(table, column, TIME_UNITS_BY_NAME.get(column.casefold(), "s"))
            for column in self.columns
        ]
        return self._elapsed(np.asarray(np.sum(parts, axis=0)))

    def _elapsed(self, seconds: FloatArray) -> FloatArray:
        """Return seconds as they passed, where those given are of local dates and a zone is known."""
        if self._zone is None or not (self._naive or self._midnights):
            return seconds
        offsets = self._zone.offsets(seconds + self._start)
        if self._first_offset is None and np.isfinite(offsets).any():
            self._first_offset = float(offsets[np.isfinite(offsets)][0])
        return np.asarray(seconds - (offsets - (self._first_offset or 0.0)))

    @property
    def texts(self) -> set[str]:
        """Those of its columns that are text even where they look like numbers."""
        return set(self.columns) if len(self.columns) > 1 else set()

    @property
    def origin(self) -> float:
        """What makes seconds since 1970 of its seconds, UTC unless dates are local and no zone is known [s].

        0 where no dates are known: it counts from 1970 itself then, or from anywhere.
        """
        return self._start - (self._first_offset or 0.0)

    @property
    def is_utc(self) -> bool:
        """Whether its dates are UTC; else they are as they are written, and nobody says where."""
        return self._zone is not None or self._has_zone or not (self._naive or self._midnights)

    @property
    def _midnights(self) -> list[float]:
        return [clock.midnight for clock in self._clocks.values() if clock.midnight is not None]

    @property
    def _start(self) -> float:
        """The first moment as it is written [s since 1970]; 0 where there are no dates."""
        if self._origin is not None and self._dated:
            return self._origin[0] / self._origin[1]
        return self._midnights[0] + (self._begin or 0.0) if self._midnights else 0.0

    def _column_seconds(self, table: Table, name: str, unit: str) -> FloatArray:
        import pyarrow as pa

        column = table.columns[name]
        if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
            return self._clock_seconds(table, name, unit)
        if not pa.types.is_temporal(column.type):
            return number_column(table, name, "time") * TIME_UNITS[unit]
        missing = np.asarray(column.is_null().to_numpy(zero_copy_only=False), dtype=bool)
        if pa.types.is_date(column.type):
            column = column.cast(pa.timestamp("ms"))
        elif pa.types.is_time32(column.type):
            column = column.cast(pa.time64("ns"))
        self._dated = pa.types.is_timestamp(column.type)
        self._naive = self._dated and column.type.tz is None
        per_second = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[column.type.unit]
        whole = column.cast(pa.int64()).fill_null(0).to_numpy()
        known = np.flatnonzero(~missing)
        if self._origin is None and known.size:
            self._origin = int(whole[known[0]]), per_second
        first, per = self._origin or (0, per_second)
        # Whole numbers are subtracted first: nanoseconds since 1970 do not fit into a float.
        if per == per_second:
            since = (whole - first) / per_second
        else:  # a later piece of a text file shows other digits
            begun = first * int(per_second) // int(per)
            since = (whole - begun) / per_second + (begun / per_second - first / per)
        return np.where(missing, np.nan, since)

    def _clock_seconds(self, table: Table, name: str, unit: str) -> FloatArray:
        """Return dates and times of day that are text, from the first of them on; else numbers that are text."""
        cells = table.columns[name].to_pylist()
        if not any(is_clock(cell) for cell in cells if cell):
            return number_column(table, name, "time") * TIME_UNITS[unit]
        self._has_zone = self._has_zone or any(ZONED.search(cell) for cell in cells[:1] if cell)
        seconds = self._clocks[name].seconds(cells)
        if isinstance(seconds, int):
            raise RecordingError(
                f"{table.name}: row {table.row_number(seconds)}, column {name!r}: "
                f"{str(cells[seconds])[:40]!r} is neither a date nor a time, correct it or leave the cell empty"
            )
        if self._begin is None and len(self.columns) == 1 and np.isfinite(seconds).any():
            self._begin = float(seconds[np.isfinite(seconds)][0])
        return seconds - (self._begin or 0.0)


def _parse_numbers(table: Table, name: str, cells: list[str | None]) -> FloatArray:
    numbers = np.empty(len(cells))
    for index, cell in enumerate(cells):
        text = "" if cell is None else cell.strip()
        try:
            numbers[index] = np.nan if text in NULL_TEXTS else float(text.replace("_", "x"))
        except ValueError:
            if (quantity := parse_quantity(text, name)) is not None:
                numbers[index] = quantity
                continue
            shown = text if len(text) <= 40 else f"{text[:37]}..."
            raise RecordingError(
                f"{table.name}: row {table.row_number(index)}, column {name!r}: {shown!r} is not a number,"
                " correct it or leave the cell empty (--comment leaves out lines that hold no row)"
            ) from None
    return numbers


@dataclass(frozen=True, eq=False)
class TableFile:
    """A file whose columns are known and whose rows are not read yet."""

    path: Path
    columns: tuple[str, ...]  # names of its columns
    # takes names of columns, and names of those among them that are text even where they look like numbers; returns
    # the rows chunk by chunk, each as a mapping of names to columns of NumPy or Arrow, or as a table
    read_chunks: Callable[[Sequence[str], Collection[str]], Iterator[Table | Mapping[str, Any]]]
    non_channels: dict[str, str] = field(default_factory=dict)  # variables that are no channels, and why
    channel_groups: tuple[tuple[str, ...], ...] = ()  # which columns can be read at once; empty: all of them
    # columns under the names that the file gives them, where their units stand apart: Position, for Position [mm]
    aliases: dict[str, str] = field(default_factory=dict)

    @classmethod
    def from_columns(cls, path: Path, columns: Mapping[str, Any], **about: Any) -> TableFile:
        """Return a file whose columns have been read; what it is `about` are the other fields."""
        return cls(path, tuple(columns), lambda wanted, _: iter([{name: columns[name] for name in wanted}]), **about)

    @property
    def name(self) -> str:
        """What errors call the file."""
        return self.path.name

    @property
    def known(self) -> tuple[str, ...]:
        """All names by which its columns may be called."""
        return (*self.columns, *self.aliases)

    def tables(self, wanted: Sequence[str], texts: Collection[str] = ()) -> Iterator[Table]:
        """Yield the rows chunk by chunk as tables; arguments as for `read_chunks`."""
        import pyarrow as pa

        first = 1
        for chunk in self.read_chunks(wanted, texts):
            if isinstance(chunk, Table):
                yield chunk
                continue
            columns = {
                name: x if isinstance(x, pa.ChunkedArray) else pa.chunked_array([x]) for name, x in chunk.items()
            }
            yield (table := Table(self.name, columns, first))
            first += table.rows

    def iter_chunks(self, wanted: Collection[str], texts: Collection[str] = ()) -> Iterator[Table]:
        """Yield the rows chunk by chunk, of the columns that are wanted; `texts` among them are text in any case.

        Raises RecordingError if the file is damaged or has no rows, or not all of them were sampled together.
        """
        part = _part.get()
        rows, also = 0, {alias: name for alias, name in self.aliases.items() if alias in wanted}
        places = {*wanted, *also.values()} & {*self.columns}
        together = max(map(set, self.channel_groups), key=lambda group: len(places & group), default=places)
        if apart := sorted(places - together):
            others = ", ".join(sorted(places & together))
            raise IrregularTimeError(
                f"{self.path}: {apart[0]!r} was not sampled together with {others}: {SAMPLE_TOGETHER}"
            )
        for table in self.tables([name for name in self.columns if name in places], texts):
            if part is not None and rows >= part.rows:
                part.cut[self.name] = rows
                break
            rows += table.rows
            if (watch := _watch.get()) is not None:
                watch(self.name, rows, table.share if part is None else min(rows / part.rows, 1.0))
            if table.rows and also:
                table = replace(table, columns={**table.columns, **{a: table.columns[n] for a, n in also.items()}})
            if table.rows:
                yield table
        if not rows:
            raise EmptyRecordingError(f"{self.path}: holds no rows")


@dataclass(frozen=True)
class Part:
    """How much is read of a file: so many rows, in whole chunks; `cut`: rows that were read of those that have more."""

    rows: int
    cut: dict[str, int] = field(default_factory=dict)


_part: ContextVar[Part | None] = ContextVar("part", default=None)


def rows_wanted() -> int | None:
    """Return about how many rows of a file are wanted, in this thread; None: all."""
    part = _part.get()
    return None if part is None else part.rows


@contextmanager
def read_part(rows: int) -> Iterator[Part]:
    """Read no more than about so many rows of each file, in this thread for a while."""
    before = _part.set(part := Part(rows))
    try:
        yield part
    finally:
        _part.reset(before)


_watch: ContextVar[Callable[[str, int, float], None] | None] = ContextVar("watch", default=None)


@contextmanager
def watch_reading(watch: Callable[[str, int, float], None]) -> Iterator[None]:
    """Call with name, rows and share of a file as they are read, in this thread for a while."""
    before = _watch.set(watch)
    try:
        yield
    finally:
        _watch.reset(before)


@contextmanager
def one_line_errors(
    path: Path | str, what: str, advice: str = "", kinds: tuple[type[Exception], ...] = (Exception,)
) -> Iterator[None]:
    """Turn what a library raises at a damaged file into a RecordingError of one line.

    `kinds`: of its errors; most libraries raise nearly anything. `what`, `advice`: what is wrong then, and the remedy.
    """
    try:
        yield
    except RecordingError:
        raise
    except kinds as error:
        why = shorten_error(error) or type(error).__name__
        raise RecordingError(f"{path}: {what} ({why}){advice and ', '}{advice}") from None


def shorten_error(error: Exception) -> str:
    """Return what an error of a library says, as one short line."""
    text = " ".join(str(error).split())
    return text if len(text) <= 80 else f"{text[:77]}..."


def is_number(text: str) -> bool:
    """Tell whether a text is a number as Python writes it."""
    try:
        float(text)
    except ValueError:
        return False
    return True
