"""Which rows of a file are wanted, and where a new run starts: cells compared with values and with their neighbours."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.errors import RecordingError
from servoscope.signals.readers.columns import find_channel
from servoscope.signals.readers.table import Table, TableFile, number_column

MAX_SHOWN = 10  # values of a column that an error lists


class ColumnTypeChanged(Exception):
    """A column looks like numbers in one chunk of a file and like text in another."""

    def __init__(self, column: str) -> None:
        super().__init__(column)
        self.column = column


class CellReader:
    """A column's cells for comparison, chunk by chunk: numbers, or text without blanks around it."""

    def __init__(self, column: str) -> None:
        self.column = column
        self._kind = ""
        self._last: npt.NDArray[Any] | None = None

    def read(self, table: Table) -> npt.NDArray[Any]:
        """Return the cells of a chunk, shape (N,).

        Raises Mixed if it is text and an earlier piece was numbers, or the other way round.
        """
        import pyarrow as pa

        column = table.columns[self.column]
        kind, types = column.type, pa.types
        if types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind) or types.is_null(kind):
            # NaN differs from itself and would start a run at every row: an empty cell becomes a value.
            cells = np.nan_to_num(number_column(table, self.column, "segment"), nan=np.inf)
        else:
            cells = np.array([str(cell if cell is not None else "").strip() for cell in column.to_pylist()])
        if self._kind not in ("", cells.dtype.kind):
            raise ColumnTypeChanged(self.column)
        self._kind = cells.dtype.kind
        return cells

    def changes(self, table: Table) -> BoolArray:
        """Return where a cell differs from the one before it, in the chunk before for the first, shape (N,)."""
        cells = self.read(table)
        before = cells[:1] if self._last is None else self._last
        self._last = cells[-1:]
        return np.asarray(cells != np.concatenate([before, cells[:-1]]))


class RowFilter:
    """The rows that meet conditions such as ``{"load": "20", "run": "1-5"}``.

    Raises RecordingError if a column does not exist.
    """

    def __init__(self, opened: TableFile, where: Mapping[str, str]) -> None:
        self._name, self._any = opened.name, False
        self._conditions = [
            _RowCondition(
                CellReader(find_channel(column, opened.known, f"{opened.name}: where")), str(wanted), opened.name
            )
            for column, wanted in where.items()
        ]

    @property
    def columns(self) -> list[str]:
        """What has to be read for it."""
        return [condition.cells.column for condition in self._conditions]

    def mask(self, table: Table) -> BoolArray:
        """Return which rows of a chunk are wanted, shape (N,)."""
        mask = np.ones(table.rows, dtype=bool)
        for condition in self._conditions:
            mask &= condition.mask(table)
        self._any = self._any or bool(mask.any())
        return mask

    def check_matched(self) -> None:
        """Refuse conditions that no row of the whole file has met.

        Raises RecordingError then.
        """
        for condition in self._conditions:
            condition.check_matched()
        if not self._any:
            raise RecordingError(f"{self._name}: where: no row meets all conditions together, drop one of them")


class _RowCondition:
    def __init__(self, cells: CellReader, wanted: str, name: str) -> None:
        self.cells, self._wanted = cells, wanted
        self._label = f"{name}: where {cells.column}={wanted}"
        self._met = False
        self._seen: dict[object, None] = {}

    def mask(self, table: Table) -> BoolArray:
        cells = self.cells.read(table)
        mask = np.zeros(table.rows, dtype=bool)
        for item in self._wanted.split(","):
            mask |= _match_cells(cells, item.strip(), self._label)
        self._met = self._met or bool(mask.any())
        if not self._met and len(self._seen) <= MAX_SHOWN:
            self._seen.update(dict.fromkeys(cells.tolist()))
        return mask

    def check_matched(self) -> None:
        if not self._met:
            values = [format_cell(value) for value in self._seen]
            shown = ", ".join(values[:MAX_SHOWN]) + (", ..." if len(values) > MAX_SHOWN else "")
            raise RecordingError(f"{self._label}: no such rows, {self.cells.column} takes {shown}")


def format_cell(value: object) -> str:
    """Return a cell as a user would write it."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def _match_cells(cells: npt.NDArray[np.generic], item: str, context: str) -> BoolArray:
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


def chosen_values(
    opened: TableFile, names: Sequence[str], where: Mapping[str, str] | None = None
) -> dict[str, FloatArray]:
    """Return some columns of a file, in the rows that meet conditions; columns of several rasters differ in length."""
    pieces: dict[str, list[FloatArray]] = {name: [] for name in names}
    chosen = RowFilter(opened, where or {})
    for together in [[name] for name in names] if opened.channel_groups else [names] if names else []:
        for table in opened.iter_chunks({*together, *chosen.columns}):
            rows = chosen.mask(table)
            for name in together:
                pieces[name].append(number_column(table, name, "channel")[rows])
    return {name: np.concatenate(values) for name, values in pieces.items()}
