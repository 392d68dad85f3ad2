"""The version of a store's tables: made, checked, migrated."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import sqlalchemy as sa

from servoscope.core.errors import EmptyStoreError, StoreError
from servoscope.service.store.rows import Row, fault_rows
from servoscope.service.store.tables import METADATA, bundles, diagnoses, meta, needed, residuals, sizes


def _fill_sizes(connection: sa.Connection) -> None:
    """Make the table of a store of version 1, and fill it with what its full diagnoses have found."""
    sizes.create(connection)
    size_rows: dict[tuple[Any, ...], Row] = {}
    for row in connection.execute(sa.select(diagnoses).where(diagnoses.c.grounds == "full")).mappings():
        for version in fault_rows(row["t"], "full", row["document"].get("faults", [])):
            size_rows[row["asset"], row["t"], version["name"]] = {"asset": row["asset"], **version}
    if size_rows:
        connection.execute(sizes.insert(), list(size_rows.values()))


def _add_bundles(connection: sa.Connection) -> None:
    """Make the tables of samples in bundles; those that are there keep rows of their own until they are too old."""
    bundles.create(connection)
    needed.create(connection)


def _cover_residuals(connection: sa.Connection) -> None:
    """Make the index of residuals by time anew: before version 4 it held the times alone."""
    for index in residuals.indexes:
        index.drop(connection)
        index.create(connection)


Migration = Callable[[sa.Connection], None]
FIRST_VERSION = 1
# the first leads from 1 to 2; a step that was released is never changed
MIGRATIONS: list[Migration] = [_fill_sizes, _add_bundles, _cover_residuals]
SIZES_FROM = 2  # version with sizes over time
BUNDLES_FROM = 3  # version with samples in bundles
READABLE_FROM = 1  # oldest version that is read as it is: what came later are further tables and an index


def schema_version() -> int:
    """Return the version that this program reads and writes."""
    return FIRST_VERSION + len(MIGRATIONS)


def create_or_migrate(connection: sa.Connection, name: str, *, write: bool) -> int:
    """Create the tables of an empty store, and migrate those of an older version, if `write` allows it; return it.

    The connection is in a transaction, so that a migration is made whole or not at all. Raises StoreError if the store
    (`name` in messages) is of a newer version, lacks a table, or has tables of another program.
    """
    present = set(sa.inspect(connection).get_table_names())
    if meta.name not in present:
        if strange := present & set(METADATA.tables):
            raise StoreError(f"{name}: has a table {min(strange)} that is not servoscope's, give another database")
        if not write:
            raise EmptyStoreError(f"{name}: holds no history yet, start it with servoscope run")
        METADATA.create_all(connection)
        connection.execute(meta.insert(), [{"key": "schema", "value": schema_version()}])
        return schema_version()
    fault, newest = connection.execute(sa.select(meta.c.value).where(meta.c.key == "schema")).scalar(), schema_version()
    if not isinstance(fault, int) or fault < FIRST_VERSION:
        raise StoreError(f"{name}: does not say of which version its tables are, restore it from a copy")
    where = f"{name}: its tables are of version {fault}"
    if fault > newest:
        raise StoreError(f"{where}, this servoscope knows up to {newest}: install a newer one")
    if fault < newest:
        if not write:
            if fault >= READABLE_FROM:
                return fault
            raise StoreError(f"{where}, servoscope run brings them to {newest}")
        if connection.dialect.name == "postgresql":  # an index of a hundred million rows takes minutes
            connection.execute(sa.text("SET LOCAL statement_timeout = 0"))
        for step in MIGRATIONS[fault - FIRST_VERSION :]:
            step(connection)
        connection.execute(meta.update().where(meta.c.key == "schema").values(value=newest))
    elif missing := set(METADATA.tables) - present:
        raise StoreError(f"{name}: its table {min(missing)} is missing, restore it from a copy")
    return newest
