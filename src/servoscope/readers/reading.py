"""Files to recordings: opens a table, picks its columns and rows, and cleans what it finds."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from servoscope.errors import RecordingError
from servoscope.loop import Columns, Loop
from servoscope.readers.columns import find_channel, parse_combination
from servoscope.readers.tables import SUFFIXES, Table, number_column, open_table, seconds
from servoscope.recording import Defect, Recording, clean, with_defects

__all__ = ["SUFFIXES", "ChannelInfo", "channels", "read", "read_parts"]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
CLOCKS = ("t", "time", "zeit", "timestamp", "time_s", "seconds", "datetime", "date", "elapsed")


@dataclass(frozen=True)
class ChannelInfo:
    """A column of a file: its name, Arrow type, and smallest and largest number (NaN if it holds none)."""

    name: str
    dtype: str
    min: float
    max: float


def channels(path: str | Path) -> list[ChannelInfo]:
    """Return what columns a file has, in its order.

    Raises
    ------
    RecordingError
        If the file cannot be read.
    """
    table = open_table(path)
    infos = []
    for name, column in table.columns.items():
        try:
            numbers = number_column(table, name, "channel")
            numbers = numbers[np.isfinite(numbers)]
        except RecordingError:
            numbers = np.empty(0)
        low, high = (float(numbers.min()), float(numbers.max())) if numbers.size else (float("nan"), float("nan"))
        infos.append(ChannelInfo(name, str(column.type), low, high))
    return infos


def read(
    path: str | Path,
    loop: Loop | None = None,
    *,
    columns: Columns | None = None,
    where: Mapping[str, str] | None = None,
) -> Recording:
    """Read a recording.

    Parameters
    ----------
    path
        CSV (any delimiter, decimal comma with ``;``), Parquet, or MAT (v5 and v7.3).
    loop
        The loop it was taken from: columns, sample rate, input limits. None: columns t, r, u, y and the
        rate as measured.
    columns
        Where the signals stand; overrides the loop's.
    where
        Rows to take, by column: a value, several with commas, or a range, ``{"load": "20", "run": "1-5"}``.

    Raises
    ------
    RecordingError
        If the file cannot be used.
    LoopError
        If a column is not a linear combination of channels.
    """
    table = open_table(path)
    chosen = _chosen(table, where)
    return _recording(table, loop, columns, chosen, table.name)


def read_parts(
    path: str | Path,
    loop: Loop | None = None,
    *,
    columns: Columns | None = None,
    where: Mapping[str, str] | None = None,
    by: str | None = None,
) -> list[Recording]:
    """Read several recordings out of one file, one per value of the column `by`, in the order of appearance.

    Parameters are those of `read`; a recording is called ``file.csv[run=6]``. Without `by`, there is one.

    Raises
    ------
    RecordingError
        If the file, or one of the parts, cannot be used.
    LoopError
        If a column is not a linear combination of channels.
    """
    table = open_table(path)
    chosen = _chosen(table, where)
    if by is None:
        return [_recording(table, loop, columns, chosen, table.name)]
    cells = _cells(table, find_channel(by, table.columns, f"{table.name}: by"))
    values = list(dict.fromkeys(cells[chosen].tolist()))
    return [_recording(table, loop, columns, chosen & (cells == v), f"{table.name}[{by}={_plain(v)}]") for v in values]


def _recording(table: Table, loop: Loop | None, columns: Columns | None, chosen: BoolArray, name: str) -> Recording:
    columns = columns or (loop.columns if loop is not None else Columns())
    rate = loop.sample_rate if loop is not None else None
    keys = {"reference": columns.reference, "input": columns.input, "output": columns.output}
    signals = {key: _combined(table, text, f"{table.name}: [columns] {key}")[chosen] for key, text in keys.items()}
    t, uniform = _time(table, columns, rate, int(chosen.sum()))
    notes = _torn_notes(table, t, chosen)
    t = t[chosen] if not uniform else t
    recording = clean(
        t,
        signals["reference"],
        signals["input"],
        signals["output"],
        name=name,
        sample_rate=rate,
        run=_runs(table, columns.segment)[chosen],
        limits=loop.input_limits if loop is not None else None,
        labels=tuple(_label(letter, text) for letter, text in zip("ruy", keys.values(), strict=True)),  # type: ignore[arg-type]
    )
    if uniform:
        message = f"no time column: rows taken as uniform at {recording.sample_rate:g} Hz"
        notes.append(Defect("clock", float(recording.t[0]), float(recording.t[-1]), recording.samples, message))
    return with_defects(recording, *notes)


def _time(table: Table, columns: Columns, rate: float | None, rows: int) -> tuple[FloatArray, bool]:
    """Return the time [s] of all rows of the table, or of `rows` uniform ones and True."""
    wanted = columns.time
    if wanted is not None and (wanted in table.columns or wanted != Columns().time):
        return seconds(
            table, find_channel(wanted, table.columns, f"{table.name}: [columns] time"), columns.time_unit
        ), False
    # A clock under another name must not be thrown away for a uniform one.
    clock = next((name for name in table.columns if re.split(r"[\s\[(]", name.casefold())[0] in CLOCKS), None)
    if wanted is not None and (clock is not None or rate is None):
        hint = (
            f"is it {clock!r}? then say so in [columns] time"
            if clock
            else "give a loop, whose sample rate is taken then"
        )
        raise RecordingError(f"{table.name}: [columns] time: no column {wanted!r}, {hint}")
    if rate is None:
        raise RecordingError(f"{table.name}: has no time column, give a loop with its sample rate")
    return np.arange(rows) / rate, True


def _combined(table: Table, text: str, where: str) -> FloatArray:
    known = [*table.columns, *table.others]
    combination = parse_combination(text, known, where)
    total = np.full(table.rows, combination.constant)
    for name, factor in combination.factors.items():
        if name in table.others:
            raise RecordingError(f"{where}: {name!r} {table.others[name]}")
        total += factor * number_column(table, name, where.rpartition(": ")[2])
    return total


def _label(letter: str, text: str) -> str:
    return letter if text == letter else f"{letter} ({text!r})"


def _runs(table: Table, segment: tuple[str, ...]) -> npt.NDArray[np.int64]:
    changes = np.zeros(table.rows, dtype=bool)
    for column in segment:
        cells = _cells(table, find_channel(column, table.columns, f"{table.name}: [columns] segment"))
        changes[1:] |= cells[1:] != cells[:-1]
    return np.cumsum(changes)


def _torn_notes(table: Table, t: FloatArray, chosen: BoolArray) -> list[Defect]:
    notes = []
    for before, number, text in table.broken:
        index = min(max(before - 1, 0), chosen.size - 1)
        if chosen[index]:
            at = float(t[index]) if index < t.size else float("nan")
            shown = text if len(text) <= 30 else f"{text[:27]}..."
            notes.append(Defect("text", at, at, 1, f"row {number} is torn and dropped: {shown!r}"))
    return notes


def _cells(table: Table, name: str) -> npt.NDArray[np.generic]:
    """Return a column's cells for comparison, shape (N,): numbers, or text without blanks around it."""
    import pyarrow as pa

    kind = table.columns[name].type
    if pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind):
        # NaN differs from itself and would start a run at every row: an empty cell becomes a value.
        return np.nan_to_num(number_column(table, name, "segment"), nan=np.inf)
    return np.array([str(cell if cell is not None else "").strip() for cell in table.columns[name].to_pylist()])


