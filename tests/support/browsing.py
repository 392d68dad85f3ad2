"""Servers as processes of their own, and clients that talk to them as a browser would."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import httpx

SOURCE = Path(__file__).parents[2] / "src"
FOUND = re.compile(r"servoscope: (https?://\S+(?=/ )|unix:\S+)")


class Served:
    """A command that serves pages; a context manager."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self._folder, self._arguments = folder, arguments
        self.url = ""

    def __enter__(self) -> Served:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "servoscope", *self._arguments],
            cwd=self._folder,
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(SOURCE), os.environ.get("PYTHONPATH", "")])},
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._process.stderr is not None
        said = []
        for line in self._process.stderr:
            said.append(line)
            if found := FOUND.match(line):
                self.url, self.said = found[1], line
                return self
        raise AssertionError("".join(said))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.send_signal(signal.SIGTERM)
        assert self._process.stderr is not None
        with self._process.stderr as rest:
            self.log = rest.read()
        self._process.wait(30)

    @property
    def pid(self) -> int:
        return self._process.pid

    def client(self, **more: Any) -> httpx.Client:
        """Return a client of the interface."""
        return httpx.Client(base_url=f"{self.url}/api/v1", timeout=60.0, **more)


def login(client: httpx.Client, user: str, password: str) -> httpx.Response:
    """Log in; what changes something is let pass from then on."""
    said = client.post("/session", json={"user": user, "password": password})
    if said.is_success:
        client.headers["X-CSRF-Token"] = said.json()["csrf"]
    return said


def events(response: httpx.Response) -> Iterator[tuple[str, str]]:
    """Yield kind and data of server-sent events."""
    kind = ""
    for line in response.iter_lines():
        if line.startswith("event: "):
            kind = line.removeprefix("event: ")
        elif line.startswith("data: "):
            yield kind, line.removeprefix("data: ")


def finished(client: httpx.Client, asked: httpx.Response) -> dict[str, Any]:
    """Return a job when it has ended."""
    assert asked.status_code == 202, asked.text
    job: dict[str, Any] = asked.json()
    while job["state"] in ("queued", "running"):
        job = client.get(f"/jobs/{job['id']}", params={"wait": 20}).raise_for_status().json()
    return job


def upload(client: httpx.Client, name: str, content: bytes) -> httpx.Response:
    """Send a file."""
    kind = {"Content-Type": "application/octet-stream"}
    return client.post("/uploads", params={"name": name}, content=content, headers=kind)
