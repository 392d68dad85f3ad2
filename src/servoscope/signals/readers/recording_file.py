"""Files to recordings: picks columns and rows piece by piece, and cleans what it finds."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.core import outofcore
from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.errors import RecordingError
from servoscope.core.messages import message
from servoscope.core.outofcore import GrowableArray
from servoscope.models.loop import Columns, Loop, TextLayout
from servoscope.signals import Defect, Recording, clean, with_defects
from servoscope.signals.readers.columns import LinearCombination, find_channel, parse_combination
from servoscope.signals.readers.formats import open_file
from servoscope.signals.readers.frames import Source, open_source
from servoscope.signals.readers.rasters import join_rasters, raster_clocks
from servoscope.signals.readers.select import CellReader, ColumnTypeChanged, RowFilter, format_cell
from servoscope.signals.readers.table import Table, TableFile, TimeColumn, number_column
from servoscope.signals.readers.wrap import Unwrapper
from servoscope.signals.resample import ResampleTarget
from servoscope.signals.samples import Samples
from servoscope.signals.time_axis import build_time_axis

MIN_EPOCH_S, MAX_EPOCH_S = 3e8, 5e9  # a time stamp between them counts from 1970: from 1979 to 2128
ROW_RATE_HINT = "say at which rate its rows came, --rate 200 for 200 Hz (t=row/200 in --columns)"
TIME_NAMES = ("t", "time", "zeit", "timestamp", "time_s", "seconds", "datetime", "date", "elapsed")


@dataclass(frozen=True)
class ChannelInfo:
    """A column of a file: its name, Arrow type, and smallest and largest number (NaN if it holds none).

    `clock`: where a file has several rasters, the column with the time stamps of this one, which may be itself; `rows`:
    how many it has.
    """

    name: str
    dtype: str
    min: float
    max: float
    clock: str = ""
    rows: int = 0


def list_channels(path: str | Path, text: TextLayout | None = None) -> list[ChannelInfo]:
    """Return what columns a file has, in its order; `text`: what the user says of the layout of a text file.

    Raises RecordingError if the file cannot be read.
    """
    opened = open_file(path, text)
    ranges: dict[str, list[tuple[float, float]]] = {name: [] for name in opened.columns}
    rows = dict.fromkeys(opened.columns, 0)
    types: dict[str, list[str]] = {name: [] for name in opened.columns}
    for table in (table for names in opened.channel_groups or [opened.columns] for table in opened.iter_chunks(names)):
        for name, column in table.columns.items():
            types[name].append(str(column.type))
            rows[name] += len(column)
            try:
                numbers = number_column(table, name, "channel")
            except RecordingError:
                continue
            numbers = numbers[np.isfinite(numbers)]
            if numbers.size:
                ranges[name].append((float(numbers.min()), float(numbers.max())))
    clocks = raster_clocks(opened)
    listed = (_channel_info(name, types[name], ranges[name]) for name in opened.columns)
    return [replace(channel, clock=clocks.get(channel.name, ""), rows=rows[channel.name]) for channel in listed]


def _channel_info(name: str, types: list[str], ranges: list[tuple[float, float]]) -> ChannelInfo:
    kind = next((kind for kind in ("string", "double") if kind in types), types[0])  # what the whole column would be
    if not ranges or (kind == "string" and len(ranges) < len(types)):
        return ChannelInfo(name, kind, float("nan"), float("nan"))
    return ChannelInfo(name, kind, min(low for low, _ in ranges), max(high for _, high in ranges))


def read(
    path: Source,
    loop: Loop | str | Path | None = None,
    *,
    columns: Columns | None = None,
    where: Mapping[str, str] | None = None,
) -> Recording:
    """Read a recording.

    Parameters
    ----------
    path
        CSV and other text, Parquet, MAT (v5 and v7.3), HDF5, and with ``servoscope[formats]`` MDF (3 and 4), TDMS,
        Excel, LabVIEW (.lvm), MCAP of ROS 2 and ULog; any of them in .gz or .zip.
    loop
        The loop it was taken from, or its path: columns, sample rate, input limits. None: columns t, r, u, y, rate as
        measured.
    columns
        Where the signals stand; overrides the loop's.
    where
        Rows to take, by column: a value, several with commas, or a range, ``{"load": "20", "run": "1-5"}``.

    Raises RecordingError if the file cannot be used, LoopError if a column is not a linear combination of channels.

    Examples
    --------
    >>> read("monday.csv", "loop.toml")
    Recording(name: monday.csv, length: 60 s, samples: 12000, rate: 200 Hz, defects: 0)
    """
    (recording,) = read_parts(path, loop, columns=columns, where=where)
    return recording


def read_parts(
    path: Source,
    loop: Loop | str | Path | None = None,
    *,
    columns: Columns | None = None,
    where: Mapping[str, str] | None = None,
    by: str | None = None,
) -> list[Recording]:
    """Read several recordings out of one file, one per value of the column `by`, in the order of appearance.

    Parameters and errors are those of `read`; a recording is called ``file.csv[run=6]``. Without `by`, there is one.

    Examples
    --------
    >>> [part.name for part in read_parts("friday.csv", "loop.toml")]
    ['friday.csv']
    """
    loop = None if loop is None else Loop.of(loop)
    columns = columns or (loop.columns if loop is not None else Columns())
    log = _read_log(path, loop, columns, where or {}, by)
    return [part.dated_recording(log) for part in log.parts.values()]


def read_log(path: str | Path, loop: Loop, by: str | None = None) -> Log:
    """Read the rows of a file without judging them, as a service follows them; `by`: as in `read_parts`.

    Raises RecordingError if the file cannot be used, LoopError if a column is not a linear combination of channels.
    """
    return _read_log(path, loop, loop.columns, {}, by)


def read_rows(
    source: Source,
    columns: Columns | None = None,
    where: Mapping[str, str] | None = None,
    by: str | None = None,
    span: tuple[float, float] = (-math.inf, math.inf),
) -> dict[str, Samples]:
    """Read rows without judging them, by the recording's name: signals may be constant, and values may be missing.

    Of `span`, from and to [s on the recording's clock]. Then dates become seconds since 1970, so that logs can be
    compared. Other parameters and errors are those of `read_parts`.
    """
    log = _read_log(source, None, columns or Columns(), where or {}, by)
    parts = {part.name: part.samples() for part in log.parts.values()}
    if span != (-math.inf, math.inf):
        parts = {name: rows[(rows.t >= span[0]) & (rows.t < span[1])] for name, rows in parts.items()}
    return {name: replace(rows, t=rows.t + log.origin) if log.origin else rows for name, rows in parts.items()}


def read_channels(path: Source, columns: Columns) -> tuple[str, FloatArray, dict[str, FloatArray]]:
    """Return the name of a file, its time stamps [s] as logged (N,), and the covariates of `columns`, (N,) each.

    Raises RecordingError if the file cannot be used, LoopError if a column is not a linear combination of channels.
    """
    rows = _read_log(path, None, columns, {}, None).parts[""]
    (t, *_), _, channels = rows.split_columns()
    return rows.name, t, channels


def first_time(path: str | Path, loop: Loop) -> float:
    """Return the first time stamp of a file [s since 1970, or since its own beginning]; NaN if it has none.

    Raises RecordingError if the file cannot be read.
    """
    opened = open_source(path, loop.columns.text)
    clock = _find_time_column(opened, loop.columns, loop)
    if clock is not None:
        for table in opened.iter_chunks(clock.columns, clock.texts):
            t = clock.seconds(table)
            if np.isfinite(t).any():
                return clock.origin + float(t[np.isfinite(t)][0])
    return float("nan")


def _read_log(path: Source, loop: Loop | None, columns: Columns, where: Mapping[str, str], by: str | None) -> Log:
    texts: set[str] = set()
    while True:
        try:
            return _read_rows(open_source(path, columns.text), loop, columns, where, by, texts)
        except ColumnTypeChanged as changed:  # what was taken for numbers belongs to a column of text
            texts.add(changed.column)


def _read_rows(
    opened: TableFile, loop: Loop | None, columns: Columns, where: Mapping[str, str], by: str | None, texts: set[str]
) -> Log:
    name, known = opened.name, opened.known
    columns = _without_reference(opened, columns, loop)
    chosen = RowFilter(opened, where)
    apart = None if by is None else CellReader(find_channel(by, known, f"{name}: by"))
    sensors = columns.outputs if len(columns.outputs) > 1 else ()
    of_plant = {} if loop is None else loop.plant.channels
    texts_by_key = {
        "[columns] reference": (columns.reference,),
        "[columns] input": (columns.input,),
        "[columns] output": columns.outputs,
        **{f"[columns] covariates.{covariate}": (text,) for covariate, text in columns.covariates.items()},
        **{f"[plant] {channel}": (text,) for channel, text in of_plant.items()},
    }
    signals = {
        key: [_parse_signal(opened, text, f"{name}: {key}") for text in several]
        for key, several in texts_by_key.items()
    }
    unwrappers = {
        (name, period): Unwrapper(period)
        for several in signals.values()
        for signal in several
        for name, period in signal.wraps.items()
    }
    clock = _find_time_column(opened, columns, loop)
    segments = [CellReader(find_channel(x, known, f"{name}: [columns] segment")) for x in columns.segment]
    wanted = {*chosen.columns, *(x for several in signals.values() for signal in several for x in signal.factors)}
    wanted |= {reader.column for reader in (apart, *segments) if reader is not None}
    if clock is not None:
        wanted |= set(clock.columns)
        texts |= clock.texts
    shown = {"r": columns.reference, "u": columns.input, "y": " and ".join(columns.outputs)}
    r, u, y = (letter if letter == text else f"{letter} ({text!r})" for letter, text in shown.items())
    carried = (*sensors, *columns.covariates, *of_plant)
    target = _resample_target(columns, loop)
    parts_of = {key.split()[-1]: {x for signal in several for x in signal.factors} for key, several in signals.items()}
    joined = target and join_rasters(opened, wanted, columns, parts_of["input"], parts_of["output"], target)
    if joined:
        opened, clock, target = joined
    options = clock is not None, columns.row_rate, carried, loop, (r, u, y), target
    parts: dict[str, LoggedRows] = {}
    run = 0
    for table in opened.iter_chunks(wanted, texts):
        mask = chosen.mask(table)
        rows: dict[str, BoolArray] = {"": mask}
        if apart is not None:
            cells = apart.read(table)
            rows = {format_cell(v): mask & (cells == v) for v in dict.fromkeys(cells[mask].tolist())}
        evaluated = {
            what: [_evaluate_signal(table, combination, what, unwrappers) for combination in several]
            for what, several in signals.items()
        }
        *of_loop, outputs = [*evaluated.values()][:3]
        values = [*(several[0] for several in of_loop), outputs[0] if len(outputs) == 1 else np.mean(outputs, axis=0)]
        if clock is not None:
            values.insert(0, clock.seconds(table))
        if segments:
            runs = run + np.cumsum(np.any([segment.changes(table) for segment in segments], axis=0))
            run = int(runs[-1])
            values.append(runs)
        values += [*(outputs if sensors else ()), *(several[0] for several in [*evaluated.values()][3:])]
        for value, mine in rows.items():
            if value not in parts:
                parts[value] = LoggedRows(name if by is None else f"{name}[{by}={value}]", *options)
            parts[value].add(table, values, mine)
    chosen.check_matched()
    return Log(parts, clock.origin, clock.is_utc) if clock is not None else Log(parts, 0.0)


def _resample_target(columns: Columns, loop: Loop | None) -> ResampleTarget | None:
    """Return what rows are resampled to; None where nobody asks for it."""
    if not columns.resample:
        return None
    return ResampleTarget(loop.sample_rate, loop.cutoff, loop.hold) if loop is not None else ResampleTarget()


def _without_reference(opened: TableFile, columns: Columns, loop: Loop | None) -> Columns:
    """Return columns in which u stands for a reference that nobody named and the file does not have.

    In a loop that r has a part in, it has to be there: one with a controller, stage 1, or a sign from r.
    """
    if columns.reference != Columns().reference or columns.reference in opened.known:
        return columns
    defaults = columns.input == Columns().input and columns.input not in opened.known
    if defaults or (loop is not None and loop.needs_reference):
        return columns
    _parse_signal(opened, columns.input, f"{opened.name}: [columns] input")  # what is missing is told as what it is
    return columns.model_copy(update={"reference": columns.input})


class LoggedRows:
    """The rows of one recording, as they come: time if the file has it, r, u, y, runs if there are some, channels."""

    def __init__(
        self,
        name: str,
        timed: bool,
        row_rate: float | None,
        channels: tuple[str, ...],
        loop: Loop | None,
        labels: tuple[str, str, str],
        target: ResampleTarget | None,
    ) -> None:
        self.name, self._has_time, self._channels = name, timed, channels
        self._loop, self._labels, self._row_rate = loop, labels, row_rate or (loop.sample_rate if loop else None)
        self._target = target if timed or row_rate else None
        self._columns: list[GrowableArray] = []
        self._broken: list[tuple[int, float, int, str]] = []
        self._rows = 0

    def add(self, table: Table, values: list[npt.NDArray[Any]], rows: BoolArray) -> None:
        """Take some rows of a piece."""
        for before, number, text in table.broken:
            index = min(max(before - 1, 0), rows.size - 1)
            if rows[index]:
                at = float(values[0][index]) if self._has_time else float("nan")
                self._broken.append((self._rows + int(rows[:index].sum()), at, number, text))
        self._columns = self._columns or [GrowableArray() for _ in values]
        for column, x in zip(self._columns, values, strict=True):
            column.append(x if rows.all() else x[rows])
        self._rows += int(rows.sum())

    @property
    def _rate(self) -> float | None:
        return self._loop.sample_rate if self._loop is not None else None

    def split_columns(self) -> tuple[list[FloatArray], FloatArray | None, dict[str, FloatArray]]:
        """Return t, r, u and y; the runs, if there are some; the channels."""
        columns = [column.to_array() for column in self._columns]
        if not self._has_time:
            columns.insert(0, _uniform_time(self._rows, self._row_rate or 1.0))
        covariates = dict(zip(self._channels, columns[len(columns) - len(self._channels) :], strict=True))
        signals, runs = columns[:4], columns[4 : len(columns) - len(self._channels)]
        return signals, runs[0] if runs else None, covariates

    def samples(self) -> Samples:
        """Return the rows in the order of time, and resampled where that is asked for; nothing else is done to them.

        Raises RecordingError if their time stamps are unusable, or their rate is not the loop's.
        """
        if self._target is not None:
            return self._clean(*self.split_columns())
        (t, *signals), run, channels = self.split_columns()
        axis = build_time_axis(t, run, self._rate, self.name, signals=signals)
        r, u, y = map(axis.reorder, signals)
        others = {name: axis.reorder(channel) for name, channel in channels.items()}
        return Samples.from_columns(axis.t, r, u, y, np.diff(axis.run, prepend=0) > 0, others)

    def dated_recording(self, log: Log) -> Recording:
        """Return the rows cleaned; time stamps that are seconds since 1970 count from the first of them."""
        (t, *signals), run, covariates = self.split_columns()
        began = log.origin
        if not began and t.size and MIN_EPOCH_S < t[0] < MAX_EPOCH_S:
            began = float(np.floor(t[0]))
            t = t if t.flags.writeable else t.copy()
            for rows in outofcore.iter_chunks(0, t.size, t):
                t[rows] -= began
        recording = self._clean([t, *signals], run, covariates)
        return replace(recording, began=began, zone="UTC" if log.is_utc else "") if began else recording

    def _clean(self, signals: list[FloatArray], run: FloatArray | None, covariates: dict[str, FloatArray]) -> Recording:
        notes = [self._note(*torn, signals[0]) for torn in self._broken]
        recording = clean(
            *signals,
            name=self.name,
            sample_rate=self._rate,
            run=run,
            limits=None if self._loop is None else self._loop.input_limits,
            labels=self._labels,
            channels=covariates,
            target=self._target,
        )
        if not self._has_time:
            text = message("defect.no_time", rate=self._row_rate)
            notes.append(Defect("clock", float(recording.t[0]), float(recording.t[-1]), recording.samples, text))
        return with_defects(recording, *notes)

    def _note(self, row: int, at: float, number: int, text: str, t: FloatArray) -> Defect:
        at = at if self._has_time else float(t[row])
        shown = text if len(text) <= 30 else f"{text[:27]}..."
        return Defect("text", at, at, 1, message("defect.torn", row=number, text=shown))


@dataclass(frozen=True, eq=False)
class Log:
    """What a file holds."""

    parts: dict[str, LoggedRows]  # by what their column says, in the order of appearance; without one, all under ""
    origin: float  # what makes seconds since 1970 of their time stamps, where dates are known [s]
    is_utc: bool = True  # whether they are UTC then


def _uniform_time(rows: int, rate: float) -> FloatArray:
    t = outofcore.empty((rows,))
    for piece in outofcore.iter_chunks(0, rows, t):
        t[piece] = np.arange(piece.start, piece.stop) / rate
    return t


def _find_time_column(opened: TableFile, columns: Columns, loop: Loop | None) -> TimeColumn | None:
    """Return the time column; None where rows are uniform."""
    if columns.row_rate is not None:
        return None
    wanted, known = columns.time, opened.known
    where = f"{opened.name}: [columns] time"
    # A clock under another name must not be thrown away for a uniform one.
    clock = next((name for name in known if re.split(r"[\s\[(]", name.casefold())[0] in TIME_NAMES), None)
    if wanted is not None and wanted not in known and "+" in wanted:
        parts = [find_channel(part, known, where) for part in wanted.split("+")]
        return TimeColumn(parts, columns.time_unit, columns.time_zone)
    if wanted is not None and (wanted in known or wanted != Columns().time):
        return TimeColumn([find_channel(wanted, known, where)], columns.time_unit, columns.time_zone)
    if wanted is not None and clock is not None:
        raise RecordingError(f"{where}: no column {wanted!r}, is it {clock!r}? then say so in [columns] time")
    if loop is None:
        raise RecordingError(f"{opened.name}: has no time column: {ROW_RATE_HINT}")
    return None


def _parse_signal(opened: TableFile, text: str, where: str) -> LinearCombination:
    combination = parse_combination(text, [*opened.known, *opened.non_channels], where)
    for name in combination.factors:
        if name in opened.non_channels:
            raise RecordingError(f"{where}: {name!r} {opened.non_channels[name]}")
    return combination


def _evaluate_signal(
    table: Table, combination: LinearCombination, what: str, unwrappers: Mapping[tuple[str, float], Unwrapper]
) -> FloatArray:
    total = np.full(table.rows, combination.constant)
    for name, factor in combination.factors.items():
        x = number_column(table, name, what)
        if name in combination.wraps:
            x = unwrappers[name, combination.wraps[name]].unwrap(table, x)
        total += factor * x
    return total


def as_recording(source: Recording | Source, loop: Loop | None = None) -> Recording:
    """Return a recording as it is, and anything else as `read` reads it."""
    return source if isinstance(source, Recording) else read(source, loop)