def _plain(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _chosen(table: Table, where: Mapping[str, str] | None) -> BoolArray:
    chosen = np.ones(table.rows, dtype=bool)
    for column, wanted in (where or {}).items():
        name = find_channel(column, table.columns, f"{table.name}: where")
        cells = _cells(table, name)
        mask = np.zeros(table.rows, dtype=bool)
        for item in str(wanted).split(","):
            mask |= _matches(cells, item.strip(), f"{table.name}: where {name}={wanted}")
        if not mask.any():
            values = [_plain(value) for value in dict.fromkeys(cells.tolist())]
            shown = ", ".join(values[:10]) + (", ..." if len(values) > 10 else "")
            raise RecordingError(f"{table.name}: where {name}={wanted}: no such rows, {name} takes {shown}")
        chosen &= mask
    if not chosen.any():
        raise RecordingError(f"{table.name}: where: no row meets all conditions together, drop one of them")
    return chosen


def _matches(cells: npt.NDArray[np.generic], item: str, context: str) -> BoolArray:
    if cells.dtype.kind != "f":
        return np.asarray(cells == item, dtype=bool)
    number = r"[-+]?\d*\.?\d+(?:[eE][-+]?\d+)?"
    if re.fullmatch(number, item):
        return np.asarray(cells == float(item), dtype=bool)
    between = re.fullmatch(rf"({number})\s*-\s*({number})", item)
    if between is None:
        raise RecordingError(f"{context}: {item!r} is neither a number nor a range such as 1-5")
    numbers = np.asarray(cells, dtype=np.float64)
    return (numbers >= float(between[1])) & (numbers <= float(between[2]))
