"""Reads the rows of an item's files in the order of time, block by block, with little of them in memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from servoscope.core.errors import RecordingError
from servoscope.fleet.lake import filesystem
from servoscope.fleet.rows import Rows, required_columns, rows_from_table, time_from_table
from servoscope.models.loop import Columns
from servoscope.signals.readers.columns import find_channel
from servoscope.signals.readers.formats import open_file
from servoscope.signals.readers.table import Table

MAX_UNSORTED_ROWS = 20_000_000  # rows in no order that are held at once, 640 MB
FIRST_TIME, LAST_TIME = -(2**62), 2**62


def read_blocks(files: Sequence[str], columns: Columns) -> Iterator[Rows]:
    """Yield the rows of all files together in the order of time.

    Row groups of Parquet files are read in the order of the smallest times that the files give for them, so that sorted
    files of any length take the memory of a few row groups. Files without such times are read whole, first.

    Raises RecordingError, LoopError if a file cannot be used; it names the file.
    """
    parts = sorted(
        (part for file in files for part in _list_row_groups(file, columns)),
        key=lambda part: (part.first_us, part.file, part.group),
    )
    later = [*(part.first_us for part in parts[1:]), LAST_TIME]
    yield from merge_rows((part.file, part.read(columns), until) for part, until in zip(parts, later, strict=True))


def merge_rows(parts: Iterable[tuple[str, Rows, int]]) -> Iterator[Rows]:
    """Yield rows in the order of time; of each part: where it is from, its rows, and what none comes before then [us].

    Raises RecordingError if there are too many in no order.
    """
    waiting = Rows.empty()
    for where, rows, until in parts:
        waiting = Rows.concatenate([waiting, rows])
        if len(waiting) > MAX_UNSORTED_ROWS:
            raise RecordingError(f"{where}: more than {MAX_UNSORTED_ROWS} rows in no order of time: write them sorted")
        done = waiting.t_us < until
        if done.any():
            yield (waiting if done.all() else waiting[done]).sort_by_time()
            waiting = waiting[~done]
    if len(waiting):
        yield waiting.sort_by_time()


class _RowGroup(NamedTuple):
    """A row group, or a whole file."""

    file: str
    source: Any  # a Parquet file or a `Table`
    group: int
    first_us: int  # a time that no row of it comes before [us]
    names: list[str]  # columns that are read

    def read(self, columns: Columns) -> Rows:
        """Return its rows."""
        import pyarrow as pa

        name = self.file.rpartition("/")[2]
        if isinstance(self.source, Table):
            return rows_from_table(self.source, columns)
        try:
            table = self.source.read_row_group(self.group, columns=self.names, use_threads=False)
        except (pa.ArrowException, OSError) as error:
            raise _damaged_file_error(self.file, error) from None
        return rows_from_table(Table(name, {name: table.column(name) for name in self.names}), columns)


def _list_row_groups(file: str, columns: Columns) -> Iterator[_RowGroup]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not file.endswith((".parquet", ".pq")):
        opened = open_file(file)
        for i, table in enumerate(opened.iter_chunks(required_columns(columns, opened.columns, file))):
            yield _RowGroup(file, table, i, FIRST_TIME, [])
        return
    system, path = filesystem(file)
    try:
        source = pq.ParquetFile(path, filesystem=system)
        schema = source.schema_arrow
    except FileNotFoundError:
        raise RecordingError(f"{file}: no such file") from None
    except (pa.ArrowException, OSError) as error:
        raise _damaged_file_error(file, error) from None
    flat = [source.metadata.schema.column(i).path for i in range(len(source.metadata.schema))]
    names = required_columns(columns, flat, file)
    at = flat.index(find_channel(columns.time or "", flat, file))
    for group in range(source.num_row_groups):
        statistics = source.metadata.row_group(group).column(at).statistics
        first_us = FIRST_TIME
        if statistics is not None and statistics.has_min_max:
            first = pa.chunked_array([pa.array([statistics.min], schema.field(names[0]).type)])
            t_us, known = time_from_table(Table(file, {names[0]: first}), columns)
            first_us = int(t_us[0]) if known[0] else FIRST_TIME
        yield _RowGroup(file, source, group, first_us, names)


def _damaged_file_error(file: str, error: Exception) -> RecordingError:
    return RecordingError(f"{file}: is a damaged Parquet file ({' '.join(str(error).split())[:80]}), write it again")
