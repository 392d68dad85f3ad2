"""Reads Parquet files, some rows at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from os import SEEK_END
from pathlib import Path
from typing import Any

from servoscope.core.errors import RecordingError
from servoscope.signals.readers.table import CHUNK_ROWS, Table, TableFile, check_size, check_width, one_line_errors

SAMPLE_ROWS = 100  # that say how many values the cells of a column hold
BUFFER_BYTES = 1 << 20  # of each column
MAX_FOOTER_BYTES = 32_000_000
FOOTER_END_BYTES = 8  # at the end of the file: the length of the footer, and PAR1


def open_parquet(path: Path) -> TableFile:
    """Open a Parquet file."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    damaged = path, "is a damaged Parquet file", "write it again", (pa.ArrowException, OSError)

    def read(wanted: Sequence[str], _: Collection[str]) -> Iterator[Table]:
        first = 1
        # neither read_table nor a memory map: the one imports pandas, the other takes the file for memory
        with one_line_errors(*damaged), pq.ParquetFile(path, buffer_size=BUFFER_BYTES, pre_buffer=False) as file:
            about = file.metadata  # whose own number of rows may be another one
            rows = sum(about.row_group(k).num_rows for k in range(about.num_row_groups))
            check_size(path, rows, len(wanted))
            for batch in file.iter_batches(CHUNK_ROWS, columns=[*dict.fromkeys(places[name] for name in wanted)]):
                nested = _flatten(batch) if any(places[name] != name for name in wanted) else {}
                columns = {n: nested[n] if n in nested else pa.chunked_array([batch.column(n)]) for n in wanted}
                share = (first - 1 + batch.num_rows) / rows if rows > 0 else 1.0
                yield Table(path.name, columns, first, share=share)
                first += batch.num_rows

    _check_footer(path)
    with one_line_errors(*damaged), pq.ParquetFile(path) as file:
        check_width(path, file.metadata.num_columns)  # before anything is made of the columns
        schema = file.schema_arrow
        places: dict[str, str] = {}  # name of a column -> that of the file, which may hold several in its cells
        for name, count in Counter(schema.names).items():
            if count > 1:
                continue
            inside = [name]
            if pa.types.is_nested(schema.field(name).type):
                inside = [*_flatten(next(file.iter_batches(SAMPLE_ROWS, columns=[name]), None))]
            places |= dict.fromkeys(inside, name)
        check_width(path, len(places))
    return TableFile(path, tuple(places), read)


def _flatten(batch: Any) -> dict[str, Any]:
    """Return the columns in the cells of a piece of a file."""
    import pyarrow as pa

    from servoscope.signals.readers.matrices import flatten_table

    return flatten_table(pa.Table.from_batches([batch])) if batch is not None else {}


def _check_footer(path: Path) -> None:
    """Refuse a file whose description alone would fill the memory: it is unpacked to many times its size."""
    with path.open("rb") as file:
        size = file.seek(0, SEEK_END)
        file.seek(max(0, size - FOOTER_END_BYTES))
        footer, magic = int.from_bytes(file.read(4), "little"), file.read(4)
    if magic == b"PAR1" and footer > MAX_FOOTER_BYTES:  # without it the file is damaged, which its reader says
        raise RecordingError(
            f"{path}: describes its columns and row groups in {footer / 1e6:.0f} MB, more than "
            f"{MAX_FOOTER_BYTES / 1e6:g} MB: write fewer of them"
        )
