"""Services that are killed: a warm process from which each next one is forked, so that a kill costs 0.1 s.

    python tests/carrying.py WHOLE CUT

runs the service of the first file to its end, and reads lines from stdin: each starts the service of the second file
once more and prints its process id; when it ends, its exit code.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from types import TracebackType


class Carrier:
    """Starts services from a warm process; a context manager."""

    def __init__(self, whole: Path, cut: Path) -> None:
        self._configs = whole, cut

    def __enter__(self) -> Carrier:
        command = [sys.executable, __file__, *map(str, self._configs)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(30)

    def start(self) -> int:
        """Start the service; return its process id."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        return int(self._read())

    def wait(self) -> int:
        """Wait until it has ended; return its exit code, negative for a signal."""
        return int(self._read())

    def kill(self, process: int) -> None:
        """Kill it; nothing in it runs any more."""
        os.kill(process, signal.SIGKILL)
        assert self.wait() in (-signal.SIGKILL, 0)

    def _read(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        assert line, "the process that starts the services has died"
        return line


def carry(whole: Path, cut: Path) -> None:
    """Run one service from beginning to end, which warms all up, and fork another one per line of stdin.

    Its process id is printed when it is about to take its first block.
    """
    from servoscope.live import logs
    from servoscope.live.assembling import assemble
    from servoscope.live.config import Config
    from servoscope.live.service import Service

    logs.set_up("error")
    Service(Config.load(whole), assemble(Config.load(whole))).run()
    for _ in sys.stdin:
        child = os.fork()
        if not child:
            settings = Config.load(cut)
            service = Service(settings, assemble(settings))
            print(os.getpid(), flush=True)
            service.run()
            os._exit(0)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


if __name__ == "__main__":
    carry(Path(sys.argv[1]), Path(sys.argv[2]))
