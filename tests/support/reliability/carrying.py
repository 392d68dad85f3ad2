"""Services that are killed: a warm process from which each next one is forked, so that a kill costs 0.1 s.

    python tests/support/reliability/carrying.py WARM

runs the service of this file to its end, and reads lines from stdin, each the name of a file: its service is started
and ``runs`` printed with its process id; when it has ended, ``ended`` with its exit code.
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

    def __init__(self, warm: Path) -> None:
        self._warm = warm

    def __enter__(self) -> Carrier:
        command = [sys.executable, __file__, str(self._warm)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            stream.close()
        self._process.wait(30)

    def start(self, config: Path) -> int:
        """Start the service of a file; return its process id."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{config}\n")
        self._process.stdin.flush()
        return int(self._read("runs"))

    def wait(self) -> int:
        """Wait until it has ended; return its exit code, negative for a signal."""
        return int(self._read("ended"))

    def kill(self, process: int) -> None:
        """Kill it; nothing in it runs any more."""
        os.kill(process, signal.SIGKILL)
        assert self.wait() in (-signal.SIGKILL, 0)

    def _read(self, what: str) -> str:
        assert self._process.stdout is not None
        said = self._process.stdout.readline().split()
        assert said[:1] == [what], f"the process that starts the services says {' '.join(said) or 'nothing'}"
        return said[1]


def carry(warm: Path) -> None:
    """Run one service from beginning to end, which warms all up, and fork another one per line of stdin.

    Its process id is printed when it is about to take its first block.
    """
    from servoscope.service import log
    from servoscope.service.build import build_components
    from servoscope.service.config import ServiceFile
    from servoscope.service.service import Service

    log.set_up_logging("error")
    Service(ServiceFile.load(warm), build_components(ServiceFile.load(warm))).run()
    for line in sys.stdin:
        child = os.fork()
        if not child:
            settings = ServiceFile.load(line.strip())
            service = Service(settings, build_components(settings))
            print("runs", os.getpid(), flush=True)
            service.run()
            os._exit(0)
        print("ended", os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


if __name__ == "__main__":
    carry(Path(sys.argv[1]))
