"""Opens a store: SQLite in a file, or PostgreSQL by URL; who may write to it, and what its failures mean."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy import exc
from sqlalchemy.engine import URL, make_url

from servoscope.errors import StoreError, StoreUnavailable

__all__ = ["Claim", "engine_of", "guarded", "shown"]

PATIENCE = 0.5  # s: that a locked SQLite file is waited for; the samples go on meanwhile
PASSING = {  # what SQLite says when trying again may help
    sqlite3.SQLITE_BUSY,
    sqlite3.SQLITE_LOCKED,
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_READONLY,
    sqlite3.SQLITE_NOMEM,
    sqlite3.SQLITE_PROTOCOL,
}
HINTS = {  # what to do, where SQLite does not say it
    sqlite3.SQLITE_CORRUPT: ", restore it from a copy",
    sqlite3.SQLITE_NOTADB: ", give another path",
    sqlite3.SQLITE_CANTOPEN: ", its folder must be one that servoscope may write to",
    sqlite3.SQLITE_READONLY: ", file and folder must be ones that servoscope may write to",
}
LINGERS = 2.0  # s: the longest that the lock of a killed process is waited for


def url_of(text: str, folder: Path) -> URL:
    """Return the URL of a store: a path relative to `folder`, or a URL of SQLite or PostgreSQL.

    Raises
    ------
    StoreError
        If it is neither.
    """
    if "\0" in text:
        raise StoreError(f"store: {text!r} holds a zero byte, give another path")
    if "://" not in text:
        return URL.create("sqlite", database=str((folder / text).absolute()))
    try:
        url = make_url(text)
    except (exc.ArgumentError, ValueError):
        raise StoreError("store: cannot be read as a URL, write postgresql://user@host/database, or a path") from None
    kind = url.get_backend_name()
    if kind not in ("sqlite", "postgresql"):
        hint = "write postgresql://" if kind == "postgres" else "give a path for SQLite or postgresql://..."
        raise StoreError(f"store: {kind}:// is not supported, {hint}")
    if kind == "sqlite" and not url.database:
        raise StoreError(f"store: {text} would be lost with the process, give a path")
    if kind == "sqlite":
        return url.set(database=str((folder / str(url.database)).absolute()))
    return url.set(drivername="postgresql+psycopg") if kind == "postgresql" else url


def check_folder(path: Path) -> None:
    """Check that SQLite can have a file there; it says itself no more than that it cannot open it.

    Raises
    ------
    StoreError
        If it cannot.
    """
    if path.is_dir():
        raise StoreError(f"{path}: is a folder, give the name of a file in it")
    if not path.parent.is_dir():
        raise StoreError(f"{path}: the folder {path.parent} does not exist, make it, or give another path")


def shown(url: URL) -> str:
    """Return what messages call a store: never its password."""
    if url.get_backend_name() == "sqlite":
        return str(url.database)
    return url.set(drivername="postgresql").render_as_string(hide_password=True)


def engine_of(url: URL, *, patience: float = PATIENCE) -> sa.Engine:
    """Return an engine; nothing is opened yet.

    Raises
    ------
    StoreError
        If the driver is missing.
    """
    if url.get_backend_name() == "sqlite":
        engine = sa.create_engine(url, connect_args={"timeout": patience})
        sa.event.listen(engine, "connect", _set_up_sqlite)
        # the driver itself begins late, and ends a transaction before it changes a table
        sa.event.listen(engine, "begin", lambda connection: connection.exec_driver_sql("BEGIN"))
        return engine
    options = "-c statement_timeout=60s -c lock_timeout=5s"
    arguments = {"connect_timeout": 5, "application_name": "servoscope", "options": options, "tcp_user_timeout": 10000}
    try:
        return sa.create_engine(url, connect_args=arguments, pool_pre_ping=True)
    except ModuleNotFoundError:
        raise StoreError(f"{shown(url)}: the driver psycopg is missing, pip install 'servoscope[service]'") from None


def _set_up_sqlite(connection: sqlite3.Connection, _: object) -> None:
    # readers never wait for the writer; FULL, because what has been acknowledged must survive a power cut
    for pragma in ("journal_mode = WAL", "synchronous = FULL", "journal_size_limit = 67108864"):
        connection.execute(f"PRAGMA {pragma}")
    connection.isolation_level = None


@contextmanager
def guarded(url: URL) -> Iterator[None]:
    """Turn what the database says into one line: StoreUnavailable where trying again may help, else StoreError."""
    try:
        yield
    except exc.DBAPIError as error:
        said = " ".join(str(error.orig).split()) + HINTS.get(getattr(error.orig, "sqlite_errorcode", 0) & 0xFF, "")
        if _passes(error):
            raise StoreUnavailable(f"{shown(url)}: {said}") from error
        raise StoreError(f"{shown(url)}: {said}") from error
    except json.JSONDecodeError as error:
        raise StoreError(f"{shown(url)}: a document in it is torn ({error}), restore it from a copy") from None
    except exc.SQLAlchemyError as error:  # for example a pool that waited in vain
        raise StoreUnavailable(f"{shown(url)}: {' '.join(str(error).split())}") from error


def _passes(error: exc.DBAPIError) -> bool:
    if error.connection_invalidated:
        return True
    if isinstance(error.orig, sqlite3.Error):
        return getattr(error.orig, "sqlite_errorcode", 0) & 0xFF in PASSING
    return isinstance(error, exc.OperationalError | exc.InterfaceError | exc.InternalError)


class Claim:
    """The right to write about some assets, held by one process at a time; it ends with the process.

    Parameters
    ----------
    url, engine
        Of the store.
    assets
        Whom it is about.
    """

    def __init__(self, url: URL, engine: sa.Engine, assets: Sequence[str]) -> None:
        self._url, self._engine, self._assets = url, engine, tuple(assets)
        self._file: int | None = None
        self._connection: sa.Connection | None = None

    def hold(self) -> None:
        """Take the claim, or take it again after the connection was lost.

        Raises
        ------
        StoreError
            If another process has it.
        StoreUnavailable
            If the store is down.
        """
        if self._url.get_backend_name() == "sqlite":
            self._hold_file()
        elif not self._held():
            self.drop()
            with guarded(self._url):
                self._connection = self._engine.connect().execution_options(isolation_level="AUTOCOMMIT")
                for asset in self._assets:
                    if not self._connection.execute(sa.select(sa.func.pg_try_advisory_lock(_key(asset)))).scalar():
                        raise StoreError(f"{shown(self._url)}: another servoscope run follows {asset}, stop it first")

    def _hold_file(self) -> None:
        if self._file is not None:
            return
        path = Path(f"{self._url.database}.lock")
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            _lock(self._file)
        except BlockingIOError:
            self.drop()
            raise StoreError(
                f"{shown(self._url)}: another servoscope run writes to it, stop it first, or give a store of its own"
            ) from None
        except OSError as error:
            self.drop()
            raise StoreError(
                f"{path}: cannot be written ({error.strerror}), its folder must be one that servoscope may write to"
            ) from None

    def _held(self) -> bool:
        if self._connection is None:
            return False
        try:
            self._connection.execute(sa.text("SELECT 1"))
        except exc.SQLAlchemyError:
            return False
        return True

    def drop(self) -> None:
        """Give it back."""
        if self._file is not None:
            os.close(self._file)
        if self._connection is not None:
            self._connection.invalidate()
            self._connection.close()
        self._file = self._connection = None


def _lock(file: int) -> None:
    """Lock a file; what a killed process was about to start holds its lock for a moment longer than itself."""
    until = time.monotonic() + LINGERS
    while True:
        try:
            return fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= until:
                raise
            time.sleep(0.02)


def _key(asset: str) -> Any:
    """Return the number of an asset's advisory lock."""
    digest = hashlib.blake2b(f"servoscope/{asset}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big", signed=True)
