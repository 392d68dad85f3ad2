"""Keeps the server running beside a service, in a process of its own, so that pages hold up no samples."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from importlib.util import find_spec
from pathlib import Path

from servoscope.core.errors import ConfigError
from servoscope.service.log import log

FIRST_WAIT_S, LONGEST_WAIT_S = 1.0, 60.0  # before it is started again
STABLE_S = 60.0  # after which the waits begin anew
STOPS_WITHIN_S = 10.0


class WebSupervisor:
    """Starts ``servoscope serve`` for a service file, and again whenever it ends, until `stop`.

    Raises ConfigError if what the server needs is not installed.
    """

    def __init__(self, config: Path) -> None:
        for module in ("fastapi", "uvicorn", "argon2"):
            if find_spec(module) is None:
                raise ConfigError(f"[web]: {module} is missing, pip install 'servoscope[web]'")
        self._config = config
        self._stop_event = threading.Event()
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._supervise, name="web", daemon=True)

    def start(self) -> None:
        """Start the server."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the server."""
        self._stop_event.set()
        with self._lock:
            process = self._process
            if process is not None and process.stdin is not None:
                process.stdin.close()  # it stops then
        if process is not None:
            try:
                process.wait(STOPS_WITHIN_S)
            except subprocess.TimeoutExpired:
                process.kill()
        self._thread.join()

    def _supervise(self) -> None:
        wait = FIRST_WAIT_S
        while not self._stop_event.is_set():
            start = time.monotonic()
            command = [sys.executable, "-m", "servoscope", "serve", str(self._config), "--with-parent"]
            with self._lock:
                if self._stop_event.is_set():
                    return
                # a session of its own: Ctrl-C in a terminal is for the service, which then ends it
                self._process = process = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)
            code = process.wait()
            if self._stop_event.is_set():
                return
            log("error", "pages ended, they are started again", code=code, seconds=wait)
            wait = FIRST_WAIT_S if time.monotonic() - start > STABLE_S else min(2.0 * wait, LONGEST_WAIT_S)
            self._stop_event.wait(wait)
