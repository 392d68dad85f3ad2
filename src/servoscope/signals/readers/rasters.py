"""Topics, rasters and tables with clocks of their own: their channels are put on one clock."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import RecordingError
from servoscope.models.columns import Columns
from servoscope.signals.readers.guess_columns import TIME_UNITS, guess_columns
from servoscope.signals.readers.table import TableFile, TimeColumn, number_column
from servoscope.signals.readers.units import split_unit
from servoscope.signals.resample import ResampleTarget, resample_rows

MIN_RASTER_ROWS = 4  # that a spline goes through


def raster_clocks(opened: TableFile) -> dict[str, str]:
    """Return the column with the time stamps of each channel, itself among them, where a file has several rasters."""
    if len(opened.channel_groups) < 2:
        return {}
    clocks = {group: guess_columns(group).get("t") for group in opened.channel_groups}
    return {name: clock for group, clock in reversed(clocks.items()) if clock is not None for name in group}


class _RasterSignals(NamedTuple):
    """Channels that were sampled together: stamps [s], rising, (N,), and values, (N,) each."""

    t: FloatArray
    channels: dict[str, FloatArray]

    @property
    def period(self) -> float:
        return float(np.median(np.diff(self.t)))


class JoinedRasters(NamedTuple):
    """Channels on one clock, as a table; the clock; and the target with the error that this has made."""

    opened: TableFile
    clock: TimeColumn
    target: ResampleTarget


def join_rasters(
    opened: TableFile,
    wanted: Collection[str],
    columns: Columns,
    held: Collection[str],
    output: Collection[str],
    target: ResampleTarget,
) -> JoinedRasters | None:
    """Return the wanted channels of a file on one clock; None where they are of one raster.

    Each raster is resampled to the target's rate, or to that of the raster of the output. `held`: the channels of u.
    Raises RecordingError if a raster has no time column, or they do not overlap.
    """
    if len(opened.channel_groups) < 2:
        return None
    clocks = raster_clocks(opened)
    wanted, held, output = ({opened.aliases.get(name, name) for name in names} for names in (wanted, held, output))
    channels = [name for name in opened.columns if name in wanted and name not in clocks.values()]
    groups = _split(channels, opened.channel_groups)
    if len(groups) < 2:
        return None
    missing = next((name for names in groups for name in names if name not in clocks), None)
    if missing is not None:
        raise RecordingError(f"{opened.path}: {missing!r} has no time column of its own, export it with one")
    rasters = [_read_raster(opened, clocks[names[0]], names, columns) for names in groups]
    base = next((raster for raster in rasters if raster.channels.keys() & set(output)), rasters[0])
    slowest = max(rasters, key=lambda raster: raster.period)
    full = target.at(1.0 / base.period, slowest.t)
    begin = max(float(raster.t[0]) for raster in rasters)
    samples: list[dict[int, int]] = []
    values: list[tuple[str, FloatArray]] = []
    error = 0.0
    for raster in rasters:
        run = np.zeros(raster.t.size, dtype=np.int32)
        inputs = {index for index, name in enumerate(raster.channels) if name in held}
        rows = resample_rows(raster.t, run, [*raster.channels.values()], inputs, full, opened.name, begin)
        number = np.rint((rows.t - begin) * full.rate).astype(np.int64)
        samples.append({k: index for index, k in enumerate(number.tolist())})
        values += zip(raster.channels, rows.columns, strict=True)
        error = max(error, rows.error)
    common = sorted(set.intersection(*(set(numbers) for numbers in samples)) - {k for k in samples[0] if k < 0})
    if not common:
        raise RecordingError(f"{opened.path}: {', '.join(names[0] for names in groups)} have no time in common")
    where = [np.array([numbers[k] for k in common]) for numbers in samples]
    place = {name: index for index, raster in enumerate(rasters) for name in raster.channels}
    table: dict[str, Any] = {name: x[where[place[name]]] for name, x in values}
    clock = clocks[next(iter(base.channels))]
    table[clock] = begin + np.array(common) / full.rate
    joined = TableFile.from_columns(opened.path, table, aliases=opened.aliases)
    return JoinedRasters(joined, TimeColumn([clock], "s"), full._replace(before=error))


def _split(channels: Sequence[str], groups: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return channels by their rasters, as few as there may be."""
    left, split = list(channels), list[list[str]]()
    while left:
        most = max(groups, key=lambda group: len({*group} & {*left}))
        split.append([name for name in left if name in most])
        left = [name for name in left if name not in most]
    return split


def _read_raster(opened: TableFile, clock: str, names: Sequence[str], columns: Columns) -> _RasterSignals:
    """Return channels of one raster in the order of time, without rows that lack a value."""
    unit = TIME_UNITS.get(split_unit(clock)[1], columns.time_unit)
    stamps = TimeColumn([clock], unit, columns.time_zone)
    pieces: list[list[FloatArray]] = []
    for table in opened.iter_chunks({clock, *names}):
        pieces.append([stamps.seconds(table), *(number_column(table, name, "channel") for name in names)])
    t, *signals = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    t = t + stamps.origin
    known = np.flatnonzero(np.all([np.isfinite(x) for x in (t, *signals)], axis=0))
    known = known[np.argsort(t[known], kind="stable")]
    known = known[np.append(True, np.diff(t[known]) > 0.0)] if known.size else known
    if known.size < MIN_RASTER_ROWS:
        raise RecordingError(f"{opened.path}: {names[0]!r} has {known.size} values with a time stamp, too few")
    return _RasterSignals(t[known], {name: x[known] for name, x in zip(names, signals, strict=True)})
