"""Reads Parquet files, some rows at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from os import SEEK_END
from pathlib import Path

from servoscope.core.errors import RecordingError
from servoscope.signals.readers.table import CHUNK_ROWS, Table, TableFile, check_width, one_line_errors

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
            for batch in file.iter_batches(CHUNK_ROWS, columns=list(wanted)):
                columns = {name: pa.chunked_array([batch.column(name)]) for name in wanted}
                share = (first - 1 + batch.num_rows) / file.metadata.num_rows
                yield Table(path.name, columns, first, share=share)
                first += batch.num_rows

    _check_footer(path)
    with one_line_errors(*damaged), pq.ParquetFile(path) as file:
        check_width(path, file.metadata.num_columns)  # before anything is made of the columns
        names = file.schema_arrow.names
    count = Counter(names)
    return TableFile(path, tuple(name for name in names if count[name] == 1), read)


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
