"""What one transaction writes: rows of several assets together with the checkpoints of these assets."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from servoscope.service.store import engine, tables
from servoscope.service.store.bundles import BundleChanges, write_bundles
from servoscope.service.store.rows import RefusedRow, Row

OLD_SAMPLES = tables.recent.delete().where(
    (tables.recent.c.asset == sa.bindparam("of")) & (tables.recent.c.sequence < sa.bindparam("below"))
)


@dataclass
class Batch:
    """Rows that become visible together, or not at all."""

    rows: dict[str, list[Row]] = field(default_factory=lambda: defaultdict(list))  # new rows by the name of their table
    checkpoints: dict[str, Row] = field(default_factory=dict)  # the newest per asset: only that is written
    bundles: BundleChanges = field(default_factory=lambda: BundleChanges([], [], []))  # of the newest samples
    first_needed: dict[str, int] = field(default_factory=dict)  # per asset, of the sequences of its recent samples
    outcomes: dict[int, Row] = field(default_factory=dict)  # changes of rows of the commands, by id
    deliveries: dict[str, Row] = field(default_factory=dict)  # changes of rows of the outbox, by key

    @property
    def empty(self) -> bool:
        """Whether there is nothing to write."""
        changes = self.checkpoints or self.outcomes or self.deliveries or any(self.bundles)
        return not (any(self.rows.values()) or changes)

    def write(self, connection: sa.Connection, owner: str, commit: int) -> None:
        """Write it in the connection's transaction, as commit number `commit` of its owner."""
        for _, statement, rows in self._changes(connection, owner, commit):
            connection.execute(statement, rows)
        write_bundles(connection, owner, self.bundles)

    def write_singly(self, connection: sa.Connection, owner: str, commit: int) -> list[RefusedRow]:
        """Write it as `write` does, row by row, and set aside what the database refuses for its content: return that.

        The audit names each of them.
        """
        refused = list[RefusedRow]()
        for table, statement, rows in self._changes(connection, owner, commit):
            for row in rows:
                try:
                    with connection.begin_nested():
                        connection.execute(statement, [row])
                except Exception as error:
                    if not engine.is_refusal(error):
                        raise
                    refused.append(RefusedRow.of(table, row, engine.describe_refusal(error)))
        write_bundles(connection, owner, self.bundles)
        if refused:
            names = {"at": time.time(), "who": "servoscope", "what": "row set aside"}
            audit = [{"asset": row.asset or owner, **names, "document": row._asdict()} for row in refused]
            connection.execute(tables.audit.insert(), audit)
        return refused

    def _changes(
        self, connection: sa.Connection, owner: str, commit: int
    ) -> Iterator[tuple[sa.Table, sa.Executable, list[Row]]]:
        """Yield statements, with their tables and rows, in the order in which they are executed."""
        dialect = connection.dialect.name
        yield tables.meta, _upsert(dialect, tables.meta), [{"key": commit_key(owner), "value": commit}]
        for name, rows in self.rows.items():
            table = tables.METADATA.tables[name]
            if rows:  # a clock that was set back may come to the same time again
                yield table, _upsert(dialect, table) if table is tables.sizes else table.insert(), rows
        if self.checkpoints:
            yield tables.checkpoints, _upsert(dialect, tables.checkpoints), list(self.checkpoints.values())
        if self.first_needed:
            first: list[Row] = [{"asset": asset, "sequence": sequence} for asset, sequence in self.first_needed.items()]
            yield tables.needed, _upsert(dialect, tables.needed), first
            yield tables.recent, OLD_SAMPLES, [{"of": row["asset"], "below": row["sequence"]} for row in first]
        for key, changes in ((tables.commands.c.id, self.outcomes), (tables.outbox.c.key, self.deliveries)):
            if changes:
                rows = [{"of": name, **row} for name, row in changes.items()]
                yield key.table, key.table.update().where(key == sa.bindparam("of")), rows


def commit_key(owner: str) -> str:
    """Return the key of `meta` under which the number of an owner's last commit is stored."""
    return f"commit of {owner}"


@cache  # to make a statement takes as long as to execute it for fifty rows
def _upsert(dialect_name: str, table: sa.Table) -> sa.Insert:
    insert = postgresql.insert(table) if dialect_name == "postgresql" else sqlite.insert(table)
    keys = [column.name for column in table.primary_key]
    changed = {column.name: insert.excluded[column.name] for column in table.c if column.name not in keys}
    return insert.on_conflict_do_update(index_elements=keys, set_=changed)
