"""Servers of their own for tests and benchmarks, PostgreSQL and Mosquitto: on loopback, started, stopped, crashed."""

from __future__ import annotations

import os
import pwd
import select
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time
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
    def pid(self) -> int:
        """Its first process, while it runs."""
        return int((self.folder / "postmaster.pid").read_text(encoding="utf-8").split()[0])

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


def server_program(name: str) -> Path | None:
    """Return a program that Debian keeps off the path of most users; None where there is none."""
    found = shutil.which(name, path=os.pathsep.join([os.environ.get("PATH", ""), str(Path(os.sep, "usr", "sbin"))]))
    return Path(found) if found else None


def mosquitto() -> Path | None:
    """Return the broker's program; None where there is none."""
    return server_program("mosquitto")


class Mosquitto:
    """A broker; it writes its sessions down once a second, and what is younger is lost when it is killed.

    Parameters
    ----------
    folder
        Where it keeps its sessions.
    program
        What `mosquitto` found.
    more
        More lines of its configuration file.
    port
        Where it listens; None: takes a free one.
    """

    def __init__(self, folder: Path, program: Path, *more: str, port: int | None = None) -> None:
        self._folder, self._program = folder, program
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = port or int(free.getsockname()[1])
        lines = (
            "user root",
            f"persistence true\npersistence_location {folder}/\nautosave_interval 1",
            "max_inflight_messages 1000\nmax_queued_messages 100000\nset_tcp_nodelay true",
            f"listener {self.port} 127.0.0.1",
            *(more or ("allow_anonymous true",)),
        )
        (folder / "mosquitto.conf").write_text("\n".join(lines) + "\n", encoding="utf-8")

    def start(self) -> None:
        """Start it, and wait until it answers."""
        words = [str(self._program), "-c", str(self._folder / "mosquitto.conf")]
        with (self._folder / "log").open("ab") as log:
            self._process = subprocess.Popen(words, stdout=log, stderr=log)
        for _ in range(500):
            with socket.socket() as client:
                if not client.connect_ex(("127.0.0.1", self.port)):
                    return
            time.sleep(0.02)
        raise RuntimeError(f"mosquitto does not answer, see {self._folder / 'log'}")

    @property
    def pid(self) -> int:
        """Its process, while it runs."""
        return self._process.pid

    def stop(self, how: signal.Signals = signal.SIGTERM) -> None:
        """Stop it, or kill it."""
        self._process.send_signal(how)
        self._process.wait(30)


class Cable:
    """A connection to a server on this machine that can be pulled: nothing moves then, and nobody is told.

    Parameters
    ----------
    to
        Port of the server.
    """

    def __init__(self, to: int) -> None:
        self._to = to
        self.pulled = threading.Event()
        self._over = threading.Event()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        """Take it away."""
        self._over.set()
        self._listener.close()

    def _accept(self) -> None:
        while not self._over.is_set():
            try:
                one, _ = self._listener.accept()
            except OSError:
                return
            try:
                other = socket.create_connection(("127.0.0.1", self._to))
            except OSError:
                one.close()
                continue
            threading.Thread(target=self._join, args=(one, other), daemon=True).start()

    def _join(self, one: socket.socket, other: socket.socket) -> None:
        with one, other:
            while not self._over.is_set():
                if self.pulled.is_set():
                    time.sleep(0.05)
                    continue
                for ready in select.select([one, other], [], [], 0.05)[0]:
                    try:
                        data = ready.recv(65536)
                        (other if ready is one else one).sendall(data)
                    except OSError:
                        return
                    if not data:
                        return
