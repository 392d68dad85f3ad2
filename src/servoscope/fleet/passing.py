"""Sorted Arrow batches of many assets, as a worker of Spark gets them, to one result per asset and day."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from servoscope.errors import ServoscopeError
from servoscope.fleet.following import Follower, Memory
from servoscope.fleet.rows import Rows, rows_of
from servoscope.fleet.tasks import examined
from servoscope.loop import Columns
from servoscope.readers.tables import Table

__all__ = ["DAY_US", "day_name", "examined_days"]

DAY_US = 86_400_000_000


def day_name(day: int) -> str:
    """Return the name of a day, counted from 1970 in UTC: 2026-11-20."""
    return str(np.datetime64(day, "D"))


def examined_days(
    batches: Iterable[Any], keys: Sequence[str], by: str, columns: Columns, find: Callable[[str], Follower]
) -> Iterator[dict[str, Any]]:
    """Yield a result per asset and day.

    Parameters
    ----------
    batches
        Arrow batches, sorted by `keys` and time; a day may begin and end anywhere in them.
    keys
        Names of the columns of asset, baseline and, if there is one, day.
    by
        Which of them names the baseline.
    columns
        Where the signals stand.
    find
        Name of a baseline -> its follower.
    """
    passing: _Day | None = None
    for key, table in _runs(batches, keys):
        named = dict(zip(keys, key, strict=True))
        for day, rows in _days(named.get("day"), table, columns):
            if passing is not None and passing.key != (named["asset"], day):
                yield passing.finished()
                passing = None
            passing = passing or _Day((named["asset"], day), named[by], find)
            passing.take(rows)
    if passing is not None:
        yield passing.finished()


class _Day:
    """The day that is passing by; errors stay with it."""

    def __init__(self, key: tuple[str, str], baseline: str, find: Callable[[str], Follower]) -> None:
        self.key, self._error, self._waiting, self._history = key, "", Rows.none(), Memory()
        try:
            self._follower = find(baseline)
            self._state = self._follower.start()
        except ServoscopeError as error:
            self._error = f"no baseline: {error}"

    def take(self, rows: Rows | Exception) -> None:
        """Take in what comes next; rows of the last time wait for others of the same time."""
        if isinstance(rows, Exception):
            self._error = self._error or _told(rows)
        if self._error or isinstance(rows, Exception) or not len(rows):
            return
        self._waiting = Rows.joined([each for each in (self._waiting, rows) if len(each)])
        done = self._waiting.t_us < self._waiting.t_us.max()
        ready, self._waiting = self._waiting[done], self._waiting[~done]
        self._advance(ready)

    def finished(self) -> dict[str, Any]:
        """Return what was found."""
        if not self._error:
            self._advance(self._waiting)
        found: dict[str, Any] = {}
        if not self._error:
            try:
                found = examined(self._follower, self._follower.finish(self._state, self._history))
            except Exception as error:  # garbage in one day must not cost another
                self._error = _told(error)
        if self._error:
            found = {"status": "failed", "error": self._error}
        return {"asset": self.key[0], "day": self.key[1], **found}

    def _advance(self, rows: Rows) -> None:
        if not len(rows):
            return
        try:
            block = rows.sorted()
            self._history.add(block)
            self._state, _ = self._follower.advance(self._state, block, self._history)
            self._history.forget(self._follower.needed(self._state))
        except Exception as error:  # garbage in one day must not cost another
            self._error = _told(error)


def _runs(batches: Iterable[Any], keys: Sequence[str]) -> Iterator[tuple[tuple[str, ...], Any]]:
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


def _days(day: str | None, batch: Any, columns: Columns) -> Iterator[tuple[str, Rows | Exception]]:
    """Yield the rows of each day; what cannot be read is the first day's."""
    import pyarrow as pa

    names = batch.schema.names
    try:
        rows = rows_of(Table("rows", {name: pa.chunked_array([batch.column(name)]) for name in names}), columns)
    except ServoscopeError as error:
        yield day or "", error
        return
    if day is not None:
        yield day, rows
        return
    numbers = rows.t_us // DAY_US
    for number in np.unique(numbers):
        yield day_name(int(number)), rows[numbers == number]


def _told(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if isinstance(error, ServoscopeError) else f"{type(error).__name__}: {text[:200]}"
