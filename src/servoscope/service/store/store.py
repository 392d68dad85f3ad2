"""The store: batches of a service in, commands and notes of people in, all of it out."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import sqlalchemy as sa
from sqlalchemy.engine import URL

from servoscope.core.errors import EmptyStoreError, StoreError, StoreUnavailableError
from servoscope.service.store import engine, schema, tables
from servoscope.service.store.batch import Batch, commit_key
from servoscope.service.store.bundles import BundleIndex, dissolve_rows_of_others, read_index, read_samples
from servoscope.service.store.rows import BEGUN, CHECKS, NOTE, RELEARN, CommandOutcome, RefusedRow, Row

Result = TypeVar("Result")
OPENING_S = 5.0  # how long a writer tries to open a file that another process is preparing


class Store:
    """History, checkpoints, commands and outbox; `Store.open` returns one."""

    def __init__(self, url: URL, connections: sa.Engine) -> None:
        self._url, self._engine = url, connections
        self._lock: engine.WriterLock | None = None
        self._has_lock = False
        self._version = 0  # of its tables

    @classmethod
    def open(
        cls,
        url: str,
        folder: Path | None = None,
        *,
        write: bool = False,
        lock_timeout_s: float = engine.LOCK_TIMEOUT_S,
        has_lock: bool = False,
    ) -> Store:
        """Open a store by its URL, or a path for SQLite, relative to `folder` or else the working directory.

        With `write` tables may be created and migrated; otherwise the store must exist. A locked SQLite file is
        waited for `lock_timeout_s`; `has_lock`: whether the process has inherited the lock of a file. Raises StoreError
        if it cannot be used.
        """
        try:
            store_url = engine.parse_store_url(url, folder or Path.cwd())
            store = cls(store_url, engine.create_store_engine(store_url, lock_timeout_s=lock_timeout_s, write=write))
        except ModuleNotFoundError as error:
            raise StoreError(f"{error.name} is missing, pip install 'servoscope[service]'") from None
        is_file = store_url.get_backend_name() == "sqlite"
        store._has_lock = has_lock and is_file
        if is_file:
            if not write and not Path(store_url.database or "").exists():
                raise StoreError(f"{store.name}: no such store, servoscope run makes it")
            engine.check_folder(Path(str(store_url.database)))
        # Two processes that begin with an empty file lock each other out for a moment, and a reader may see the file
        # before its tables. SQLite does not wait there, as one of them would wait for the other for ever.
        end = time.monotonic() + (OPENING_S if is_file and (write or _is_new(store_url.database)) else 0.0)
        try:
            store._version = store._retry(
                end, lambda connection: schema.create_or_migrate(connection, store.name, write=write)
            )
        except BaseException:
            store.close()
            raise
        return store

    def _retry(self, end: float, work: Callable[[sa.Connection], Result]) -> Result:
        """Return what some work in a transaction does, tried until `end`, monotonic [s]."""
        while True:
            try:
                with self._transaction() as connection:
                    return work(connection)
            except (StoreUnavailableError, EmptyStoreError):
                if time.monotonic() >= end:
                    raise
            time.sleep(0.05)

    @property
    def name(self) -> str:
        """What messages call it."""
        return engine.display_url(self._url)

    @property
    def has_sizes(self) -> bool:
        """Whether it keeps sizes over time; a store of version 1 does not until servoscope run has opened it."""
        with self._transaction() as connection:
            return self._has(schema.SIZES_FROM, connection)

    def _has(self, version: int, connection: sa.Connection) -> bool:
        """Whether its tables are of a version, or of a later one; a service may migrate them under a reader."""
        if self._version < version:
            self._version = schema.create_or_migrate(connection, self.name, write=False)
        return self._version >= version

    def acquire_lock(self, assets: Sequence[str]) -> None:
        """Acquire the right to write about these assets and no others, until `close` or the end of the process.

        Raises StoreError if another process has it; then nothing has changed.
        """
        if self._has_lock:
            return
        if self._lock is not None:
            self._lock.change(assets)
            return
        self._lock = engine.WriterLock(self._url, self._engine, assets)
        self._lock.acquire()

    @property
    def lock_file(self) -> int | None:
        """The open file that is locked; None: there is none."""
        return None if self._lock is None else self._lock.file

    def close(self) -> None:
        """Close it."""
        if self._lock is not None:
            self._lock.release()
        self._engine.dispose()

    @contextmanager
    def _transaction(self) -> Iterator[sa.Connection]:
        with engine.translate_errors(self._url), self._engine.begin() as connection:
            yield connection

    @contextmanager
    def snapshot(self) -> Iterator[sa.Connection]:
        """Yield a connection that sees the store as it is now, whatever is written meanwhile."""
        with engine.translate_errors(self._url), self._engine.connect() as connection:
            if self._url.get_backend_name() == "postgresql":  # SQLite has nothing else
                connection = connection.execution_options(isolation_level="REPEATABLE READ")
            with connection.begin():
                yield connection

    def last_commit(self, owner: str) -> int:
        """Return the number of an owner's last transaction, 0 before the first."""
        query = sa.select(tables.meta.c.value).where(tables.meta.c.key == commit_key(owner))
        with self._transaction() as connection:
            return int(connection.execute(query).scalar() or 0)

    def write(self, batch: Batch, owner: str, commit: int) -> list[RefusedRow]:
        """Write a batch whole, as commit number `commit` of its owner, which is one more than `last_commit`.

        Rows that the database refuses for what they hold are left out, named in the audit, and returned. Raises
        StoreUnavailableError if the batch is not in the store, or that is unknown (`last_commit` shows it), and a retry
        may help.
        """
        if self._lock is not None:
            self._lock.acquire()
        with engine.translate_errors(self._url):
            try:
                with self._engine.begin() as connection:
                    batch.write(connection, owner, commit)
            except Exception as error:
                if not engine.is_refusal(error):
                    raise
                with self._engine.begin() as connection:
                    return batch.write_singly(connection, owner, commit)
        return []

    def add_command(
        self, user: str, asset: str, alarm: str, command: str, *, reason: str = "", for_s: float | None = None
    ) -> int:
        """Add a command of an operator, from any process; return its id. `for_s`: how long to shelve [s]."""
        document = {"why": reason} if for_s is None else {"why": reason, "for_s": for_s}
        row = {"at": time.time(), "who": user, "asset": asset, "alarm": alarm, "command": command, "document": document}
        with self._transaction() as connection:
            return int(connection.execute(tables.commands.insert().returning(tables.commands.c.id), row).scalar_one())

    def add_baseline(self, user: str, asset: str, note: Row, command: Row, check: Callable[[Row | None], None]) -> None:
        """Add the note that a baseline is in force and the command to take it, in one transaction, one at a time.

        `check` is given the document of the last such command that the service has not executed, None without one;
        where it raises, nothing is added.
        """
        shared = {"at": time.time(), "who": user, "asset": asset}
        table = tables.commands
        pending = sa.select(table.c.document).where(
            table.c.asset == asset, table.c.command == RELEARN, table.c.outcome.is_(None)
        )
        with self._transaction() as connection:
            if connection.dialect.name == "postgresql":  # SQLite: the first row locks out other writers
                lock = engine.advisory_lock_key(f"baseline of {asset}")
                connection.execute(sa.select(sa.func.pg_advisory_xact_lock(lock)))
            connection.execute(tables.audit.insert(), {**shared, "what": NOTE, "document": dict(note)})
            check(connection.execute(pending.order_by(table.c.id.desc()).limit(1)).scalar())
            asked = {**shared, "alarm": "", "command": RELEARN, "document": dict(command)}
            connection.execute(table.insert(), asked)

    def command_outcome(self, command: int) -> CommandOutcome | None:
        """Return what became of a command; None until the service has executed it."""
        table = tables.commands
        query = sa.select(table.c.outcome, table.c.document).where(table.c.id == command, table.c.outcome.is_not(None))
        return next((CommandOutcome.from_row(row["outcome"], row["document"]) for row in self.fetch(query)), None)

    def pending_commands(self) -> list[Row]:
        """Return the commands that are not yet executed."""
        table = tables.commands
        return self.fetch(sa.select(table).where(table.c.outcome.is_(None)).order_by(table.c.id))

    def begin_commands(self, rows: Iterable[Row]) -> None:
        """Note of commands that they are under way: should the process end with one of them, it is not tried again."""
        begun = [{"of": row["id"], "document": {**row["document"], BEGUN: time.time()}} for row in rows]
        table = tables.commands
        with self._transaction() as connection:
            connection.execute(table.update().where(table.c.id == sa.bindparam("of")), begun)

    def checkpoints(self, assets: Sequence[str] | None = None) -> dict[str, Row]:
        """Return the newest checkpoint of these assets, or of all, by name; without those that have none."""
        return self._checkpoints(sa.select(tables.checkpoints), assets)

    def statuses(self, assets: Sequence[str] | None = None) -> dict[str, Row]:
        """Return what `checkpoints` returns, without the states."""
        columns = [column for column in tables.checkpoints.c if column.name != "state"]
        return self._checkpoints(sa.select(*columns), assets)

    def checkpoint_times(self) -> dict[str, float]:
        """Return when each asset's newest checkpoint was written [UTC s]: it changes with every one."""
        table = tables.checkpoints
        return {row["asset"]: row["at"] for row in self.fetch(sa.select(table.c.asset, table.c.at))}

    def _checkpoints(self, query: sa.Select[Any], assets: Sequence[str] | None) -> dict[str, Row]:
        name = tables.checkpoints.c.asset
        if assets is not None:
            query = query.where(name.in_(assets))
        return {row["asset"]: row for row in self.fetch(query.order_by(name))}

    def add_audit(self, user: str, asset: str, event: str, document: Row) -> None:
        """Add a line of the audit, from any process; an empty asset: of all of them, or of none."""
        row = {"at": time.time(), "who": user, "asset": asset, "what": event, "document": dict(document)}
        with self._transaction() as connection:
            connection.execute(tables.audit.insert(), row)

    def recent_samples(self, asset: str, newest: int | None = None) -> list[tuple[int, bytes]]:
        """Return an asset's recent samples, or so many of the newest ones: sequence and packed block, in order."""
        return dict(self.recent_samples_of([asset], newest))[asset]

    def recent_samples_of(
        self, assets: Iterable[str], newest: int | None = None
    ) -> Iterator[tuple[str, list[tuple[int, bytes]]]]:
        """Yield each of many assets, in any order, and its recent samples."""
        with self.snapshot() as connection:
            yield from read_samples(connection, assets, newest, in_bundles=self._has(schema.BUNDLES_FROM, connection))

    def last_residuals(self, assets: Iterable[str]) -> dict[str, int]:
        """Return the number of the last row of the residuals of each of these assets, 0 where there is none."""
        table = tables.residuals
        last = sa.select(sa.func.max(table.c.number)).where(table.c.asset == sa.bindparam("of"))
        with self._transaction() as connection:
            return {name: connection.execute(last, {"of": name}).scalar() or 0 for name in assets}

    def bundle_index(self, owner: str) -> BundleIndex:
        """Return which rows hold the samples of an owner's assets."""
        with self._transaction() as connection:
            return read_index(connection, owner)

    def take_over(self, owner: str, assets: Collection[str]) -> None:
        """Let an owner have the samples of assets that another one has followed before."""
        end = time.monotonic() + OPENING_S  # another worker may write to the same file meanwhile
        self._retry(end, lambda connection: dissolve_rows_of_others(connection, owner, assets))

    def due_deliveries(self, now: float, limit: int, service: str, busy: Collection[str] = ()) -> list[Row]:
        """Return up to `limit` rows of a service's outbox whose next attempt is due, the oldest first.

        Without those for sinks that are busy.
        """
        table = tables.outbox
        due = table.c.due.is_not(None) & (table.c.due <= now) & table.c.sink.not_in(busy)
        own = table.c.event["service"].as_string() == service
        columns = [column for column in table.c if column.name != "outcome"]
        return self.fetch(sa.select(*columns).where(due & own).order_by(table.c.due, table.c.key).limit(limit))

    def delete_before(self, table: str, before: Mapping[str, float]) -> int:
        """Delete rows of a table that are older, by the asset's own clock; return how many."""
        if not before:
            return 0
        chosen = tables.METADATA.tables[table]
        old = (chosen.c.asset == sa.bindparam("of_asset")) & (chosen.c.t < sa.bindparam("before"))
        of_assets = [{"of_asset": asset, "before": t} for asset, t in before.items()]
        with self._transaction() as connection:
            return connection.execute(chosen.delete().where(old), of_assets).rowcount

    def delete_events(self, service: str, assets: Sequence[str], before: float) -> dict[str, int]:
        """Delete audit, executed commands, finished deliveries of a service that are older [UTC s]; notes, texts stay.

        Returns how many rows of which table.
        """
        audit, commands, outbox = tables.audit.c, tables.commands.c, tables.outbox.c
        names = [service, *assets]
        old = {
            tables.audit: (audit.at < before) & audit.asset.in_(names) & audit.what.not_in((NOTE, CHECKS)),
            tables.commands: (commands.at < before) & commands.asset.in_(names) & commands.outcome.is_not(None),
            tables.outbox: (outbox.created < before)
            & outbox.due.is_(None)
            & (outbox.event["service"].as_string() == service),
        }
        with self._transaction() as connection:
            return {table.name: connection.execute(table.delete().where(rows)).rowcount for table, rows in old.items()}

    def replace_sizes(self, means: Sequence[Row]) -> None:
        """Replace the sizes of each row's asset, kind and name from `from_t` and before `to_t` by the row itself."""
        if not means:
            return
        table = tables.sizes
        chosen = [table.c[name] == sa.bindparam(f"of_{name}") for name in ("asset", "kind", "name")]
        inside = (table.c.t >= sa.bindparam("from_t")) & (table.c.t < sa.bindparam("to_t"))
        keys = [{**row, **{f"of_{name}": row[name] for name in ("asset", "kind", "name")}} for row in means]
        with self._transaction() as connection:
            connection.execute(table.delete().where(*chosen, inside), keys)
            names = [column.name for column in table.c]
            connection.execute(table.insert(), [{name: row[name] for name in names} for row in means])

    def fetch_tuples(self, query: sa.Select[Any]) -> list[tuple[Any, ...]]:
        """Return the rows of a query as tuples: of many rows, in a fraction of the time."""
        with self._transaction() as connection:
            return [tuple(row) for row in connection.execute(query)]

    def fetch(self, query: sa.Select[Any], values: Row | None = None) -> list[Row]:
        """Return the rows of a query; `values`: of its parameters."""
        with self._transaction() as connection:
            return [dict(row) for row in connection.execute(query, values).mappings()]


def _is_new(path: str | None) -> bool:
    """Return whether a file was written just now."""
    return path is not None and time.time() - Path(path).stat().st_mtime < OPENING_S
