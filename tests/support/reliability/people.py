"""What people do to a service in chaos: commands, relearned baselines, and files of hostile names and clocks."""

from __future__ import annotations

import os
import random
import time
from pathlib import Path

import numpy as np
import sqlalchemy as sa

from reliability.checks import opened
from servoscope.baseline.baseline import Baseline
from servoscope.baseline.records import Revision
from servoscope.core.errors import StoreUnavailableError
from servoscope.service.baselines import announce_baseline
from servoscope.service.config import ServiceFile
from servoscope.service.store.tables import audit, commands

ASSET = "files"  # the asset whose logs fall into the folder
SETTINGS = f"""[sources.share]
kind = "folder"
path = "share"
complete_after_s = 0.5
poll_s = 0.5
[assets.{ASSET}]
baseline = "baseline.json"
source = "share"
"""
HOSTILE = (b"caf\xe9", b"\xff\xfe", b"a\nb", b"\x1b[2J", b"x" * 240, b"'; DROP TABLE audit --", b"\xe2\x80\xae")
ROWS = 200  # of a good file, at 100 Hz
TRIES = 20


class People:
    """Act on the service of a file; `chance`: what they do."""

    def __init__(self, config: Path, names: list[str], chance: random.Random) -> None:
        self._config, self._names, self._chance = config, names, chance
        self._share, self._files, self._next = config.parent / "share", 0, time.time() - 86400.0
        self._share.mkdir()
        self.rows = 0  # of good files

    def drop_files(self) -> None:
        """Put a good file, one that is no log, and one that is two hours ahead, under hostile names."""
        self._put(self._next, ROWS)
        self._next += 0.01 * ROWS
        self.rows += ROWS
        self._put(time.time() + 7200.0, ROWS)
        self._write(b"t,r,u,y\n1,2,\x00x,4\n" * 30)

    def _put(self, began: float, rows: int) -> None:
        values = np.random.default_rng(self._files).normal(size=(rows, 3)).tolist()
        lines = (f"{began + 0.01 * k:.2f},{r},{u},{y}" for k, (r, u, y) in enumerate(values))
        self._write("\n".join(["t,r,u,y", *lines, ""]).encode())

    def _write(self, content: bytes) -> None:
        self._files += 1
        name = self._chance.choice(HOSTILE)[:200] + f"-{self._files:05d}.csv".encode()
        part = self._share / f"{self._files}.part"
        part.write_bytes(content)
        part.rename(self._share / os.fsdecode(name))

    def give_commands(self) -> None:
        """Ask for what may be refused, with hostile words."""
        for command in ("acknowledge", "reset", "remove_from_service", "return_to_service", "no such command"):
            name, store = self._chance.choice(self._names), opened(self._config)
            for _ in range(TRIES):
                try:
                    store.add_command("ann\0\ud800", name, "data_quality", command, reason="\x1b[2J" + "why " * 1000)
                    break
                except StoreUnavailableError:
                    time.sleep(0.5)
            store.close()

    def relearn(self) -> None:
        """Put another baseline of an asset in force."""
        config, name = ServiceFile.load(self._config), self._chance.choice(self._names)
        before = Baseline.load(config.baseline_file(name))
        number = before.revision.number
        revision = Revision(number=number + 1, kind="healthy", who="ann", parent=number, at=time.time())
        renewed = before.model_copy(update={"hash": f"{self._chance.getrandbits(64):016x}", "revision": revision})
        store = opened(self._config)
        for _ in range(TRIES):
            try:
                announce_baseline(config, store, name, number, renewed, time.time())
                break
            except StoreUnavailableError:
                time.sleep(0.5)
        store.close()

    def wait(self, seconds: float) -> None:
        """Wait so long, at most, until files are counted and commands have their outcomes."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            left = self.left()
            if not left["not counted"] and not left["without outcome"]:
                return
            time.sleep(1.0)

    def left(self) -> dict[str, int]:
        """Return what is wrong at the end: rows of files not counted or too many, commands without outcome, ..."""
        store = opened(self._config)
        counted = store.statuses([ASSET])[ASSET]["status"]["counted"]["samples"] if self.rows else 0
        query = sa.select(sa.func.count()).select_from(audit).where(audit.c.what == "row set aside")
        every = sa.select(sa.func.count()).select_from(commands)
        found = {
            "rows of files": self.rows,
            "not counted": self.rows - counted,
            "commands": int(store.fetch_tuples(every)[0][0]),
            "without outcome": len(store.pending_commands()),
            "rows set aside": int(store.fetch_tuples(query)[0][0]),
        }
        store.close()
        return found
