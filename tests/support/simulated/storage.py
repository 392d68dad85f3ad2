"""The seam between the service and its database: statements that fail, commits that are lost or of unknown outcome."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy import exc

from servoscope.service.store import engine as engine_module
from simulated.broker import point
from simulated.clock import Clock
from simulated.faults import Plan

WORDS = re.compile(r"\s*(\w+)(?:.*?\b(?:INTO|FROM|UPDATE)\s+(\w+)|\s+(\w+))?", re.DOTALL)


def _failure() -> sqlite3.OperationalError:
    error = sqlite3.OperationalError("disk I/O error")
    error.sqlite_errorcode = sqlite3.SQLITE_IOERR
    return error


def _close(connection: sqlite3.Connection) -> None:
    """Close a connection, and release its lock: a cursor in a frame that is not collected yet would keep both."""
    with suppress(sqlite3.ProgrammingError):  # it is closed already
        connection.rollback()
    connection.close()


class Storage:
    """One engine for all processes of the world, and what its transactions have made durable."""

    def __init__(self, path: Path) -> None:
        self._places: dict[str, str] = {}
        self._path, self._real = path, engine_module.create_store_engine
        url = engine_module.parse_store_url(str(path), path.parent)
        self.engine = self._real(url, write=True)
        sa.event.listen(self.engine, "before_cursor_execute", self._before)
        sa.event.listen(self.engine, "after_cursor_execute", self._after)
        self._connections: list[sqlite3.Connection] = []
        sa.event.listen(self.engine, "connect", lambda connection, _: self._connections.append(connection))
        dialect = self.engine.dialect
        self._do_commit, self._do_rollback = dialect.do_commit, dialect.do_rollback
        dialect.do_commit, dialect.do_rollback = self._commit, self._rollback
        dialect.do_close = dialect.do_terminate = _close
        self.clock: Clock | None = None
        self.plan: Plan | None = None
        self._open: dict[int, list[tuple[str, Any]]] = {}  # by connection, what its transaction has written
        self.durable: Callable[[list[tuple[str, Any]]], None] = lambda _: None
        self.away = False

    def begin(self, clock: Clock, plan: Plan, durable: Callable[[list[tuple[str, Any]]], None]) -> None:
        """Begin a history on a clean ground, whose connections have ended."""
        self.clock, self.plan, self.durable, self.away = clock, plan, durable, False
        self._open.clear()

    def create(self, url: sa.URL, **_: Any) -> sa.Engine:
        """Return the engine, whose statements are known already."""
        return self.engine

    def _place(self, statement: str) -> str:
        if (place := self._places.get(statement)) is None:
            words = [word for word in WORDS.match(statement).groups() if word]  # type: ignore[union-attr]
            verb = "upsert" if "ON CONFLICT" in statement else words[0].lower()
            place = self._places[statement] = f"{verb} {words[-1].lower()}" if len(words) > 1 else verb
        return place

    def _plain(self, parameters: Any) -> list[Any]:
        """Return parameters by what they say: the folder has another name in each process."""
        rows = parameters if isinstance(parameters, list) else [parameters]
        values = [x for row in rows for x in (row.values() if isinstance(row, dict) else row)]
        folder = str(self._path.parent)
        return [
            bytes(x) if isinstance(x, memoryview) else x.replace(folder, "") if isinstance(x, str) else x
            for x in values
        ]

    def _point(self, place: str) -> str:
        return point(self.clock, self.plan, place) if self.clock and self.plan else ""

    def _before(self, connection: Any, _cursor: Any, statement: str, parameters: Any, *_: Any) -> None:
        place = self._place(statement)
        if self.plan is not None:
            self.plan.note(place, *self._plain(parameters))
        if place == "begin":
            self._open[id(connection.connection.dbapi_connection)] = []  # a killed process may have left something
        if self.away or self._point(f"{place} before") == "error":
            raise exc.OperationalError("", None, _failure())

    def _after(self, connection: Any, _cursor: Any, statement: str, parameters: Any, _context: Any, many: bool) -> None:
        place = self._place(statement)
        if not place.startswith(("select", "begin", "pragma")):
            rows = parameters if many else [parameters]
            own = self._open.setdefault(id(connection.connection.dbapi_connection), [])
            own.extend((place, row) for row in rows)
        self._point(f"{place} after")

    def _commit(self, connection: Any) -> None:
        written = self._open.pop(id(connection.dbapi_connection), [])
        place = "commit" if any("meta" in where for where, _ in written) else "commit read"
        if self.plan is not None:
            self.plan.note(place)
        fault = self._point(f"{place} before")
        if fault == "lost" or self.away:
            self._do_rollback(connection)
            raise _failure()
        self._do_commit(connection)
        if written:
            self.durable(written)
        if self._point(f"{place} after") == "unknown":
            raise _failure()

    def _rollback(self, connection: Any) -> None:
        self._open.pop(id(connection.dbapi_connection), None)
        with suppress(sqlite3.ProgrammingError):  # of a process that is gone
            self._do_rollback(connection)

    def end(self) -> None:
        """Close all connections, as the operating system does when their process ends: with them go their locks."""
        for connection in self._connections:
            _close(connection)
        self._connections.clear()
        self.engine.dispose()
