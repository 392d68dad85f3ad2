"""Sorted Arrow batches of many assets, as workers of Spark get them, to results."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain, groupby, pairwise
from typing import Any

import numpy as np

from servoscope.core.errors import ServoscopeError
from servoscope.fleet.day_monitor import DayMonitor
from servoscope.fleet.read import merge_rows
from servoscope.fleet.rows import Rows, rows_from_table
from servoscope.fleet.tasks import examine_day, failed_result
from servoscope.models.loop import Columns
from servoscope.signals.readers.table import Table

DAY_US = 86_400_000_000


def day_name(day: int) -> str:
    """Return the name of a day, counted from 1970 in UTC: 2026-11-20."""
    return str(np.datetime64(day, "D"))


def examine_days(
    batches: Iterable[Any], keys: Sequence[str], by: str, columns: Columns, find: Callable[[str], DayMonitor]
) -> Iterator[dict[str, Any]]:
    """Yield a result per asset and day.

    `batches`: Arrow batches, sorted by `keys` and time; a day may begin and end anywhere in them; `keys`: names of
    the columns of asset, baseline and, if there is one, day; `by`: which of them names the baseline; `find`: returns
    the monitor of a baseline.
    """
    for (asset, day), pieces in groupby(_split_by_day(batches, keys, by, columns), key=lambda piece: piece[:2]):
        first = next(pieces)
        try:
            monitor = find(first[2])
        except ServoscopeError as error:
            yield {"asset": asset, "day": day, "status": "failed", "error": f"no baseline: {error}"}
            continue
        try:
            result, _ = examine_day(monitor, merge_rows(_sorted_parts(piece[3] for piece in chain([first], pieces))))
        except Exception as error:  # garbage in one day must not cost another
            result = failed_result(error)
        yield {"asset": asset, "day": day, **result}


Piece = tuple[str, str, str, Rows | Exception]  # asset, day, baseline, rows or why they cannot be read


def _sorted_parts(parts: Iterable[Rows | Exception]) -> Iterator[tuple[str, Rows, int]]:
    """Yield sorted rows as `merge_rows` takes them; those of the last time wait for others of the same time.

    Raises the error that stands in the place of rows.
    """
    for rows in parts:
        if isinstance(rows, Exception):
            raise rows
        if len(rows):
            yield "rows", rows, int(rows.t_us.max())


def _split_by_day(batches: Iterable[Any], keys: Sequence[str], by: str, columns: Columns) -> Iterator[Piece]:
    """Yield the rows of each asset and day; an error in reading them belongs to the first day."""
    import pyarrow as pa

    for key, batch in _split_by_key(batches, keys):
        named = dict(zip(keys, key, strict=True))
        asset, day, baseline = named["asset"], named.get("day"), named[by]
        table = Table("rows", {name: pa.chunked_array([batch.column(name)]) for name in batch.schema.names})
        try:
            rows = rows_from_table(table, columns)
        except ServoscopeError as error:
            yield asset, day or "", baseline, error
            continue
        if day is not None:
            yield asset, day, baseline, rows
            continue
        numbers = rows.t_us // DAY_US
        for number in np.unique(numbers):
            yield asset, day_name(int(number)), baseline, rows[numbers == number]


def _split_by_key(batches: Iterable[Any], keys: Sequence[str]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield stretches of rows with the same keys."""
    import pyarrow.compute as pc

    for batch in batches:
        n = batch.num_rows
        if not n:
            continue
        columns = [batch.column(batch.schema.get_field_index(key)) for key in keys]
        changes = np.zeros(n - 1, dtype=bool)
        for column in columns:
            changes |= np.asarray(pc.not_equal(column.slice(1), column.slice(0, n - 1)).fill_null(True))
        edges = [0, *(np.flatnonzero(changes) + 1).tolist(), n]
        for start, stop in pairwise(edges):
            yield tuple(str(column[start].as_py()) for column in columns), batch.slice(start, stop - start)
