"""Connections of clients that are slow, silent or many: deadlines, limits, and room for who asks for health.

A connection waits for a request, receives one, or is being answered. What waits too long, or sends or reads too slowly,
is closed and counted. Where there is no more room, the connection that has waited longest gives way to a new one; where
none waits, the new one is told of health and of nothing else.
"""

from __future__ import annotations

import asyncio
import socket
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import h11
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.flow_control import service_unavailable
from uvicorn.protocols.http.h11_impl import H11Protocol

from servoscope.core.networks import is_member

HEALTH_PREFIX = "/health/"


class ConnectionTable:
    """The open connections of one server.

    Parameters
    ----------
    most, most_per_address
        How many there may be, of everybody and of one address.
    proxies
        Networks of those that connect for others, and are not counted by address.
    """

    def __init__(self, most: int, most_per_address: int, proxies: Sequence[str] = ()) -> None:
        self._most, self._most_per_address, self._proxies = most, most_per_address, proxies
        self.cut: Counter[str] = Counter()  # connections that were closed, by the reason
        self._hosts: dict[HttpProtocol, str] = {}  # of all that are open
        self._counts: Counter[str] = Counter()
        self._handshakes: dict[tuple[str, int], socket.socket] = {}  # that TLS has not ended, by client; oldest first
        self._waiting: dict[HttpProtocol, None] = {}  # for a request; who has waited longest stands first

    def begin_handshake(self, connection: socket.socket, client: tuple[str, int]) -> None:
        """Count a connection that has to agree on TLS first; where there are too many, the oldest gives way."""
        self._handshakes = {key: handshake for key, handshake in self._handshakes.items() if handshake.fileno() >= 0}
        own = [key for key in self._handshakes if key[0] == client[0] and not is_member(key[0], self._proxies)]
        everybody = list(self._handshakes)
        for some, most in ((own, self._most_per_address), (everybody, self._most - len(self._hosts))):
            if some and len(some) >= most:
                with suppress(OSError):  # it may have ended meanwhile
                    self._handshakes[some[0]].shutdown(socket.SHUT_RDWR)
                del self._handshakes[some[0]]
                self.cut["handshake"] += 1
                break
        self._handshakes[client] = connection

    def add(self, connection: HttpProtocol, client: tuple[str, int]) -> bool:
        """Count a new connection; return whether there is room for it."""
        self._handshakes.pop(client, None)
        host = "" if is_member(client[0], self._proxies) else client[0]
        has_room = True
        if host and self._counts[host] >= self._most_per_address:
            has_room = self._close_oldest(host)
        if len(self._hosts) >= self._most:
            has_room = self._close_oldest(None) and has_room
        self.cut["refused"] += not has_room
        self._hosts[connection] = host
        self._counts[host] += 1
        return has_room

    def remove(self, connection: HttpProtocol) -> None:
        """Forget a connection, known or not."""
        self._waiting.pop(connection, None)
        if (host := self._hosts.pop(connection, None)) is not None:
            self._counts[host] -= 1
            if not self._counts[host]:
                del self._counts[host]

    def mark(self, connection: HttpProtocol, *, waiting: bool) -> None:
        """Note whether a connection waits for a request."""
        if not waiting:
            self._waiting.pop(connection, None)
        elif connection in self._hosts:
            self._waiting.setdefault(connection)

    def _close_oldest(self, host: str | None) -> bool:
        oldest = next((protocol for protocol in self._waiting if host is None or self._hosts[protocol] == host), None)
        if oldest is None:
            return False
        self.remove(oldest)
        oldest.abort("room")
        return True


class TlsListener(socket.socket):
    """A listening socket that tells the table of each connection before TLS begins."""

    table: ConnectionTable

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection."""
        connection, client = super().accept()
        self.table.begin_handshake(connection, client[:2])
        return connection, client


class HttpProtocol(H11Protocol):
    """One connection of a server whose connections a table counts."""

    HEADER_S = 10.0  # within which the header of a request has to be complete
    BODY_S = 20.0  # more than its bytes need at `BODY_RATE` within which a body has to be complete
    BODY_RATE = 10_000.0  # bytes per second
    DRAIN_S = 60.0  # within which a client has to make room for more of an answer

    def __init__(self, table: ConnectionTable, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._table = table
        self._phase = ""  # header, body, or none
        self._deadline = 0.0  # of the phase, by the clock of the loop [s]
        self._phase_timer: asyncio.TimerHandle | None = None
        self._drain_timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as the base class
        """Begin to wait for a request."""
        super().connection_made(transport)
        if not self._table.add(self, self.client or ("", 0)):
            self.app = partial(_serve_health, self.app)
        self._follow_phase()

    def connection_lost(self, exc: Exception | None) -> None:
        """End."""
        self._table.remove(self)
        for timer in (self._phase_timer, self._drain_timer):
            if timer is not None:
                timer.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take what the client has sent."""
        self._deadline += len(data) / self.BODY_RATE if self._phase == "body" else 0.0
        super().data_received(data)
        self._follow_phase()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self._follow_phase()

    def pause_writing(self) -> None:
        """Give the client time to read."""
        super().pause_writing()
        self._drain_timer = self.loop.call_later(self.DRAIN_S, self.abort, "answer")

    def resume_writing(self) -> None:
        """Go on: the client has read."""
        super().resume_writing()
        if self._drain_timer is not None:
            self._drain_timer.cancel()

    def abort(self, why: str) -> None:
        """Close the connection without waiting for the client, and count it."""
        self._table.cut[why] += 1
        self.transport.abort()

    def _follow_phase(self) -> None:
        """Begin a deadline where the client has something else to send than before."""
        state = self.conn.their_state
        phase = "header" if state is h11.IDLE else "body" if state is h11.SEND_BODY else ""
        if phase == self._phase or self.transport.is_closing():
            return
        self._phase = phase
        self._table.mark(self, waiting=phase == "header")
        if self._phase_timer is not None:
            self._phase_timer.cancel()
        if phase:
            self._deadline = self.loop.time() + (self.HEADER_S if phase == "header" else self.BODY_S)
            self._phase_timer = self.loop.call_at(self._deadline, self._check_deadline)

    def _check_deadline(self) -> None:
        now = self.loop.time()
        if self.flow.read_paused:  # it is the application that has not taken what has come
            self._deadline = max(self._deadline, now + self.BODY_S)
        if now < self._deadline:
            self._phase_timer = self.loop.call_at(self._deadline, self._check_deadline)
        else:
            self.abort(self._phase)


async def _serve_health(app: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer a connection for which there is no room."""
    if str(scope["path"]).startswith(HEALTH_PREFIX):
        await app(scope, receive, send)
    else:
        await service_unavailable(scope, receive, send)  # type: ignore[arg-type]  # uvicorn's names of the same
