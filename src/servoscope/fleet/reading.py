"""The rows of an item's files in the order of time, block by block, with no more in memory than has to be."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from servoscope.errors import RecordingError
from servoscope.fleet.lake import filesystem
from servoscope.fleet.rows import Rows, clock_of, names_of, rows_of
from servoscope.loop import Columns
from servoscope.readers.columns import find_channel
from servoscope.readers.opening import open_file
from servoscope.readers.tables import Table

__all__ = ["blocks"]

MOST_WAITING = 20_000_000  # rows in no order that are held at once, 640 MB
NOW, EVER = -(2**62), 2**62


def blocks(files: Sequence[str], columns: Columns) -> Iterator[Rows]:
    """Yield the rows of all files together in the order of time.

    Row groups of Parquet files are read as their turn comes, by the smallest time that the file says they have, so that
    sorted files of any length take the memory of a few row groups. Files that do not say it are read whole, first.

    Raises
    ------
    RecordingError, LoopError
        If a file cannot be used; it names the file.
    """
    parts = sorted(
        (part for file in files for part in _parts(file, columns)), key=lambda part: (part.begin, part.file, part.group)
    )
    waiting = Rows.none()
    for part, later in zip(parts, [*(p.begin for p in parts[1:]), EVER], strict=True):
        waiting = Rows.joined([each for each in (waiting, part.read(columns)) if len(each)])
        if len(waiting) > MOST_WAITING:
            raise RecordingError(f"{part.file}: more than {MOST_WAITING} rows in no order of time: write them sorted")
        done = waiting.t_us < later
        if done.all():
            ready, waiting = waiting, Rows.none()
        else:
            ready, waiting = waiting[done], waiting[~done]
        if len(ready):
            yield ready.sorted()


class _Part:
    """A row group, or a whole file; `begin` is a time [us] that no row of it comes before."""

    def __init__(self, file: str, source: Any, group: int, begin: int, names: list[str]) -> None:
        self.file, self.source, self.group, self.begin, self.names = file, source, group, begin, names

    def read(self, columns: Columns) -> Rows:
        """Return its rows."""
        import pyarrow as pa

        name = self.file.rpartition("/")[2]
        if isinstance(self.source, Table):
            return rows_of(self.source, columns)
        try:
            table = self.source.read_row_group(self.group, columns=self.names, use_threads=False)
        except (pa.ArrowException, OSError) as error:
            raise _damaged(self.file, error) from None
        return rows_of(Table(name, {each: table.column(each) for each in self.names}), columns)


def _parts(file: str, columns: Columns) -> Iterator[_Part]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not file.endswith((".parquet", ".pq")):
        opened = open_file(file)
        for i, table in enumerate(opened.pieces(names_of(columns, opened.columns, file))):
            yield _Part(file, table, i, NOW, [])
        return
    system, path = filesystem(file)
    try:
        source = pq.ParquetFile(path, filesystem=system)
        schema = source.schema_arrow
    except FileNotFoundError:
        raise RecordingError(f"{file}: no such file") from None
    except (pa.ArrowException, OSError) as error:
        raise _damaged(file, error) from None
    flat = [source.metadata.schema.column(i).path for i in range(len(source.metadata.schema))]
    names = names_of(columns, flat, file)
    at = flat.index(find_channel(columns.time or "", flat, file))
    for group in range(source.num_row_groups):
        told = source.metadata.row_group(group).column(at).statistics
        begin = NOW
        if told is not None and told.has_min_max:
            first = Table(file, {names[0]: pa.chunked_array([pa.array([told.min], schema.field(names[0]).type)])})
            t_us, known = clock_of(first, columns)
            begin = int(t_us[0]) if known[0] else NOW
        yield _Part(file, source, group, begin, names)


def _damaged(file: str, error: Exception) -> RecordingError:
    return RecordingError(f"{file}: is a damaged Parquet file ({' '.join(str(error).split())[:80]}), write it again")
