"""Arrow batches of many assets, as workers of Spark get them: sorted ones to results, those of streams to blocks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain, groupby, pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from servoscope.core.errors import ServoscopeError
from servoscope.fleet.day_monitor import DayMonitor
from servoscope.fleet.rows import Rows, covariates_from_table, rows_from_table, signals_from_table
from servoscope.fleet.tasks import examine_day, failed_result
from servoscope.models.loop import Columns
from servoscope.signals.readers.table import Table

if TYPE_CHECKING:
    import pyarrow as pa

BLOCKS = "asset string, baseline_of string, last_us long, rows binary"  # rows of an asset, packed; until when they are
CHUNK = 65_536  # rows of one entry of a stream's state, about
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
            result, _ = examine_day(monitor, _complete_times(piece[3] for piece in chain([first], pieces)))
        except Exception as error:  # garbage in one day must not cost another
            result = failed_result(error)
        yield {"asset": asset, "day": day, **result}


Piece = tuple[str, str, str, Rows | Exception]  # asset, day, baseline, rows or why they cannot be read


def _complete_times(parts: Iterable[Rows | Exception]) -> Iterator[Rows]:
    """Yield rows in the order of time; rows of the last time wait for others of the same time.

    Raises the error that stands in the place of rows.
    """
    waiting = Rows.empty()
    for rows in parts:
        if isinstance(rows, Exception):
            raise rows
        if not len(rows):
            continue
        waiting = Rows.concatenate([each for each in (waiting, rows) if len(each)])
        complete = waiting.t_us < waiting.t_us.max()
        if complete.any():
            yield waiting[complete].sort_by_time()
            waiting = waiting[~complete]
    if len(waiting):
        yield waiting.sort_by_time()


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


def pack_blocks(batches: Iterator[pa.RecordBatch], columns: Columns) -> Iterator[pa.RecordBatch]:
    """Yield the rows of Arrow batches as blocks of `BLOCKS`: one per batch, asset and baseline."""
    import pyarrow as pa

    keys = ("asset", "baseline_of")
    for batch in batches:
        if not batch.num_rows:
            continue
        signals = {name: pa.chunked_array([batch[name]]) for name in batch.schema.names if name not in (*keys, "at_us")}
        table = Table("the stream", signals)
        channels = covariates_from_table(table, columns)
        rows = Rows(np.asarray(batch["at_us"]), *signals_from_table(table, columns), channels)
        assets, baselines = (batch[key].dictionary_encode(null_encoding="encode") for key in keys)
        code = np.asarray(assets.indices, np.int64) * len(baselines.dictionary) + np.asarray(baselines.indices)
        order = np.argsort(code, kind="stable")
        first = np.flatnonzero(np.diff(code[order], prepend=-1))
        own = [rows[each] for each in np.split(order, first[1:])]
        block = {key: batch[key].take(order[first]) for key in keys}
        block["last_us"] = pa.array([int(each.t_us.max()) for each in own])
        block["rows"] = pa.array([each.pack() for each in own], pa.binary())
        yield pa.RecordBatch.from_pydict(block)


def join_blocks(frames: Iterator[Any]) -> Iterator[tuple[str, Rows]]:
    """Yield blocks in larger pieces, each with its baseline: blocks may be tiny, a piece is one entry of the state."""
    parts: list[Rows] = []
    for frame in frames:
        for baseline, packed in zip(frame["baseline_of"], frame["rows"], strict=True):
            parts.append(Rows.unpack(bytes(packed)))
            if sum(map(len, parts)) >= CHUNK:
                yield str(baseline), Rows.concatenate(parts)
                parts = []
    if parts:
        yield str(baseline), Rows.concatenate(parts)
