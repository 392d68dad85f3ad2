"""Files to recordings: picks columns and rows piece by piece, and cleans what it finds."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.errors import RecordingError
from servoscope.models.loop import Columns, Loop, TextLayout
from servoscope.signals import Recording
from servoscope.signals.readers.columns import LinearCombination, find_channel, parse_combination
from servoscope.signals.readers.formats import open_file
from servoscope.signals.readers.frames import Source, open_source
from servoscope.signals.readers.logged_rows import Log, LoggedRows
from servoscope.signals.readers.rasters import join_rasters, raster_clocks
from servoscope.signals.readers.select import CellReader, ColumnTypeChanged, RowFilter, format_cell
from servoscope.signals.readers.table import Table, TableFile, TimeColumn, number_column
from servoscope.signals.readers.wrap import Unwrapper
from servoscope.signals.resample import ResampleTarget
from servoscope.signals.samples import Samples

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
