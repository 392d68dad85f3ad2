"""Rows of a lake on a clock of whole microseconds: the same from any table, in one order, on whatever machine."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.core.errors import LoopError, RecordingError
from servoscope.models.loop import Columns, Loop
from servoscope.signals import Recording, clean
from servoscope.signals.readers.columns import LinearCombination, find_channel, parse_combination, parse_output
from servoscope.signals.readers.table import TIME_UNITS, Table, number_column

MICRO = 1e6


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows as logged, in any order; time is in whole numbers, so that it can be compared and saved without rounding."""

    t_us: IntArray  # [us] since the clock's own origin, shape (N,)
    r: FloatArray  # r, u, y: reference, control input, measured output, shape (N,); NaN where a cell was empty
    u: FloatArray
    y: FloatArray
    channels: Mapping[str, FloatArray] = field(default_factory=dict)  # covariates by name, shape (N,); NaN likewise

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.t_us)

    def __getitem__(self, which: slice | npt.NDArray[Any]) -> Rows:
        """Return some of the rows."""
        channels = {name: channel[which] for name, channel in self.channels.items()}
        return Rows(self.t_us[which], self.r[which], self.u[which], self.y[which], channels)

    def between(self, after_us: int, to_us: int) -> Rows:
        """Return the rows with after_us < t <= to_us."""
        return self[(self.t_us > after_us) & (self.t_us <= to_us)]

    def sort_by_time(self) -> Rows:
        """Return them in the order of time; rows of one time in an order that depends on nothing but themselves."""
        if len(self) < 2 or bool((np.diff(self.t_us) > 0).all()):
            return self
        return self[np.lexsort((*self.channels.values(), self.y, self.u, self.r, self.t_us))]

    def to_recording(self, origin_us: int, loop: Loop, name: str) -> Recording:
        """Return rows in the order of time as a recording whose time is 0 at `origin_us`.

        Raises RecordingError if they cannot be used as one.
        """
        t, limits, rate = (self.t_us - origin_us) / MICRO, loop.input_limits, loop.sample_rate
        channels = self.channels or None
        return clean(t, self.r, self.u, self.y, name=name, sample_rate=rate, limits=limits, channels=channels)

    @classmethod
    def empty(cls) -> Rows:
        """Return no rows."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0), np.zeros(0))

    @classmethod
    def concatenate(cls, parts: Sequence[Rows]) -> Rows:
        """Return several blocks as one."""
        parts = [part for part in parts if len(part)] or parts[:1]
        if len(parts) == 1:
            return parts[0]
        if not parts:
            return cls.empty()
        t_us, r, u, y = (np.concatenate([getattr(part, name) for part in parts]) for name in ("t_us", "r", "u", "y"))
        names = dict.fromkeys(name for part in parts for name in part.channels)
        # a file that lacks the column of a covariate has no value of it
        channels = {
            name: np.concatenate([part.channels.get(name, np.full(len(part), np.nan)) for part in parts])
            for name in names
        }
        return cls(t_us, r, u, y, channels)

    def pack(self, head: bytes = b"") -> bytes:
        """Return them as bytes behind others: 24 per row where times keep step, 8 more for each channel, and its name.

        Two numbers come first: how many rows there are, and of how many runs of equal steps their times are made, 0
        where the times themselves take less. Where there are channels, the last byte says how long their names are.
        """
        steps = np.diff(self.t_us, prepend=0)
        begins = np.flatnonzero(np.diff(steps, prepend=~steps[:1]))
        runs = len(begins) if 2 * len(begins) < len(self) else 0
        times = (steps[begins], np.diff(begins, append=len(self))) if runs else (self.t_us,)
        columns = (np.array([len(self), runs]), *times, self.r, self.u, self.y, *self.channels.values())
        names = json.dumps(list(self.channels)).encode() if self.channels else b""
        names += b" " * (-len(names) % 8)
        tail = names + bytes([len(names) // 8]) if names else b""
        return b"".join((head, *(np.ascontiguousarray(x).data for x in columns), tail))

    @classmethod
    def unpack(cls, content: bytes, begin: int = 0) -> Rows:
        """Return what `pack` packed, from byte `begin` of the content on, a multiple of 8."""
        names, end = [], len(content)
        if end % 8:
            end -= 1 + 8 * content[-1]
            names = json.loads(content[end:-1])
        n, runs = np.frombuffer(content, dtype=np.int64, offset=begin, count=2).tolist()
        times = np.frombuffer(content, dtype=np.int64, offset=begin + 16, count=2 * runs or n)
        t_us = np.cumsum(np.repeat(times[:runs], times[runs:])) if runs else times
        signals = np.frombuffer(content, dtype=np.float64, offset=begin + 16 + times.nbytes, count=(3 + len(names)) * n)
        r, u, y, *channels = signals.reshape(3 + len(names), n)
        return cls(t_us, r, u, y, dict(zip(names, channels, strict=True)))


def required_columns(columns: Columns, known: Sequence[str], where: str) -> list[str]:
    """Return those of the columns `known` that a mapping uses, time first.

    Raises RecordingError, LoopError if one does not exist, or the mapping has no time: rows that are spread over
    files have no order without.
    """
    if columns.time is None or columns.row_rate is not None:
        raise RecordingError(f"{where}: rows of a fleet need a time column: say which it is, --columns 't=...'")
    named = [find_channel(columns.time, known, f"{where}: [columns] time")]
    for key in ("reference", "input"):
        named += parse_combination(getattr(columns, key), known, f"{where}: [columns] {key}").factors
    for sensor in parse_output(columns, known, f"{where}: [columns] output"):
        named += sensor.factors
    for text in columns.covariates.values():
        with suppress(LoopError, RecordingError):  # who needs one that is not there will say so
            named += parse_combination(text, known, where).factors
    return list(dict.fromkeys(named))


def rows_from_table(table: Table, columns: Columns) -> Rows:
    """Return the rows of a table that have a time.

    Raises RecordingError, LoopError if the columns cannot be used.
    """
    t_us, known = time_from_table(table, columns)
    rows = Rows(t_us, *signals_from_table(table, columns), covariates_from_table(table, columns))
    return rows if known.all() else rows[known]


def signals_from_table(table: Table, columns: Columns) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return r, u and y of a table, shape (N,) each.

    Raises RecordingError, LoopError if the columns cannot be used.
    """
    known, where = list(table.columns), f"{table.name}: [columns]"
    r, u = (
        _mix(table, parse_combination(getattr(columns, key), known, f"{where} {key}"), key)
        for key in ("reference", "input")
    )
    sensors = [_mix(table, combination, "output") for combination in parse_output(columns, known, f"{where} output")]
    return r, u, sensors[0] if len(sensors) == 1 else np.asarray(np.mean(sensors, axis=0))


