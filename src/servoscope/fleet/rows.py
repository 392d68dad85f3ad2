"""Rows of r, u, y on a clock of whole microseconds: from any table, in one order, on whatever machine they are read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.errors import RecordingError
from servoscope.loop import Columns
from servoscope.plants import FloatArray
from servoscope.readers.columns import find_channel, parse_combination
from servoscope.readers.tables import UNITS, Table, number_column

__all__ = ["Rows", "clock_of", "names_of", "rows_of", "signals_of"]

MICRO = 1e6


@dataclass(frozen=True, eq=False)
class Rows:
    """Samples as logged.

    Parameters
    ----------
    t_us
        Time [us], whole numbers since the clock's own origin, shape (N,).
    r, u, y
        Reference, control input, measured output, shape (N,); NaN where a cell was empty.
    """

    t_us: npt.NDArray[np.int64]
    r: FloatArray
    u: FloatArray
    y: FloatArray

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.t_us)

    def __getitem__(self, which: slice | npt.NDArray[Any]) -> Rows:
        """Return some of the rows."""
        return Rows(self.t_us[which], self.r[which], self.u[which], self.y[which])

    def between(self, after_us: int, to_us: int) -> Rows:
        """Return the rows with after_us < t <= to_us."""
        return self[(self.t_us > after_us) & (self.t_us <= to_us)]

    def sorted(self) -> Rows:
        """Return them in the order of time; rows of one time in an order that depends on nothing but themselves."""
        if len(self) < 2 or bool((np.diff(self.t_us) > 0).all()):
            return self
        return self[np.lexsort((self.y, self.u, self.r, self.t_us))]

    @classmethod
    def none(cls) -> Rows:
        """Return no rows."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0), np.zeros(0))

    @classmethod
    def joined(cls, parts: Sequence[Rows]) -> Rows:
        """Return several blocks as one."""
        if len(parts) == 1:
            return parts[0]
        if not parts:
            return cls.none()
        t_us, r, u, y = (np.concatenate([getattr(part, name) for part in parts]) for name in ("t_us", "r", "u", "y"))
        return cls(t_us, r, u, y)

    def pack(self) -> bytes:
        """Return them as bytes, 32 a row."""
        return b"".join(np.ascontiguousarray(x).tobytes() for x in (self.t_us, self.r, self.u, self.y))

    @classmethod
    def unpack(cls, content: bytes) -> Rows:
        """Return what `pack` packed."""
        n = len(content) // 32
        floats = np.frombuffer(content, dtype=np.float64, offset=8 * n)
        return cls(np.frombuffer(content, dtype=np.int64, count=n), floats[:n], floats[n : 2 * n], floats[2 * n :])


def names_of(columns: Columns, known: Sequence[str], where: str) -> list[str]:
    """Return the columns that a mapping takes out of those that there are.

    Raises
    ------
    RecordingError, LoopError
        If one does not exist, or the mapping has no time: rows that are spread over files have no order without.
    """
    if columns.time is None:
        raise RecordingError(f"{where}: rows of a fleet need a time column: say which it is, --columns 't=...'")
    named = [find_channel(columns.time, known, f"{where}: [columns] time")]
    for key in ("reference", "input", "output"):
        named += parse_combination(getattr(columns, key), known, f"{where}: [columns] {key}").factors
    return list(dict.fromkeys(named))


def rows_of(table: Table, columns: Columns) -> Rows:
    """Return the rows of a table; those without a time are left out.

    Raises
    ------
    RecordingError, LoopError
        If the columns cannot be used.
    """
    t_us, known = clock_of(table, columns)
    rows = Rows(t_us, *signals_of(table, columns))
    return rows if known.all() else rows[known]


def signals_of(table: Table, columns: Columns) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return r, u and y of a table, shape (N,) each.

    Raises
    ------
    RecordingError, LoopError
        If the columns cannot be used.
    """
    known, signals = list(table.columns), []
    for key in ("reference", "input", "output"):
        mix = parse_combination(getattr(columns, key), known, f"{table.name}: [columns] {key}")
        total = np.full(table.rows, mix.constant)
        for name, factor in mix.factors.items():
            total += factor * number_column(table, name, f"[columns] {key}")
        signals.append(total)
    r, u, y = signals
    return r, u, y


def clock_of(table: Table, columns: Columns) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Return the time of each row [us] and whether there is one; times are rounded to microseconds.

    Raises
    ------
    RecordingError
        If the column holds neither numbers nor times.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    where = f"{table.name}: [columns] time"
    column = table.columns[find_channel(columns.time or "", list(table.columns), where)]
    if not pa.types.is_timestamp(column.type):
        seconds = number_column(table, columns.time or "", "time") * UNITS[columns.time_unit]
        there = np.isfinite(seconds) & (np.abs(seconds) < 9e12)
        return np.round(np.where(there, seconds, 0.0) * MICRO).astype(np.int64), there
    missing = np.asarray(column.is_null().to_numpy(zero_copy_only=False), dtype=bool)
    whole = pc.cast(column, pa.timestamp("us", column.type.tz), safe=False).cast(pa.int64()).fill_null(0)
    return np.concatenate([np.zeros(0, np.int64), *(np.asarray(chunk) for chunk in whole.chunks)]), ~missing
