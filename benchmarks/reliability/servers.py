"""A PostgreSQL server of its own for tests and benchmarks: on loopback, started, stopped, crashed."""

from __future__ import annotations

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from pathlib import Path


def programs() -> Path | None:
    """Return the folder of PostgreSQL's programs, which Debian keeps off the path; None where there is none."""
    found = sorted(Path(os.sep, "usr", "lib", "postgresql").glob("*/bin/initdb"))
    on_path = shutil.which("initdb")
    return found[-1].parent if found else Path(on_path).parent if on_path else None


class Postgres:
    """A server with one database; nobody but this machine can reach it.

    Parameters
    ----------
    folder
        Where it keeps its data.
    programs
        Folder of ``initdb`` and ``pg_ctl``.
    """

    def __init__(self, folder: Path, programs: Path) -> None:
        self.folder, self._programs = folder, programs
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]

    @property
    def url(self) -> str:
        """What a service file says of it."""
        return f"postgresql://servoscope@127.0.0.1:{self.port}/postgres"

    @classmethod
    def temporary(cls, programs: Path) -> Postgres:
        """Make one in a folder of its own, which another user than root can enter."""
        server = cls(Path(tempfile.mkdtemp(prefix="servoscope-postgres-")), programs)
        server.make()
        return server

    def remove(self) -> None:
        """Stop it, and remove its data."""
        self.stop("immediate")
        shutil.rmtree(self.folder)

    def make(self) -> None:
        """Make its data in its folder, which is empty."""
        if os.geteuid() == 0:
            shutil.chown(self.folder, *self._user)
        self._call("initdb", "-D", str(self.folder), "-U", "servoscope", "-A", "trust", "-E", "UTF8", "--no-sync")

    def start(self) -> None:
        """Start it, and wait until it answers."""
        options = f"-p {self.port} -h 127.0.0.1 -k {self.folder}"
        log = str(self.folder / "log")
        self._call("pg_ctl", "-D", str(self.folder), "-w", "-t", "30", "-l", log, "-o", options, "start")

    def stop(self, mode: str = "fast") -> None:
        """Stop it; in mode ``immediate`` as if it had crashed."""
        self._call("pg_ctl", "-D", str(self.folder), "-w", "-m", mode, "stop")

    @property
    def _user(self) -> tuple[int, int]:
        """User and group that it runs as: PostgreSQL refuses to run as root."""
        try:
            entry = pwd.getpwnam("postgres")
        except KeyError:
            entry = pwd.getpwnam("nobody")
        return entry.pw_uid, entry.pw_gid

    def _call(self, program: str, *words: str) -> None:
        command = [str(self._programs / program), *words]
        if os.geteuid() == 0:
            user, group = self._user
            done = subprocess.run(
                command, cwd="/", user=user, group=group, extra_groups=[], capture_output=True, text=True, timeout=60
            )
        else:
            done = subprocess.run(command, cwd="/", capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, f"{program}: {done.stdout}{done.stderr}"
