"""Where the table begins in the rows of a text file or a sheet: preambles, headers, rows of units, kinds of cells."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from servoscope.core.errors import RecordingError
from servoscope.signals.readers.clock import is_clock
from servoscope.signals.readers.guess_columns import guess_columns
from servoscope.signals.readers.table import NULL_TEXTS, TIME_UNITS, is_number
from servoscope.signals.readers.units import is_unit, parse_quantity, with_unit

HEAD_ROWS = 400  # of a text or a sheet, that tell where the table begins
LOOKAHEAD_ROWS = 5  # rows that tell whether a table begins
TABLE_ROW_SHARE = 0.6  # share of them that must look like rows of it
MAX_UNIT_LENGTH = 12  # of a cell in a row of units
THOUSANDS = re.compile(
    r"[-+]?\d{1,3}(?:(?:\.\d{3})+,\d+|(?:,\d{3})+\.\d+)"
)  # signs between thousands, and a decimal one
PAIR_KEY = "Name"  # before each channel's name in an export of TwinCAT Scope, as the other keys before their values
SAMPLE_TIME_KEY = re.compile(r"SampleTime\[(\w+)\]")


@dataclass(frozen=True)
class TableStart:
    """Names of the columns, empty where a column has none and is empty, and the index of the first row of cells."""

    names: tuple[str, ...]
    first: int


class TableShape(NamedTuple):
    """How many columns a table has, which of them hold numbers, and which rows look like rows of it."""

    width: int
    numeric: list[int]
    begun: list[bool]

    @property
    def score(self) -> tuple[int, int]:
        """How well its lines are split: rows times columns of numbers, two or more columns first."""
        return min(len(self.numeric), 2), sum(self.begun) * len(self.numeric)


def is_numeric(cell: str) -> bool:
    """Tell whether a cell is a number, with a point or a comma, or a unit behind it, or a date or time."""
    return (
        is_number(cell)
        or is_number(cell.replace(",", ".", 1))
        or THOUSANDS.fullmatch(cell) is not None
        or parse_quantity(cell, "") is not None
        or is_clock(cell)
    )


def find_table(
    rows: Sequence[Sequence[str]], shape: TableShape, name: str, header: int | None = None
) -> TableStart | None:
    """Find a table among rows of cells; None if there is none.

    Parameters
    ----------
    rows
        The first rows of a file; blank lines are rows without cells.
    shape
        What `table_shape` says of them.
    name
        What errors call the file.
    header
        Index of the row of names, where the user says so.

    Raises RecordingError if two columns have the same name, or channels of TwinCAT Scope were sampled differently.
    """
    width, numeric, begun = shape
    for first, here in enumerate(begun):
        ahead = begun[first : first + LOOKAHEAD_ROWS]
        # a first row with text among its numbers is one of a header, unless the next one is a row too
        sure = _is_pure(rows[first], numeric) or all(ahead[:2])
        if here and sure and sum(ahead) >= TABLE_ROW_SHARE * len(ahead) and (header is None or first > header):
            break
    else:
        return None
    above = list(_rows_above(rows, first, width)) if header is None else [list(rows[header]) + [""] * width]
    names = _pick_names([row[:width] for row in above], width, name)
    if names is None:
        names = [f"c{index}" for index in range(width)]
    body = [row for row, is_row in zip(rows[first:], begun[first:], strict=True) if is_row]
    used = [any(index < len(row) and row[index].strip() for row in body) for index in range(width)]
    named = [label or (f"c{index}" if used[index] else "") for index, label in enumerate(names)]
    check_names(named, name)
    return TableStart(tuple(named), first)


def check_names(names: Sequence[str], file: str) -> None:
    """Refuse two columns of one name; raises RecordingError."""
    twice = next((name for name, count in Counter(names).items() if name and count > 1), None)
    if twice is not None:
        raise RecordingError(f"{file}: two columns are called {twice!r}, rename one of them")


def table_shape(rows: Sequence[Sequence[str]]) -> TableShape:
    """Return the shape of the table in rows of cells: as wide as most of the last rows are."""
    tail = [row for row in rows if row][-max(1, len(rows) // 2) :]
    widths = [len(row) for row in tail]
    width = max(dict.fromkeys(widths), key=widths.count, default=0)
    same = [row for row in tail if len(row) == width]
    numeric = []
    for index in range(width):
        filled = [row[index] for row in same if row[index].strip() not in NULL_TEXTS]
        if filled and sum(map(is_numeric, filled)) > 0.5 * len(filled):
            numeric.append(index)
    return TableShape(width, numeric, [_is_row(row, width, numeric) for row in rows])


def _is_row(row: Sequence[str], width: int, numeric: Sequence[int]) -> bool:
    """Tell whether a row belongs to the table: of its columns of numbers, more hold numbers than texts."""
    if len(row) != width:
        return False
    filled = [row[index] for index in numeric if row[index].strip() not in NULL_TEXTS]
    return 2 * sum(map(is_numeric, filled)) > len(filled)


def _is_pure(row: Sequence[str], numeric: Sequence[int]) -> bool:
    return all(index < len(row) and (row[index].strip() in NULL_TEXTS or is_numeric(row[index])) for index in numeric)


def _rows_above(rows: Sequence[Sequence[str]], first: int, width: int) -> list[list[str]]:
    """Return the rows right above the table that may say what its columns are, the nearest first."""
    above: list[list[str]] = []
    index = ""  # name of the first column, which frames of pandas with several rows of names have in a row of its own
    for row in reversed(rows[:first]):
        cells = list(row)
        while len(cells) > width and not cells[-1]:
            cells.pop()
        if not cells and not above:
            continue  # a blank line between header and rows
        alone = not above and width > 2 and len(cells) == width and [c for c in cells if c] == cells[:1]
        only_unit = alone and is_unit(cells[0].strip("[]() "))  # of the time: the others have none
        if alone and not only_unit and not index:
            index = cells[0]
            continue
        lacking = width - len(cells)
        # a preamble has another width; a row of names may lack the last, where lines end in a delimiter
        if not cells or lacking < 0 or lacking > 1 or (sum(map(bool, cells)) < min(2, width) and not only_unit):
            break
        above.append([cells[0] or index, *cells[1:]] + [""] * lacking)
    return above


def _pick_names(above: list[list[str]], width: int, file: str) -> list[str] | None:
    """Return the names of the columns, with the units of a row of units behind them."""
    keyed = {row[0]: row for row in above if row[0]}
    if PAIR_KEY in keyed and any(SAMPLE_TIME_KEY.fullmatch(key) for key in keyed):
        return _scope_names(keyed, width, file)
    units = next((row for row in above if _is_unit_row(row)), None) if len(above) > 1 else None
    others = [row for row in above if row is not units]
    # of several rows, that whose words tell most; descriptions stand below or above it
    row = max(others, key=lambda row: (len(guess_columns([c for c in row if c])), sum(map(bool, row))), default=None)
    if row is None:
        return None
    index = others.index(row)
    if len(set(filter(None, row))) < sum(map(bool, row)) and index + 1 < len(others):
        row = _join_headings(others[index + 1], row)
    if units is None:
        return row
    return [f"{cell} [{unit.strip('[]() ')}]" if cell and unit else cell for cell, unit in zip(row, units, strict=True)]


def _join_headings(groups: list[str], row: list[str]) -> list[str]:
    """Return names under headings of groups; one that spans several columns stands over the first of them."""
    names, group = [], ""
    for heading, cell in zip(groups, row, strict=True):
        group = heading or group
        names.append(f"{group}.{cell}" if cell and row.count(cell) > 1 else cell)
    return names


def _is_unit_row(row: Sequence[str]) -> bool:
    filled = [cell for cell in row if cell]
    known = sum(is_unit(cell.strip("[]() ")) for cell in filled)
    # one that is not known is no reason to take the others for nothing
    return bool(filled) and 2 * known > len(filled) and all(len(cell) <= MAX_UNIT_LENGTH for cell in filled)


def _scope_names(keyed: dict[str, list[str]], width: int, file: str) -> list[str]:
    """Return names of an export of TwinCAT Scope: each channel has columns of time and value, or all share the time.

    Source: Beckhoff, TE13xx TwinCAT 3 Scope View, "Export in csv"; rows are key and value by turns.
    """
    row = keyed[PAIR_KEY]
    pairs = row[0::2].count(PAIR_KEY) > 1 or width == 2
    places = range(1, width, 2) if pairs else range(1, width)
    key = next(key for key in keyed if SAMPLE_TIME_KEY.fullmatch(key))
    if len({keyed[key][place] for place in places}) > 1:
        raise RecordingError(f"{file}: its channels have different sample times, export those of one sample time")
    match = SAMPLE_TIME_KEY.fullmatch(key)
    unit = match[1] if match is not None and match[1] in TIME_UNITS else "ms"
    names = [""] * width
    for place in places:
        of = keyed.get("Unit", [""] * width)[place]
        names[place] = with_unit(row[place], of)
        if pairs:
            names[place - 1] = f"time {1 + place // 2} [{unit}]"
    names[0] = f"time [{unit}]"
    return names
