"""The server beside a running service, in a process of its own: samples never wait for it, it ends with the service."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from importlib.util import find_spec
from pathlib import Path

from servoscope.errors import ConfigError
from servoscope.live.logs import log

__all__ = ["Beside"]

FIRST_WAIT_S, LONGEST_WAIT_S = 1.0, 60.0  # before it is started again
STEADY_S = 60.0  # after which it is said to have run
STOPS_WITHIN_S = 10.0


class Beside:
    """Starts ``servoscope serve`` for a service file, again where it ends, until `stop`.

    Parameters
    ----------
    config
        The service file.

    Raises
    ------
    ConfigError
        If what the server needs is not installed.
    """

    def __init__(self, config: Path) -> None:
        for module in ("fastapi", "uvicorn", "argon2"):
            if find_spec(module) is None:
                raise ConfigError(f"[web]: {module} is missing, pip install 'servoscope[web]'")
        self._config = config
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._keep, name="web", daemon=True)

    def start(self) -> None:
        """Start it."""
        self._thread.start()

    def stop(self) -> None:
        """Stop it."""
        self._stopping.set()
        with self._lock:
            process = self._process
            if process is not None and process.stdin is not None:
                process.stdin.close()  # it reads that as the end
        if process is not None:
            try:
                process.wait(STOPS_WITHIN_S)
            except subprocess.TimeoutExpired:
                process.kill()
        self._thread.join()

    def _keep(self) -> None:
        wait = FIRST_WAIT_S
        while not self._stopping.is_set():
            begun = time.monotonic()
            command = [sys.executable, "-m", "servoscope", "serve", str(self._config), "--with-parent"]
            with self._lock:
                if self._stopping.is_set():
                    return
                # a session of its own: Ctrl-C in a terminal is for the service, which then ends it
                self._process = process = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)
            code = process.wait()
            if self._stopping.is_set():
                return
            log("error", "pages ended, they are started again", code=code, seconds=wait)
            wait = FIRST_WAIT_S if time.monotonic() - begun > STEADY_S else min(2.0 * wait, LONGEST_WAIT_S)
            self._stopping.wait(wait)
