"""Health and metrics over HTTP, for a supervisor and for Prometheus; no more than that, on loopback by default."""

from __future__ import annotations

import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any

from servoscope.errors import ConfigError

if TYPE_CHECKING:
    from servoscope.live.service import Service

__all__ = ["serve"]

HANGS_S = 30.0  # without a turn: then the service is not alive
TEXT = "text/plain; version=0.0.4; charset=utf-8"


def serve(service: Service, listen: str) -> ThreadingHTTPServer:
    """Answer on ``host:port`` until ``shutdown`` is called; port 0 takes a free one.

    Raises
    ------
    ConfigError
        If the address cannot be had.
    """

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        timeout = 10.0  # s: a client that says nothing must not keep its thread for ever

        def do_GET(self) -> None:
            """Answer."""
            if self.path == "/metrics":
                self._answer(200, service.metrics.text(), TEXT)
            elif self.path == "/health/live":
                age = time.monotonic() - service.beat
                self._say(age < HANGS_S, {"last_turn_s": round(age, 3)})
            elif self.path == "/health/ready":
                self._say(not service.ready, {"why": service.ready})
            else:
                self._answer(404, b"/health/live, /health/ready, /metrics\n", TEXT)

        def _say(self, good: bool, more: dict[str, Any]) -> None:
            body = json.dumps({"ok": good, **more}).encode()
            self._answer(200 if good else 503, body, "application/json")

        def _answer(self, code: int, body: bytes, kind: str) -> None:
            self.send_response(code)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            """Keep requests out of the logs."""

    host, _, port = listen.rpartition(":")
    try:
        server = ThreadingHTTPServer((host.strip("[]"), int(port)), Handler)
    except (OSError, OverflowError) as error:
        why = getattr(error, "strerror", None) or error
        raise ConfigError(f"[service] listen: {listen} cannot be had ({why}), choose another address") from None
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, name="http", daemon=True).start()
    return server
