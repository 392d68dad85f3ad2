"""Copies a store as a whole, from and to either database: a backup is a SQLite store of its own."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import sqlalchemy as sa
from sqlalchemy.engine import URL

from servoscope.core.errors import StoreError
from servoscope.service.store import engine
from servoscope.service.store.store import Store
from servoscope.service.store.tables import METADATA, bundles

ROWS_PER_PART = 1000
BUNDLES_PER_PART = 8  # of a large service such a row has megabytes


def copy_store(source: Store, target: str, folder: Path | None = None) -> dict[str, int]:
    """Copy all that a store holds at one moment, while services write to it; return the rows of each table.

    `target`: a file that does not exist yet, relative to `folder`, or the URL of a database without a history. It gets
    the tables of the version that the source has: `servoscope run` migrates them. Raises StoreError if the target is
    not empty, or something fails; nothing half copied stays behind.
    """
    url = engine.parse_store_url(target, folder or Path())
    with _target_connection(url) as writing, source.snapshot() as reading:
        present = set(sa.inspect(reading).get_table_names())
        copied = [table for table in METADATA.sorted_tables if table.name in present]
        if strange := set(sa.inspect(writing).get_table_names()) & {table.name for table in copied}:
            where = engine.display_url(url)
            raise StoreError(f"{where}: has a table {min(strange)} already, give an empty database")
        METADATA.create_all(writing, tables=copied)
        counts = {}
        for table in copied:
            try:
                counts[table.name] = _copy_rows(reading, writing, table)
            except (ValueError, TypeError, RecursionError) as error:  # a cell is of another type, or no document
                reason = f"{type(error).__name__}: {error}"[:100]
                raise StoreError(
                    f"{source.name}: table {table.name} is damaged ({reason}), take another copy"
                ) from None
    return counts


def _copy_rows(reading: sa.Connection, writing: sa.Connection, table: sa.Table) -> int:
    count, size = 0, BUNDLES_PER_PART if table is bundles else ROWS_PER_PART
    rows = reading.execute(sa.select(table), execution_options={"yield_per": size}).mappings()
    for part in rows.partitions():
        writing.execute(table.insert(), [dict(row) for row in part])
        count += len(part)
    key = table.primary_key.columns.values()[0]
    if count and writing.dialect.name == "postgresql" and key.name == "id":  # the database counts on behind them
        sequence = sa.func.pg_get_serial_sequence(table.name, key.name)
        writing.execute(sa.select(sa.func.setval(sequence, sa.select(sa.func.max(key)).scalar_subquery())))
    return count


def _create_private(path: Path) -> None:
    """Make a file that its owner alone may read; SQLite gives its own further files the same mode."""
    try:
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))
    except OSError as error:
        raise StoreError(f"{path.parent}: cannot be written ({error.strerror}), give another folder") from None


@contextmanager
def _target_connection(url: URL) -> Iterator[sa.Connection]:
    """Yield a connection in a transaction; a file is there under its name only when all is in it."""
    is_file = url.get_backend_name() == "sqlite"
    path = Path(str(url.database))
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    if is_file:
        engine.check_folder(path)
        if path.exists():
            raise StoreError(f"{path}: exists already, give another name")
        _create_private(part)
    opened = engine.create_store_engine(url.set(database=str(part)) if is_file else url, write=True)
    try:
        with engine.translate_errors(url), opened.begin() as connection:
            yield connection
        opened.dispose()
        if is_file:
            part.replace(path)
    finally:
        opened.dispose()
        if is_file:
            for name in ("", "-wal", "-shm"):
                part.with_name(part.name + name).unlink(missing_ok=True)
