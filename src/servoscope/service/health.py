"""Health and metrics of a process, for a supervisor and for Prometheus: what is answered, and a small server for it."""

from __future__ import annotations

import json
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any, NamedTuple

from servoscope.core.errors import ConfigError

if TYPE_CHECKING:
    from prometheus_client.core import Metric


STALL_S = 30.0  # without a turn: then the process is not alive
TEXT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
MAX_CONNECTIONS = 64  # each has a thread; who came first gives way
HEALTH_PATHS = ("/health/live", "/health/ready", "/metrics")


class HealthAnswer(NamedTuple):
    """An answer over HTTP."""

    status: int
    body: bytes
    media_type: str


@dataclass(frozen=True)
class HealthReport:
    """What a process reports of itself."""

    metrics: Callable[[], bytes]  # as Prometheus reads them
    unready: Callable[[], str]  # why it is not ready; empty: it is
    degraded: Callable[[], str] = str  # what it does not do although it is ready; empty: nothing
    last_turn: Callable[[], float] | None = None  # when its loop last turned, by the monotonic clock [s]; None: no loop

    def answer(self, path: str) -> HealthAnswer | None:
        """Return the answer to one of `HEALTH_PATHS`, or None."""
        if path == "/metrics":
            return HealthAnswer(200, self.metrics(), TEXT_TYPE)
        if path == "/health/ready":
            why = self.unready()
            return _json_answer(not why, {"why": why, "degraded": self.degraded()})
        if path == "/health/live":
            if self.last_turn is None:
                return _json_answer(True, {})
            age = time.monotonic() - self.last_turn()
            return _json_answer(age < STALL_S, {"last_turn_s": round(age, 3)})
        return None


def _json_answer(ok: bool, headers: Mapping[str, object]) -> HealthAnswer:
    return HealthAnswer(200 if ok else 503, json.dumps({"ok": ok, **headers}).encode(), "application/json")


def alarm_gauge(count: Mapping[tuple[str, str, str], int]) -> Metric:
    """Return how many alarms of each name, priority and state are not normal."""
    from prometheus_client.core import GaugeMetricFamily

    labels = ["alarm", "priority", "state"]
    alarms = GaugeMetricFamily("servoscope_alarms", "Alarms that are not normal", labels=labels)
    for key, number in count.items():
        alarms.add_metric(list(key), number)
    return alarms


class _HealthServer(ThreadingHTTPServer):
    """Keeps few connections: clients that are slow must not use up threads and files."""

    daemon_threads = True
    request_queue_size = 128  # with the 5 of the base class a burst makes clients wait for seconds

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._open: dict[socket.socket, None] = {}  # the oldest first

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer a connection in a thread."""
        for oldest in list(self._open)[: max(0, len(self._open) + 1 - MAX_CONNECTIONS)]:
            self._open.pop(oldest, None)
            with suppress(OSError):  # it may have ended meanwhile
                oldest.shutdown(socket.SHUT_RDWR)  # its thread reads no further, and closes it
        self._open[request] = None
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        self._open.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a client that has gone."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


def serve_health(report: HealthReport, listen: str) -> ThreadingHTTPServer:
    """Answer on ``host:port`` until ``shutdown`` is called; port 0 takes a free one.

    Raises ConfigError if the address cannot be had.
    """

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        timeout = 10.0  # s: a silent client must not keep its thread for ever

        def do_GET(self) -> None:
            """Answer a request."""
            unknown = HealthAnswer(404, f"{', '.join(HEALTH_PATHS)}\n".encode(), TEXT_TYPE)
            status, body, media_type = report.answer(self.path) or unknown
            self.send_response(status)
            self.send_header("Content-Type", media_type)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            """Keep requests out of the logs."""

    host, _, port = listen.rpartition(":")
    try:
        server = _HealthServer((host.strip("[]"), int(port)), Handler)
    except (OSError, OverflowError) as error:
        why = getattr(error, "strerror", None) or error
        raise ConfigError(f"[service] listen: {listen} cannot be had ({why}), choose another address") from None
    threading.Thread(target=server.serve_forever, name="http", daemon=True).start()
    return server