def covariates_from_table(table: Table, columns: Columns) -> dict[str, FloatArray]:
    """Return those covariates of a table that it has, by name, shape (N,) each."""
    covariates, known = {}, list(table.columns)
    for name, text in columns.covariates.items():
        try:
            combination = parse_combination(text, known, table.name)
        except (LoopError, RecordingError):
            continue
        covariates[name] = _mix(table, combination, f"covariates.{name}")
    return covariates


def _mix(table: Table, mix: LinearCombination, key: str) -> FloatArray:
    total = np.full(table.rows, mix.constant)
    for name, factor in mix.factors.items():
        total += factor * number_column(table, name, f"[columns] {key}")
    return total


def time_from_table(table: Table, columns: Columns) -> tuple[IntArray, BoolArray]:
    """Return the time of each row, rounded to whole microseconds, and whether it has one.

    Raises RecordingError if the column holds neither numbers nor times.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    column = table.columns[find_channel(columns.time or "", list(table.columns), f"{table.name}: [columns] time")]
    if not pa.types.is_timestamp(column.type):
        seconds = number_column(table, columns.time or "", "time") * TIME_UNITS[columns.time_unit]
        known = np.isfinite(seconds) & (np.abs(seconds) < 9e12)
        return np.round(np.where(known, seconds, 0.0) * MICRO).astype(np.int64), known
    missing = np.asarray(column.is_null().to_numpy(zero_copy_only=False), dtype=bool)
    whole = pc.cast(column, pa.timestamp("us", column.type.tz), safe=False).cast(pa.int64()).fill_null(0)
    return np.concatenate([np.zeros(0, np.int64), *(np.asarray(chunk) for chunk in whole.chunks)]), ~missing
