"""What one transaction writes: rows of several assets together with where these assets stand."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from servoscope.store import tables

__all__ = ["Batch", "Row", "key_of"]

Row = Mapping[str, Any]


@dataclass
class Batch:
    """Rows that become visible together, or not at all.

    Parameters
    ----------
    rows
        New rows by the name of their table.
    checkpoints
        The newest per asset: only that is written.
    keep
        Per asset, the first sequence of its recent samples that is still needed.
    outcomes
        Of commands, by id.
    deliveries
        Changes of rows of the outbox, by key.
    """

    rows: dict[str, list[Row]] = field(default_factory=lambda: defaultdict(list))
    checkpoints: dict[str, Row] = field(default_factory=dict)
    keep: dict[str, int] = field(default_factory=dict)
    outcomes: dict[int, str] = field(default_factory=dict)
    deliveries: dict[str, Row] = field(default_factory=dict)

    @property
    def empty(self) -> bool:
        """Whether there is nothing to write."""
        return not (any(self.rows.values()) or self.checkpoints or self.outcomes or self.deliveries)

    def write(self, connection: sa.Connection, owner: str, commit: int) -> None:
        """Write it in the connection's transaction, as commit number `commit` of its owner."""
        _upsert(connection, tables.meta, [{"key": key_of(owner), "value": commit}])
        for name, rows in self.rows.items():
            if name == tables.recent.name:  # behind an outage most of them are old by now
                rows = [row for row in rows if row["sequence"] >= self.keep.get(row["asset"], row["sequence"])]
            if rows:
                connection.execute(tables.TABLES.tables[name].insert(), rows)
        if self.checkpoints:
            _upsert(connection, tables.checkpoints, list(self.checkpoints.values()))
        for table, key, changes in (
            (tables.recent, None, [{"of": asset, "below": first} for asset, first in self.keep.items()]),
            (tables.commands, "id", [{"of": id_, "outcome": said} for id_, said in self.outcomes.items()]),
            (tables.outbox, "key", [{"of": key, **row} for key, row in self.deliveries.items()]),
        ):
            if not changes:
                continue
            if key is None:
                old = (table.c.asset == sa.bindparam("of")) & (table.c.sequence < sa.bindparam("below"))
                connection.execute(table.delete().where(old), changes)
            else:
                connection.execute(table.update().where(table.c[key] == sa.bindparam("of")), changes)


def key_of(owner: str) -> str:
    """Return under which key of `meta` the number of an owner's last commit stands."""
    return f"commit of {owner}"


def _upsert(connection: sa.Connection, table: sa.Table, rows: list[Row]) -> None:
    dialect = postgresql if connection.dialect.name == "postgresql" else sqlite
    insert = dialect.insert(table)
    keys = [column.name for column in table.primary_key]
    changed = {column.name: insert.excluded[column.name] for column in table.c if column.name not in keys}
    connection.execute(insert.on_conflict_do_update(index_elements=keys, set_=changed), rows)
