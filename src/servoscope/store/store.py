"""A store: opened once, written by one process, read by many."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import URL

from servoscope.errors import StoreError
from servoscope.store import opening, schema, tables
from servoscope.store.batch import Batch, Row, key_of

__all__ = ["Store"]


class Store:
    """History, checkpoints, commands and outbox; make one with `open`."""

    def __init__(self, url: URL, engine: sa.Engine) -> None:
        self._url, self._engine = url, engine
        self._claim: opening.Claim | None = None

    @classmethod
    def open(
        cls, url: str, folder: Path | None = None, *, write: bool = False, patience: float = opening.PATIENCE
    ) -> Store:
        """Open a store.

        Parameters
        ----------
        url
            A path, for SQLite, or a URL.
        folder
            What the path is relative to; None: the working directory.
        write
            Whether tables may be made and migrated; otherwise the store must be there.
        patience
            How long a locked SQLite file is waited for [s].

        Raises
        ------
        StoreError
            If it cannot be used.
        """
        try:
            found = opening.url_of(url, folder or Path.cwd())
            store = cls(found, opening.engine_of(found, patience=patience))
        except ModuleNotFoundError as error:
            raise StoreError(f"{error.name} is missing, pip install 'servoscope[service]'") from None
        if found.get_backend_name() == "sqlite" and not write and not Path(found.database or "").exists():
            raise StoreError(f"{store.name}: no such store, servoscope run makes it")
        if found.get_backend_name() == "sqlite":
            opening.check_folder(Path(str(found.database)))
        try:
            with store._transaction() as connection:
                schema.prepare(connection, store.name, write=write)
        except BaseException:
            store.close()
            raise
        return store

    @property
    def name(self) -> str:
        """What messages call it."""
        return opening.shown(self._url)

    def claim(self, assets: Sequence[str]) -> None:
        """Take the right to write about these assets; it is held until `close`, or the process ends.

        Raises
        ------
        StoreError
            If another process has it.
        """
        self._claim = opening.Claim(self._url, self._engine, assets)
        self._claim.hold()

    def close(self) -> None:
        """Close it."""
        if self._claim is not None:
            self._claim.drop()
        self._engine.dispose()

    @contextmanager
    def _transaction(self) -> Iterator[sa.Connection]:
        with opening.guarded(self._url), self._engine.begin() as connection:
            yield connection

    def last_commit(self, owner: str) -> int:
        """Return the number of an owner's last transaction, 0 before the first."""
        query = sa.select(tables.meta.c.value).where(tables.meta.c.key == key_of(owner))
        with self._transaction() as connection:
            return int(connection.execute(query).scalar() or 0)

    def write(self, batch: Batch, owner: str, commit: int) -> None:
        """Write a batch whole, as commit number `commit` of its owner, which is one more than `last_commit`.

        A batch whose commit was cut off may or may not be in the store: `last_commit` tells.

        Raises
        ------
        StoreUnavailable
            If it is not in the store, or nobody knows, and trying again may help.
        """
        if self._claim is not None:
            self._claim.hold()
        with self._transaction() as connection:
            batch.write(connection, owner, commit)

    def ask(self, command: Row) -> int:
        """Write down what an operator wants, from any process; return its id."""
        row = {"at": time.time(), **command}
        with self._transaction() as connection:
            return int(connection.execute(tables.commands.insert().returning(tables.commands.c.id), row).scalar_one())

    def outcome(self, command: int) -> str | None:
        """Return what became of a command; None while nobody has carried it out."""
        query = sa.select(tables.commands.c.outcome).where(tables.commands.c.id == command)
        with self._transaction() as connection:
            found = connection.execute(query).scalar()
        return None if found is None else str(found)

    def checkpoints(self, assets: Sequence[str] | None = None) -> dict[str, Row]:
        """Return the newest checkpoint of these assets, or of all, by name; without those that have none."""
        query = sa.select(tables.checkpoints).order_by(tables.checkpoints.c.asset)
        if assets is not None:
            query = query.where(tables.checkpoints.c.asset.in_(assets))
        return {row["asset"]: row for row in self.rows(query)}

    def statuses(self, assets: Sequence[str] | None = None) -> dict[str, Row]:
        """Return what `checkpoints` returns, without the states."""
        table = tables.checkpoints
        query = sa.select(table.c.asset, table.c.sequence, table.c.status, table.c.at).order_by(table.c.asset)
        if assets is not None:
            query = query.where(table.c.asset.in_(assets))
        return {row["asset"]: row for row in self.rows(query)}

    def clocks(self) -> dict[str, float]:
        """Return when each asset's newest checkpoint was written [UTC s]: it changes with every one."""
        table = tables.checkpoints
        return {row["asset"]: row["at"] for row in self.rows(sa.select(table.c.asset, table.c.at))}

    def note(self, who: str, asset: str, what: str, document: Row) -> None:
        """Write a line of the audit, from any process; an empty asset: of all of them, or of none."""
        row = {"at": time.time(), "who": who, "asset": asset, "what": what, "document": dict(document)}
        with self._transaction() as connection:
            connection.execute(tables.audit.insert(), row)

    def recent(self, asset: str) -> list[tuple[int, bytes]]:
        """Return an asset's recent samples: sequence and packed block, in order."""
        table = tables.recent
        query = sa.select(table).where(table.c.asset == asset).order_by(table.c.sequence)
        return [(row["sequence"], row["samples"]) for row in self.rows(query)]

    def waiting_commands(self) -> list[Row]:
        """Return the commands that nobody has carried out."""
        table = tables.commands
        return self.rows(sa.select(table).where(table.c.outcome.is_(None)).order_by(table.c.id))

    def due_deliveries(self, now: float, most: int, service: str, busy: Collection[str] = ()) -> list[Row]:
        """Return up to `most` rows of a service's outbox whose next attempt is due, the oldest first.

        Without those for sinks that are busy.
        """
        table = tables.outbox
        due = table.c.due.is_not(None) & (table.c.due <= now) & table.c.sink.not_in(busy)
        own = table.c.event["service"].as_string() == service
        return self.rows(sa.select(table).where(due & own).order_by(table.c.due, table.c.key).limit(most))

    def forget(self, table: str, before: Mapping[str, float]) -> int:
        """Delete rows of a table that are older, by the asset's own clock; return how many."""
        chosen, count = tables.TABLES.tables[table], 0
        with self._transaction() as connection:
            for asset, t in before.items():
                old = (chosen.c.asset == asset) & (chosen.c.t < t)
                count += connection.execute(chosen.delete().where(old)).rowcount
        return count

    def rows(self, query: sa.Select[Any]) -> list[Row]:
        """Return what a query finds."""
        with self._transaction() as connection:
            return [dict(row) for row in connection.execute(query).mappings()]
