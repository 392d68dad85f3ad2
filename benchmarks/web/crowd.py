"""Whether health and pages are answered while a crowd reads events, and while slow clients hold half-sent headers.

    python benchmarks web/crowd [--readers 1000] [--slow 1500] [--seconds 30] [--assets 50] [--json]

A process writes the status of every asset twice a second; `servoscope serve` has a login and the setting
`connections_per_address` as it is by default. The readers log in once and come from as many addresses of the loopback
network as that takes; the slow clients come from one address more, and send a header that never ends.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import re
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from tables import Table, parser, show

from web import store
from web.load import RATE, SOURCE, usage

PER_ADDRESS = 80
PASSWORD = "correct horse battery"
HALF = b"GET / HTTP/1.1\r\nHost: localhost\r\n"
WAIT_S = 120.0  # for all readers to be let in


async def read_events(url: str, source: str, cookie: str, seen: dict[str, Any]) -> None:
    """Read events for good; count them and their bytes."""
    host, port = url.removeprefix("http://").split(":")
    reader, writer = await asyncio.open_connection(host, int(port), local_addr=(source, 0))
    try:
        writer.write(f"GET /api/v1/live HTTP/1.1\r\nHost: {host}\r\nCookie: {cookie}\r\n\r\n".encode())
        head = await reader.readuntil(b"\r\n\r\n")
        seen["statuses"].append(int(head.split()[1]))
        while data := await reader.read(1 << 16):
            seen["bytes"] += len(data)
            seen["events"] += data.count(b"event: assets")
        seen["ended"] += 1
    finally:
        writer.close()


def be_readers(url: str, cookie: str, count: int, pipe: Any) -> None:
    """Read with many connections until the other end of the pipe says so; then answer what was seen."""

    async def together() -> dict[str, Any]:
        seen: dict[str, Any] = {"statuses": [], "bytes": 0, "events": 0, "ended": 0}
        sources = [f"127.0.1.{1 + k // PER_ADDRESS}" for k in range(count)]
        tasks = [asyncio.create_task(read_events(url, source, cookie, seen)) for source in sources]
        start = time.monotonic()
        while len(seen["statuses"]) < count and time.monotonic() < start + WAIT_S:
            await asyncio.sleep(0.1)
        pipe.send(seen["statuses"].count(200))
        seen |= {"bytes": 0, "events": 0}
        start = time.monotonic()
        await asyncio.to_thread(pipe.recv)
        seen["seconds"] = time.monotonic() - start
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        return seen

    pipe.send(asyncio.run(together()))


def be_slow(url: str, count: int, pipe: Any) -> None:
    """Hold half-sent headers, and replace those that are closed, until the other end of the pipe says so."""

    async def hold(address: tuple[str, int]) -> None:
        while True:
            try:
                reader, writer = await asyncio.open_connection(*address, local_addr=("127.0.2.1", 0))
                writer.write(HALF)
                await reader.read()
                writer.close()
            except OSError:
                pass
            await asyncio.sleep(1.0)

    async def together() -> None:
        host, port = url.removeprefix("http://").split(":")
        tasks = [asyncio.create_task(hold((host, int(port)))) for _ in range(count)]
        await asyncio.to_thread(pipe.recv)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    asyncio.run(together())


def ask(url: str, seconds: float, cookie: str = "") -> np.ndarray[Any, Any]:
    """Return how long answers take, one after the other, with a connection for each [s]; one that fails raises."""
    times, until = [], time.monotonic() + seconds
    while time.monotonic() < until:
        start = time.monotonic()
        with urllib.request.urlopen(urllib.request.Request(url, headers={"Cookie": cookie}), timeout=30.0) as answer:
            answer.read()
        times.append(time.monotonic() - start)
        time.sleep(0.2)
    return np.array(times)


def start_server(folder: str) -> tuple[subprocess.Popen[str], str]:
    """Return a server with a login, and its address."""
    environment = {**os.environ, "PYTHONPATH": str(SOURCE)}
    command = [sys.executable, "-m", "servoscope"]
    add = [*command, "users", "add", "vera", "--password-stdin"]
    subprocess.run(add, cwd=folder, env=environment, input=f"{PASSWORD}\n", text=True, check=True, capture_output=True)
    serve = [*command, "serve", "--store", store.FILE, "--users", "users.json", "--listen", "127.0.0.1:0"]
    server = subprocess.Popen(serve, cwd=folder, env=environment, stderr=subprocess.PIPE, text=True)
    assert server.stderr is not None
    return server, re.findall(r"(http\S+)/ ", server.stderr.readline())[0]


def log_in(url: str) -> str:
    """Return the cookie of a session."""
    answer = httpx.post(f"{url}/api/v1/session", json={"user": "vera", "password": PASSWORD}, timeout=30.0)
    answer.raise_for_status()
    return answer.headers["set-cookie"].split(";")[0]


def measure(readers: int, slow: int, seconds: float, assets: int) -> dict[str, Any]:
    """Return what was measured."""
    with tempfile.TemporaryDirectory() as folder:
        store.prepare(Path(folder))
        writer = multiprocessing.Process(target=store.move, args=(Path(folder), assets, RATE, 4.0 * seconds + WAIT_S))
        writer.start()
        while not (Path(folder) / store.FILE).exists():
            time.sleep(0.1)
        server, url = start_server(folder)
        crowd: list[multiprocessing.Process] = []
        try:
            cookie = log_in(url)
            alone = ask(f"{url}/health/live", min(seconds, 5.0))
            ours, theirs = multiprocessing.Pipe()
            crowd.append(multiprocessing.Process(target=be_readers, args=(url, cookie, readers, theirs)))
            crowd[-1].start()
            admitted = ours.recv()
            before = usage(server.pid)[0]
            health = ask(f"{url}/health/live", seconds)
            share = (usage(server.pid)[0] - before) / seconds
            fleet = ask(f"{url}/api/v1/assets", min(seconds, 10.0), cookie)
            stop, stopped = multiprocessing.Pipe()
            crowd.append(multiprocessing.Process(target=be_slow, args=(url, slow, stopped)))
            crowd[-1].start()
            time.sleep(3.0)
            beset = ask(f"{url}/health/live", seconds)
            memory = usage(server.pid)[1]
            stop.send(None)
            ours.send(None)
            seen = ours.recv()
        finally:
            for process in (*crowd, writer):
                process.terminate()
            server.terminate()
            server.wait()
    return {
        "readers that were let in, of": f"{admitted} of {readers}",
        "readers that were dropped": seen["ended"],
        "events per reader and second": seen["events"] / readers / seen["seconds"],
        "health alone: median, longest [s]": span(alone),
        "health beside the readers: median, longest [s]": span(health),
        "list of assets beside the readers: median, longest [s]": span(fleet),
        f"health beside {slow} slow clients too: median, longest [s]": span(beset),
        "processor of the server [%]": 100.0 * share,
        "memory of the server [MB]": memory,
    }


def span(times: np.ndarray[Any, Any]) -> str:
    """Return median and longest of some times."""
    return f"{np.median(times):.3f}, {times.max():.3f}"


def main() -> None:
    """Measure and print."""
    options = parser(__doc__)
    options.add_argument("--readers", type=int, default=1000)
    options.add_argument("--slow", type=int, default=1500)
    options.add_argument("--seconds", type=float, default=30.0)
    options.add_argument("--assets", type=int, default=50)
    given = options.parse_args()
    measured = measure(given.readers, given.slow, given.seconds, given.assets)
    rows = [(name, f"{value:.3g}" if isinstance(value, float) else str(value)) for name, value in measured.items()]
    show([Table("Crowd", "", ("measured", "value"), tuple(rows))], given.json)
