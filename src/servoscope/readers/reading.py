"""Files to recordings: picks columns and rows piece by piece, and cleans what it finds."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope import spool
from servoscope.errors import RecordingError
from servoscope.loop import Columns, Loop
from servoscope.readers.columns import Combination, find_channel, parse_combination
from servoscope.readers.opening import SUFFIXES, Opened, open_file
from servoscope.readers.rows import Cells, Chosen, Mixed, plain
from servoscope.readers.tables import Clock, Table, number_column
from servoscope.recording import Defect, Recording, clean, with_defects
from servoscope.spool import Growing

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
    opened = open_file(path)
    ranges: dict[str, list[tuple[float, float]]] = {name: [] for name in opened.columns}
    kinds: dict[str, list[str]] = {name: [] for name in opened.columns}
    for table in (each for names in opened.together or [opened.columns] for each in opened.pieces(names)):
        for name, column in table.columns.items():
            kinds[name].append(str(column.type))
            try:
                numbers = number_column(table, name, "channel")
            except RecordingError:
                continue
            numbers = numbers[np.isfinite(numbers)]
            if numbers.size:
                ranges[name].append((float(numbers.min()), float(numbers.max())))
    return [_info(name, kinds[name], ranges[name]) for name in opened.columns]


def _info(name: str, kinds: list[str], ranges: list[tuple[float, float]]) -> ChannelInfo:
    kind = next((k for k in ("string", "double") if k in kinds), kinds[0])  # what the whole column would be
    if not ranges or (kind == "string" and len(ranges) < len(kinds)):
        return ChannelInfo(name, kind, float("nan"), float("nan"))
    return ChannelInfo(name, kind, min(low for low, _ in ranges), max(high for _, high in ranges))


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
        CSV (any delimiter, decimal comma with ``;``), Parquet, MAT (v5 and v7.3), MDF (3 and 4), or TDMS.
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
    (recording,) = read_parts(path, loop, columns=columns, where=where)
    return recording


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
    columns = columns or (loop.columns if loop is not None else Columns())
    texts: set[str] = set()
    while True:
        try:
            return _parts(open_file(path), loop, columns, where or {}, by, texts)
        except Mixed as found:  # what was taken for numbers belongs to a column of text
            texts.add(found.column)


def _parts(
    opened: Opened, loop: Loop | None, columns: Columns, where: Mapping[str, str], by: str | None, texts: set[str]
) -> list[Recording]:
    name, known = opened.name, opened.columns
    chosen = Chosen(opened, where)
    apart = None if by is None else Cells(find_channel(by, known, f"{name}: by"))
    keys = {"reference": columns.reference, "input": columns.input, "output": columns.output}
    signals = {f"[columns] {key}": _combination(opened, text, f"{name}: [columns] {key}") for key, text in keys.items()}
    clock = _clock(opened, columns, loop)
    segments = [Cells(find_channel(x, known, f"{name}: [columns] segment")) for x in columns.segment]
    wanted = {*chosen.columns, *(x for signal in signals.values() for x in signal.factors)}
    wanted |= {each.column for each in (apart, clock, *segments) if each is not None}
    parts: dict[str, _Part] = {}
    run = 0
    for table in opened.pieces(wanted, texts):
        mask = chosen.of(table)
        rows: dict[str, BoolArray] = {name: mask}
        if apart is not None:
            cells = apart.of(table)
            rows = {f"{name}[{by}={plain(v)}]": mask & (cells == v) for v in dict.fromkeys(cells[mask].tolist())}
        values = [_total(table, signal, what) for what, signal in signals.items()]
        if clock is not None:
            values.insert(0, clock.seconds(table))
        if segments:
            runs = run + np.cumsum(np.any([each.changes(table) for each in segments], axis=0))
            run = int(runs[-1])
            values.append(runs)
        for label, mine in rows.items():
            parts.setdefault(label, _Part(clock is not None)).add(table, values, mine)
    chosen.check()
    labels = {
        letter: letter if letter == text else f"{letter} ({text!r})"
        for letter, text in zip("ruy", keys.values(), strict=True)
    }
    return [part.recording(label, loop, (labels["r"], labels["u"], labels["y"])) for label, part in parts.items()]


class _Part:
    """The rows of one recording, as they come: time if the file has it, r, u, y, and runs if there are some."""

    def __init__(self, timed: bool) -> None:
        self._timed = timed
        self._columns: list[Growing] = []
        self._torn: list[tuple[int, float, int, str]] = []
        self._rows = 0

    def add(self, table: Table, values: list[npt.NDArray[Any]], rows: BoolArray) -> None:
        """Take some rows of a piece."""
        for before, number, text in table.broken:
            index = min(max(before - 1, 0), rows.size - 1)
            if rows[index]:
                at = float(values[0][index]) if self._timed else float("nan")
                self._torn.append((self._rows + int(rows[:index].sum()), at, number, text))
        self._columns = self._columns or [Growing() for _ in values]
        for column, x in zip(self._columns, values, strict=True):
            column.append(x if rows.all() else x[rows])
        self._rows += int(rows.sum())

    def recording(self, name: str, loop: Loop | None, labels: tuple[str, str, str]) -> Recording:
        """Return the rows cleaned."""
        rate = loop.sample_rate if loop is not None else None
        columns = [column.whole() for column in self._columns]
        if not self._timed:
            columns.insert(0, _uniform(self._rows, rate or 1.0))
        t, r, u, y = columns[:4]
        run = columns[4] if len(columns) > 4 else None
        limits = loop.input_limits if loop is not None else None
        notes = [self._note(*torn, t) for torn in self._torn]
        recording = clean(t, r, u, y, name=name, sample_rate=rate, run=run, limits=limits, labels=labels)
        if not self._timed:
            message = f"no time column: rows taken as uniform at {recording.sample_rate:g} Hz"
            notes.append(Defect("clock", float(recording.t[0]), float(recording.t[-1]), recording.samples, message))
        return with_defects(recording, *notes)

    def _note(self, row: int, at: float, number: int, text: str, t: FloatArray) -> Defect:
        at = at if self._timed else float(t[row])
        shown = text if len(text) <= 30 else f"{text[:27]}..."
        return Defect("text", at, at, 1, f"row {number} is torn and dropped: {shown!r}")


def _uniform(rows: int, rate: float) -> FloatArray:
    t = spool.empty((rows,))
    for piece in spool.pieces(0, rows, t):
        t[piece] = np.arange(piece.start, piece.stop) / rate
    return t


def _clock(opened: Opened, columns: Columns, loop: Loop | None) -> Clock | None:
    """Return the time column; None where rows are uniform."""
    wanted, known = columns.time, opened.columns
    if wanted is not None and (wanted in known or wanted != Columns().time):
        return Clock(find_channel(wanted, known, f"{opened.name}: [columns] time"), columns.time_unit)
    # A clock under another name must not be thrown away for a uniform one.
    clock = next((name for name in known if re.split(r"[\s\[(]", name.casefold())[0] in CLOCKS), None)
    if wanted is not None and (clock is not None or loop is None):
        hint = (
            f"is it {clock!r}? then say so in [columns] time"
            if clock
            else "give a loop, whose sample rate is taken then"
        )
        raise RecordingError(f"{opened.name}: [columns] time: no column {wanted!r}, {hint}")
    if loop is None:
        raise RecordingError(f"{opened.name}: has no time column, give a loop with its sample rate")
    return None


def _combination(opened: Opened, text: str, where: str) -> Combination:
    combination = parse_combination(text, [*opened.columns, *opened.others], where)
    for name in combination.factors:
        if name in opened.others:
            raise RecordingError(f"{where}: {name!r} {opened.others[name]}")
    return combination


def _total(table: Table, combination: Combination, what: str) -> FloatArray:
    total = np.full(table.rows, combination.constant)
    for name, factor in combination.factors.items():
        total += factor * number_column(table, name, what)
    return total
