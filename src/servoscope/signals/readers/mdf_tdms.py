"""Measurement files, MDF and TDMS: channels in rasters of their own, read chunk by chunk."""

from __future__ import annotations

import functools
import io
import logging
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from servoscope.core.errors import RecordingError
from servoscope.signals.readers.table import CHUNK_ROWS, TableFile, check_size, one_line_errors
from servoscope.signals.readers.units import with_unit

DEFAULT_TIME_NAME = "time"  # of a raster whose clock has no name


@dataclass(frozen=True, eq=False)
class _Raster:
    """Channels that were sampled together: number of rows, and where each channel is in the file.

    `labels`: names with their units behind them, by which the places are known, by the names in the file.
    """

    rows: int
    places: Mapping[str, Any]
    labels: Mapping[str, str]


# takes file, raster, names, first row, number of rows
_ReadChannels = Callable[[Any, _Raster, Sequence[str], int, int], Mapping[str, Any]]

MAX_RATIO = 1100  # rows per byte: of a byte each, deflated as far as deflate goes


def open_mdf(path: Path) -> TableFile:
    """Open an MDF file, version 3 or 4."""
    from asammdf import MDF

    logging.getLogger("asammdf").setLevel(logging.CRITICAL)  # broken files raise an error
    _ignore_external_attachments()

    def list_rasters(file: Any) -> list[_Raster]:
        rasters = []
        for g, group in enumerate(file.groups):
            master = file.masters_db.get(g)
            places: dict[str, Any] = {}
            labels: dict[str, str] = {}
            for i, channel in enumerate(group.channels):
                name = (channel.name or DEFAULT_TIME_NAME) if i == master else channel.name
                if name not in labels:
                    labels[name] = with_unit(name, str(file.get_channel_unit(group=g, index=i) or "").strip())
                    places[labels[name]] = None, g, i
            if group.channel_group.cycles_nr > MAX_RATIO * path.stat().st_size:  # the library would read for ever
                raise ValueError("names more rows than it can hold")
            rasters.append(_Raster(int(group.channel_group.cycles_nr), places, labels))
        return rasters

    def read(file: Any, raster: _Raster, names: Sequence[str], first: int, rows: int) -> Mapping[str, Any]:
        places = [raster.places[name] for name in names]
        with redirect_stdout(io.StringIO()):  # it prints what it knows of a broken channel
            signals = file.select(places, record_offset=first, record_count=rows, copy_master=False)
        return {name: signal.samples for name, signal in zip(names, signals, strict=True)}

    @contextmanager
    def opened() -> Iterator[Any]:
        # given a path, the library maps all of the file into memory, and reads whole channels for each chunk
        with path.open("rb") as raw:
            try:
                file = MDF(raw)
            except Exception as error:
                _close_partial(error)
                raise
            with closing(file):
                yield file

    return _open_measurement(path, "MDF", opened, list_rasters, read)


def open_tdms(path: Path) -> TableFile:
    """Open a TDMS file."""
    from nptdms import TdmsFile
    from nptdms.log import log_manager

    log_manager.set_level(logging.CRITICAL)  # broken files raise an error; no dump of their bytes on the terminal

    def list_rasters(file: Any) -> list[_Raster]:
        channels = [channel for group in file.groups() for channel in group.channels()]
        names = [channel.name for channel in channels]
        rasters: dict[tuple[Any, ...], dict[str, Any]] = {}
        labels: dict[str, str] = {}
        for channel in channels:
            step = float(channel.properties.get("wf_increment", 0.0))
            begin = float(channel.properties.get("wf_start_offset", 0.0))
            name = channel.name if names.count(channel.name) == 1 else f"{channel.group_name}/{channel.name}"
            labels[name] = with_unit(name, str(channel.properties.get("unit_string", "")).strip())
            rasters.setdefault((len(channel), step, begin), {})[labels[name]] = (channel.group_name, channel.name)
        for (_, step, begin), places in rasters.items():
            if step > 0.0:
                places.setdefault(DEFAULT_TIME_NAME, (step, begin))
        return [_Raster(rows, places, labels) for (rows, *_), places in rasters.items()]

    def read(file: Any, raster: _Raster, names: Sequence[str], first: int, rows: int) -> Mapping[str, Any]:
        values: dict[str, Any] = {}
        for name in names:
            place = raster.places[name]
            if isinstance(place[0], str):
                group, channel = place
                values[name] = file[group][channel].read_data(offset=first, length=rows)
            else:  # a clock that the file describes by its step and its beginning
                step, begin = place
                values[name] = begin + step * np.arange(first, first + rows)
        return values

    @contextmanager
    def opened() -> Iterator[Any]:
        # given a path, the library would take the description from a file beside it, where there is one
        with path.open("rb") as raw, TdmsFile.open(raw) as file:
            yield file

    return _open_measurement(path, "TDMS", opened, list_rasters, read)


@functools.cache
def _ignore_external_attachments() -> None:
    """Let asammdf read attachments within a file only: an external one could be any file of this machine."""
    from asammdf.blocks.mdf_v4 import MDF4, v4c

    extract = MDF4._extract_attachment

    def extract_embedded(self: Any, index: int | None = None, password: str | bytes | None = None) -> Any:
        embedded = index is not None and self.attachments[index].flags & v4c.FLAG_AT_EMBEDDED
        return extract(self, index if embedded else None, password)

    MDF4._extract_attachment = extract_embedded


def _close_partial(error: Exception) -> None:
    """Mark the objects that asammdf has half built as closed; else they print a complaint when they are collected."""
    trace = error.__traceback__
    while trace is not None:
        made: Any = trace.tb_frame.f_locals.get("self")
        if hasattr(made, "_closed"):
            made._closed = True
        trace = trace.tb_next


def _open_measurement(
    path: Path,
    kind: str,
    opened: Callable[[], AbstractContextManager[Any]],
    list_rasters: Callable[[Any], list[_Raster]],
    read: _ReadChannels,
) -> TableFile:
    damaged = path, f"is a damaged {kind} file", "export it again"

    def read_chunks(wanted: Sequence[str], _: Collection[str]) -> Iterator[Mapping[str, Any]]:
        raster = next(raster for raster in rasters if {*wanted} <= {*raster.places})
        check_size(path, raster.rows, len(wanted))
        with one_line_errors(*damaged), opened() as file:
            for first in range(0, raster.rows, CHUNK_ROWS):
                rows = min(CHUNK_ROWS, raster.rows - first)
                cells = {name: np.asarray(x) for name, x in read(file, raster, wanted, first, rows).items()}
                if len({x.shape[0] for x in cells.values()}) > 1:
                    raise ValueError("channels end before their raster does")
                yield {name: _arrow_values(x) for name, x in cells.items()}

    with one_line_errors(*damaged), opened() as file:
        rasters = [raster for raster in list_rasters(file) if raster.rows]
    names = dict.fromkeys(name for raster in rasters for name in raster.places)
    aliases = {
        name: label
        for raster in rasters
        for name, label in raster.labels.items()
        if label != name and label in raster.places
    }
    if not names:
        raise RecordingError(f"{path}: holds no channels with values")
    groups = tuple(tuple(raster.places) for raster in rasters)
    return TableFile(path, tuple(names), read_chunks, channel_groups=groups, aliases=aliases)


def _arrow_values(cells: Any) -> Any:
    """Return values as Arrow takes them: numbers as they are, all else as text."""
    if cells.dtype.kind in "fiub" and cells.ndim == 1:
        return cells.astype(cells.dtype.newbyteorder("="))
    return [str(x) for x in cells.tolist()] if cells.ndim == 1 else [""] * cells.shape[0]
