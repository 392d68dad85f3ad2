"""Who keeps processes running: we one beside this, started again when it ends, and systemd this one."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress

from servoscope.service.log import log

MIN_WAIT_S, MAX_WAIT_S = 1.0, 60.0  # before it is started again
STABLE_S = 60.0  # after which the waits begin anew


class ProcessSupervisor:
    """Starts ``servoscope`` with the arguments that `command` returns, again whenever it ends, until `stop`.

    The process ends when its stdin does: so it does not outlive this one, however that ends. `name`: what the log calls
    it; `may_end`: whether one that ends with code 0 is done; `says`: takes the first line that it prints; `files`:
    open files that it inherits; `stops_within_s`: how long it may take to end before it is killed [s].
    """

    def __init__(
        self,
        name: str,
        command: Callable[[], Sequence[str]],
        *,
        may_end: bool = False,
        says: Callable[[str], None] | None = None,
        files: Collection[int] = (),
        stops_within_s: float = 10.0,
    ) -> None:
        self.name, self._command, self._may_end, self._says = name, command, may_end, says
        self._files, self._stops_within_s = files, stops_within_s
        self._stop_event = threading.Event()
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._supervise, name=name, daemon=True)

    def start(self) -> None:
        """Start the process."""
        self._thread.start()

    @property
    def done(self) -> bool:
        """Whether there will be no further process."""
        return not self._thread.is_alive()

    def send_signal(self, number: int) -> None:
        """Send a signal to the process, if there is one."""
        with self._lock:
            if self._process is not None:
                self._process.send_signal(number)

    def ask_to_stop(self) -> None:
        """Let the process end, and start no other."""
        self._stop_event.set()
        with self._lock:
            if self._process is not None and self._process.stdin is not None:
                with suppress(OSError):
                    self._process.stdin.close()

    def stop(self) -> None:
        """Let the process end, and wait for that."""
        self.ask_to_stop()
        if self._process is not None:
            try:
                self._process.wait(self._stops_within_s)
            except subprocess.TimeoutExpired:
                self._process.kill()
        self._thread.join()

    def _supervise(self) -> None:
        wait = MIN_WAIT_S
        while not self._stop_event.is_set():
            start = time.monotonic()
            command = [sys.executable, "-m", "servoscope", *self._command()]
            output = None if self._says is None else subprocess.PIPE
            # systemd hears of this process alone
            environment = {key: value for key, value in os.environ.items() if key != "NOTIFY_SOCKET"}
            with self._lock:
                if self._stop_event.is_set():
                    return
                # a session of its own: Ctrl-C in a terminal is for the service, which then ends it
                self._process = process = subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,
                    stdout=output,
                    start_new_session=True,
                    pass_fds=tuple(self._files),
                    env=environment,
                )
            if process.stdout is not None and self._says is not None:
                self._says(process.stdout.readline().decode().strip())
                process.stdout.read()  # until it ends
                process.stdout.close()
            code = process.wait()
            with self._lock, suppress(OSError):
                if process.stdin is not None:
                    process.stdin.close()
            if self._stop_event.is_set() or (self._may_end and not code):
                return
            log("error", f"{self.name} ended, started again soon", code=code, seconds=wait)
            wait = MIN_WAIT_S if time.monotonic() - start > STABLE_S else min(2.0 * wait, MAX_WAIT_S)
            self._stop_event.wait(wait)


def call_at_end_of_stdin(stop: Callable[[], None]) -> None:
    """Call a function when stdin ends: a process that a `ProcessSupervisor` has started is to stop then."""

    def wait() -> None:
        while os.read(sys.stdin.fileno(), 4096):
            pass
        stop()

    threading.Thread(target=wait, name="parent", daemon=True).start()


def notify_systemd(*lines: str) -> None:
    """Send lines such as ``READY=1``, as sd_notify(3) says; without systemd nothing happens."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    path = "\0" + address[1:] if address.startswith("@") else address
    # a supervisor that does not listen must not stop the service
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
        sender.setblocking(False)
        sender.sendto("\n".join(lines).encode(), path)
