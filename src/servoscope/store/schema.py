"""The version of a store's tables: made, checked, migrated."""

from __future__ import annotations

from collections.abc import Callable

import sqlalchemy as sa

from servoscope.errors import StoreError
from servoscope.store.tables import TABLES, meta

__all__ = ["MIGRATIONS", "prepare", "version"]

Migration = Callable[[sa.Connection], None]
FIRST = 1
MIGRATIONS: list[Migration] = []  # the first leads from version 1 to 2; a step that was released is never changed


def version() -> int:
    """Return the version that this program reads and writes."""
    return FIRST + len(MIGRATIONS)


def prepare(connection: sa.Connection, name: str, *, write: bool) -> None:
    """Make the tables of an empty store, and bring those of an older version up to date.

    Parameters
    ----------
    connection
        In a transaction, so that a migration is made whole or not at all.
    name
        What messages call the store.
    write
        Whether tables may be made or changed.

    Raises
    ------
    StoreError
        If the store is of a newer version, lacks a table, or holds tables that are none of ours.
    """
    present = set(sa.inspect(connection).get_table_names())
    if meta.name not in present:
        if strange := present & set(TABLES.tables):
            raise StoreError(f"{name}: has a table {min(strange)} that is not servoscope's, give another database")
        if not write:
            raise StoreError(f"{name}: holds no history yet, start it with servoscope run")
        TABLES.create_all(connection)
        connection.execute(meta.insert(), [{"key": "schema", "value": version()}])
        return
    found = connection.execute(sa.select(meta.c.value).where(meta.c.key == "schema")).scalar()
    if not isinstance(found, int) or found < FIRST:
        raise StoreError(f"{name}: does not say of which version its tables are, restore it from a copy")
    if found > version():
        raise StoreError(
            f"{name}: its tables are of version {found}, this servoscope knows up to {version()}: install a newer one"
        )
    if found < version():
        if not write:
            raise StoreError(f"{name}: its tables are of version {found}, servoscope run brings them to {version()}")
        for step in MIGRATIONS[found - FIRST :]:
            step(connection)
        connection.execute(meta.update().where(meta.c.key == "schema").values(value=version()))
    elif missing := set(TABLES.tables) - present:
        raise StoreError(f"{name}: its table {min(missing)} is missing, restore it from a copy")
