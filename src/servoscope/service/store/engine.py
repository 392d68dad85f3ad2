"""Opens a store: SQLite in a file, or PostgreSQL by URL; who may write to it, and what its failures mean."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

import sqlalchemy as sa
from sqlalchemy import exc
from sqlalchemy.engine import URL, make_url

from servoscope.core.addresses import hide_secrets, show_address
from servoscope.core.errors import StoreError, StoreUnavailableError
from servoscope.core.texts import MAX_TEXT_CHARS, UNSAFE, clean_texts

LOCK_TIMEOUT_S = 0.5  # s: for a locked SQLite file; samples keep coming meanwhile
TRANSIENT_ERRORS = {  # of SQLite, where a retry may help
    sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_READONLY, sqlite3.SQLITE_NOMEM, sqlite3.SQLITE_PROTOCOL,
}  # fmt: skip
# of PostgreSQL, classes of errors about what a row holds: cardinality, data, constraints, limits
REFUSING_CLASSES = ("21", "22", "23", "54")
ESCAPED_CONTROL = re.compile(r"\\(?:[bfr]|u00)")  # as JSON has them
HINTS = {  # what to do, where SQLite does not say it
    sqlite3.SQLITE_CORRUPT: ", restore it from a copy",
    sqlite3.SQLITE_NOTADB: ", give another path",
    sqlite3.SQLITE_CANTOPEN: ", its folder must be one that servoscope may write to",
    sqlite3.SQLITE_READONLY: ", file and folder must be ones that servoscope may write to",
}
LARGE_WRITES = (  # samples come and go by megabytes: together these take less than half the processor time
    "page_size = 16384",  # of a new file
    "wal_autocheckpoint = 4000",
    "journal_size_limit = 67108864",
    "cache_size = -32768",  # a commit of ten thousand assets fits in
    "secure_delete = OFF",  # Debian's SQLite overwrites with zeros what is deleted
)
READ_ONLY_OPTIONS = {"mode": "ro", "immutable": "1", "uri": "true"}
LOCK_RELEASE_S = 2.0  # s: after which a killed process has released its lock


def parse_store_url(text: str, folder: Path) -> URL:
    """Return the URL of a store: a path relative to `folder`, or a URL of SQLite or PostgreSQL; else StoreError."""
    if "\0" in text:
        raise StoreError(f"store: {hide_secrets(repr(text))} holds a zero byte, give another path")
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
    if kind == "postgresql":
        return url.set(drivername="postgresql+psycopg")
    if not url.database:
        raise StoreError(f"store: {show_address(text)} would be lost with the process, give a path")
    return url.set(database=str((folder / url.database).absolute()))


def check_folder(path: Path) -> None:
    """Raise StoreError if SQLite cannot have a file there; its own error would not say why."""
    if path.is_dir():
        raise StoreError(f"{path}: is a folder, give the name of a file in it")
    if not path.parent.is_dir():
        raise StoreError(f"{path}: the folder {path.parent} does not exist, make it, or give another path")


def display_url(url: URL) -> str:
    """Return what messages call a store: a path, or scheme, host and port."""
    if url.get_backend_name() == "sqlite":
        return str(url.database)
    return show_address(url.set(drivername="postgresql").render_as_string())


def create_store_engine(url: URL, *, lock_timeout_s: float = LOCK_TIMEOUT_S, write: bool = False) -> sa.Engine:
    """Return an engine that has opened nothing yet; raises StoreError if the driver is missing."""
    if url.get_backend_name() == "sqlite":
        lies_still = not write and _lies_still(Path(str(url.database)))
        read = url.set(database=f"file:{quote(str(url.database))}", query=READ_ONLY_OPTIONS) if lies_still else url
        arguments: dict[str, Any] = {"connect_args": {"timeout": lock_timeout_s}, "json_serializer": encode_document}
        engine = sa.create_engine(read, hide_parameters=True, **arguments)
        if not lies_still:
            sa.event.listen(engine, "connect", _set_up_sqlite)
        # the driver itself begins late, and ends a transaction before it changes a table
        sa.event.listen(engine, "begin", lambda connection: connection.exec_driver_sql("BEGIN"))
        return engine
    options = "-c statement_timeout=60s -c lock_timeout=5s"
    arguments = {"connect_timeout": 5, "application_name": "servoscope", "options": options, "tcp_user_timeout": 10000}
    try:
        engine = sa.create_engine(
            url, connect_args=arguments, pool_pre_ping=True, hide_parameters=True, json_serializer=encode_document
        )
    except ModuleNotFoundError:
        where = display_url(url)
        raise StoreError(f"{where}: the driver psycopg is missing, pip install 'servoscope[service]'") from None
    return engine


def encode_document(document: Any) -> str:
    """Return a document as JSON text, in a fifth of the time that `json.dumps` takes; what is not finite is null.

    Its texts are those of `clean_texts`: of nearly all documents the encoded bytes show that they are so already.
    """
    import msgspec

    try:
        encoded = msgspec.json.encode(document)
    except UnicodeEncodeError:
        return msgspec.json.encode(clean_texts(document)).decode()
    text = encoded.decode()
    is_long = len(text) > MAX_TEXT_CHARS and max(map(len, text.split('"'))) > MAX_TEXT_CHARS
    is_unsafe = "\x7f" in text if text.isascii() else UNSAFE.search(text)
    if not (is_long or is_unsafe or ESCAPED_CONTROL.search(text)):
        return text
    return msgspec.json.encode(clean_texts(document)).decode()


def _lies_still(path: Path) -> bool:
    """Whether a file is a copy on a medium that cannot be written, and whole without its log.

    SQLite keeps the log beside it, and would not read the file where it cannot make one.
    """
    log = path.with_name(f"{path.name}-wal")
    return not os.access(path.parent, os.W_OK, effective_ids=True) and not (log.exists() and log.stat().st_size)


def _set_up_sqlite(connection: sqlite3.Connection, _: object) -> None:
    # readers never wait for the writer; FULL, because what has been acknowledged must survive a power cut
    for pragma in (*LARGE_WRITES, "journal_mode = WAL", "synchronous = FULL"):
        connection.execute(f"PRAGMA {pragma}")
    connection.isolation_level = None


@contextmanager
def translate_errors(url: URL) -> Iterator[None]:
    """Turn errors of the database into one line: StoreUnavailableError where a retry may help, else StoreError."""
    try:
        yield
    except exc.DBAPIError as error:
        text = " ".join(str(error.orig).split()) + HINTS.get(getattr(error.orig, "sqlite_errorcode", 0) & 0xFF, "")
        kind = StoreUnavailableError if _is_transient(error) else StoreError
        raise kind(f"{display_url(url)}: {text}") from error
    except (json.JSONDecodeError, RecursionError) as error:
        raise StoreError(f"{display_url(url)}: a document in it is torn ({error}), restore it from a copy") from None
    except OSError as error:  # of a host that has no address, or none that may be reached
        raise StoreUnavailableError(f"{display_url(url)}: {error.strerror or error}") from error
    except (exc.StatementError, UnicodeError, OverflowError) as error:  # what a row holds cannot be sent
        raise StoreError(f"{display_url(url)}: {describe_refusal(error)}") from error
    except exc.SQLAlchemyError as error:  # for example a timeout of the pool
        raise StoreUnavailableError(f"{display_url(url)}: {' '.join(str(error).split())}") from error


def is_refusal(error: Exception) -> bool:
    """Whether a statement failed for what its rows hold, and others would be written; a retry would not help."""
    if not isinstance(error, exc.DBAPIError):
        return isinstance(error, exc.StatementError | ValueError | TypeError | OverflowError)
    if error.connection_invalidated:
        return False
    if state := getattr(error.orig, "sqlstate", None):
        return str(state)[:2] in REFUSING_CLASSES
    return isinstance(error, exc.DataError | exc.IntegrityError | exc.ProgrammingError)


def describe_refusal(error: Exception) -> str:
    """Return in one line why the rows of a statement were refused."""
    return " ".join(str(getattr(error, "orig", None) or error).split())


def _is_transient(error: exc.DBAPIError) -> bool:
    if error.connection_invalidated:
        return True
    if is_refusal(error):
        return False
    if isinstance(error.orig, sqlite3.Error):
        return getattr(error.orig, "sqlite_errorcode", 0) & 0xFF in TRANSIENT_ERRORS
    return isinstance(error, exc.OperationalError | exc.InterfaceError | exc.InternalError)


class WriterLock:
    """The right to write about some assets, held by one process at a time; it ends with the process."""

    def __init__(self, url: URL, engine: sa.Engine, assets: Sequence[str]) -> None:
        self._url, self._engine, self._assets = url, engine, tuple(assets)
        self.file: int | None = None
        self._connection: sa.Connection | None = None

    def acquire(self) -> None:
        """Acquire it, also once more after the connection was lost.

        Raises StoreError if another process has it, StoreUnavailableError if the store is down.
        """
        if self._url.get_backend_name() == "sqlite":
            self._acquire_file()
        elif not self._is_connected():
            self.release()
            with translate_errors(self._url):
                self._connection = self._engine.connect().execution_options(isolation_level="AUTOCOMMIT")
            self._lock_assets(self._assets)

    def change(self, assets: Sequence[str]) -> None:
        """Hold it for these assets instead; a file is locked as a whole, whoever is in it.

        Raises StoreError if another process has one of them; then nothing has changed. If the connection is lost,
        StoreUnavailableError: the next `acquire` is for these assets.
        """
        before = self._assets
        try:
            if self._connection is not None:
                self._lock_assets([name for name in assets if name not in before])
                self._unlock_assets([name for name in before if name not in assets])
        except StoreUnavailableError:
            self.release()
            self._assets = tuple(assets)
            raise
        self._assets = tuple(assets)

    def _lock_assets(self, assets: Sequence[str]) -> None:
        assert self._connection is not None, "acquire comes first"
        with translate_errors(self._url):
            for i, asset in enumerate(assets):
                lock = sa.select(sa.func.pg_try_advisory_lock(advisory_lock_key(asset)))
                if not self._connection.execute(lock).scalar():
                    self._unlock_assets(assets[:i])
                    raise StoreError(f"{display_url(self._url)}: another servoscope run follows {asset}, stop it first")

    def _unlock_assets(self, assets: Sequence[str]) -> None:
        assert self._connection is not None, "acquire comes first"
        with translate_errors(self._url):
            for asset in assets:
                self._connection.execute(sa.select(sa.func.pg_advisory_unlock(advisory_lock_key(asset))))

    def _acquire_file(self) -> None:
        if self.file is not None:
            return
        path = Path(f"{self._url.database}.lock")
        try:
            self.file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            _lock_file(self.file)
        except BlockingIOError:
            self.release()
            hint = "stop it first, or give a store of its own"
            raise StoreError(f"{self._url.database}: another servoscope run writes to it, {hint}") from None
        except OSError as error:
            self.release()
            hint = "its folder must be one that servoscope may write to"
            raise StoreError(f"{path}: cannot be written ({error.strerror}), {hint}") from None

    def _is_connected(self) -> bool:
        if self._connection is None:
            return False
        try:
            self._connection.execute(sa.text("SELECT 1"))
        except exc.SQLAlchemyError:
            return False
        return True

    def release(self) -> None:
        """Release it."""
        if self.file is not None:
            os.close(self.file)
        if self._connection is not None:
            self._connection.invalidate()
            self._connection.close()
        self.file = self._connection = None


def _lock_file(file: int) -> None:
    """Lock a file; a program that a killed process was about to start holds its lock for a moment longer."""
    deadline = time.monotonic() + LOCK_RELEASE_S
    while True:
        try:
            return fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= deadline:
                raise
            time.sleep(0.02)


def advisory_lock_key(name: str) -> Any:
    """Return the number of an advisory lock: of an asset, by its name, or of something else."""
    digest = hashlib.blake2b(f"servoscope/{name}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big", signed=True)
