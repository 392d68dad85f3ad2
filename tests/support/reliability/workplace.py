"""Where a trial runs: a folder, a small disk, a store, what can happen to these, and free ports."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from reliability.servers import Postgres, programs
from reliability.trial import Disturbance

DISK_MB = 256
DISK_MB_OF_ASSET_HOUR = 0.25  # rows and their log; the disk must be full only when it is filled on purpose


@contextmanager
def workplace(asset_hours: float) -> Iterator[tuple[Path, Path | None]]:
    """Make a folder, and a small disk in memory, which only root can: None where that is not possible."""
    folder = Path(tempfile.mkdtemp(prefix="servoscope-reliability-"))
    disk = folder / "disk"
    disk.mkdir()
    size = f"size={DISK_MB + round(DISK_MB_OF_ASSET_HOUR * asset_hours)}m"
    mounted = (
        not os.geteuid()
        and not subprocess.run(
            ["mount", "-t", "tmpfs", "-o", size, "none", str(disk)], capture_output=True, check=False
        ).returncode
    )
    try:
        yield folder, disk if mounted else None
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(disk)], check=False)
        shutil.rmtree(folder)


@contextmanager
def database(name: str, disk: Path | None) -> Iterator[tuple[str, list[Disturbance]]]:
    """Make a store, and what can happen to it beside kills of the service."""
    kill = Disturbance("kill -9", nothing, nothing, 0.0, kills=True)
    if name == "sqlite":
        if disk is None:
            print("no disk of its own can be mounted here: the disk is not filled", file=sys.stderr)
            yield "fleet.sqlite", [kill]
        else:
            ballast = disk / "ballast"
            full = Disturbance("full disk", lambda: fill(ballast), ballast.unlink, 4.0)
            yield str(disk / "fleet.sqlite"), [kill, kill, full]
        return
    found = programs()
    if found is None:
        sys.exit("PostgreSQL is not on this machine: scripts/install-test-servers installs it")
    server = Postgres.temporary(found)
    server.start()
    try:
        crash = Disturbance("database crash", lambda: server.stop("immediate"), server.start, 2.0)
        yield server.url, [kill, kill, crash]
    finally:
        server.remove()


def nothing() -> None:
    """Do nothing."""


def fill(path: Path) -> None:
    """Write until the disk is full."""
    chunk = bytes(2**16)
    with path.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(chunk)
        except OSError:
            return


def free_port() -> int:
    """Return a port that nobody has."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])
