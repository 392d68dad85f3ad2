"""A hall of followed assets with its pages, each served by a process of its own, and a browser in front of them."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import halls
import numpy as np

from servoscope.learning.learn import learn_baseline
from servoscope.models.loop import Loop
from servoscope.signals import writers
from servoscope.simulation import FaultEvent

SOURCES = str(Path(__file__).parents[2] / "src")
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SPEED = 4.0
STANDS = 60  # recordings one after the other: long enough for all tests
HEALTHY = ("healthy", "second", "third")


def _well(asset: int) -> list[str]:
    return [HEALTHY[(asset + i) % len(HEALTHY)] for i in range(STANDS)]


# group -> asset -> what it replays
HALL = {
    "Press line": {
        "press-1": ["leaky", *["leaking"] * STANDS],
        "press-2": _well(2),
        "press-3": ["healthy", *["stuck"] * STANDS],
        **{f"press-{i}": _well(i) for i in range(4, 9)},
    },
    "Test rigs": {"rig-1": ["weak", *["weakened"] * STANDS], "rig-2": _well(1), "rig-3": _well(2)},
    "Lifts": {f"lift-{i}": _well(i) for i in range(1, 10)},
}
ASSETS = sum(map(len, HALL.values()))


def browser() -> str | None:
    """Return the system's Chromium, None where there is none."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


def recordings(folder: Path) -> None:
    """Put what the hall replays into a folder: healthy, two faults that begin and that stand, a sensor that sticks."""
    learn_baseline(Loop.load(halls.LOOP), [halls.recorded(7, seconds=120.0)]).save(folder / "baseline.json")
    for seed, name in enumerate(HEALTHY, start=1):
        writers.write_recording(folder / f"{name}.csv", halls.recorded(seed))
    for name, event in {
        "leaky": "C_ie=1.2@20",
        "leaking": "C_ie=1.2@0",
        "weak": "p_s=0.9@35",
        "weakened": "p_s=0.9@0",
    }.items():
        writers.write_recording(folder / f"{name}.csv", halls.recorded(2, FaultEvent.parse(event)))
    healthy = halls.recorded(1)
    writers.write_recording(folder / "stuck.csv", replace(healthy, y=np.where(healthy.t < 3.0, healthy.y, 0.01)))


def hall(folder: Path, *, speed: float = SPEED) -> Path:
    """Write the service file of the hall into a folder that has the `recordings`."""
    parts = [
        'name = "hall"',
        '[service]\nlisten = ""\ncommit_every_s = 0.2\nlog = "error"',
        '[store]\nurl = "history.sqlite"\nresidual_every_s = 2.0',
        "[diagnosis]\nwindow_s = 40.0\nevery_s = 60.0",
        f'[sources.line]\nkind = "replay"\nspeed = {speed}\nblock = {0.25 * speed}',
        '[alarms.fault]\nconsequence = "oil is lost"\noperator_action = "plan an inspection"',
    ]
    for group, assets in HALL.items():
        for name, files in assets.items():
            listed = ", ".join(f'"{file}.csv"' for file in files)
            parts.append(
                f'[assets.{name}]\nbaseline = "baseline.json"\nsource = "line"\ngroup = "{group}"\nfiles = [{listed}]'
            )
    path = folder / "hall.toml"
    path.write_text("\n".join(parts), encoding="utf-8")
    return path


def free_port() -> int:
    """Return a port of the loopback interface that nobody listens on."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@contextmanager
def process(*arguments: object, cwd: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command of servoscope until the end of the block."""
    command = [sys.executable, "-m", "servoscope", *map(str, arguments)]
    environment = os.environ | {"PYTHONPATH": SOURCES}
    with (cwd / f"{arguments[0]}.log").open("wb") as log:
        started = subprocess.Popen(command, cwd=cwd, env=environment, stdout=log, stderr=log, start_new_session=True)
    try:
        yield started
    finally:
        if started.poll() is None:
            started.send_signal(signal.SIGTERM)
            try:
                started.wait(15)
            except subprocess.TimeoutExpired:
                started.kill()
                started.wait()


def asked(base: str, path: str) -> Any:
    """Return what the interface answers."""
    with urllib.request.urlopen(f"{base}/api/v1{path}", timeout=20.0) as answer:
        return json.load(answer)


def until(true: Callable[[], object], patience_s: float = 90.0) -> Any:
    """Wait until something is true, and return it."""
    end = time.monotonic() + patience_s
    while time.monotonic() < end:
        try:
            found = true()
        except OSError:
            found = None
        if found:
            return found
        time.sleep(0.2)
    raise AssertionError("it did not come about")


@contextmanager
def serving(config: Path, *options: object) -> Iterator[str]:
    """Serve a service file's store; return its address."""
    base = f"http://127.0.0.1:{free_port()}"
    with process("serve", config.name, "--listen", base.removeprefix("http://"), *options, cwd=config.parent):
        until(lambda: asked(base, "/session"))
        yield base
