"""How far behind pages are with 500 assets at 2 Hz and 20 of them open, and what that costs the server.

    python benchmarks web/load [--seconds 60] [--assets 500] [--pages 20]

A process writes a commit with the status of every asset twice a second into a SQLite store; `servoscope serve` runs on
one core; 20 readers of its events, in a process of their own, take the time from the moment that a status was stored
to the moment that they have it as data. It looks twice a second: a quarter of a second is waiting.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import httpx
import numpy as np

SOURCE = Path(__file__).parents[2] / "src"
RATE = 2.0  # Hz
WARM_S = 5.0
HEAD = b"event: assets\ndata: "
STATUS = {
    "verdict": "healthy",
    "summary": "Healthy: no change found. This recording would have shown changes of p_s by 1.61 % or more.",
    "since": 1.79e9,
    "onset": None,
    "examined": 1.79e9,
    "ne107": "good",
    "reasons": [],
    "quality": {},
    "alarms": {},
    "awaited": [],
    "level": 0.0,
    "exceeded": False,
    "peaks": [0.3, 0.0],
    "residual": [[f, 0.0039496, 0.0193567, 16.4974] for f in (1.0, 10.0, 20.0)],
    "responses": [[f, 0.25818, 1.65752, 0.25775, 1.65770, 4.7e-6, 1e-8, 2.6e-7] for f in (1.0, 10.0, 20.0)],
    "parameters": [[f"theta_{i}", 0.26016864, 3.64e-4, 0.25993328] for i in range(4)],
    "about": {
        "group": "north",
        "loop": "reference rig",
        "plant": "eha",
        "baseline": "5f0890bd1b54cbff",
        "point": None,
        "sample_rate_hz": 100.0,
        "units": ["m", "A"],
        "coefficient_units": ["A/m", "A s/m", "A s²/m", "A s³/m"],
        "faults": {"pump": "less supply pressure", "leakage": "more internal leakage"},
        "window_s": 120.0,
    },
}


def write(path: str, assets: int, seconds: float, answer: Any) -> None:
    """Write a commit twice a second; the statistic of each asset moves. Answer when each was begun, and made."""
    from servoscope.service.store import Batch, Store

    store, rng = Store.open(path, write=True), np.random.default_rng(1)
    begun, state, made = time.monotonic(), b"x" * 8000, {}
    for commit in range(1, round(seconds * RATE) + 1):
        now, batch = time.time(), Batch()
        for i in range(assets):
            counted = {"began": 1.7e9, "t": now, "sequence": commit, "blocks": commit, "samples": 50 * commit}
            counted |= {"lost": 0, "repeated": 0, "digest": 1, "rows": commit // 120}
            name = f"press-{i:04d}"
            status = {**STATUS, "statistic": round(float(rng.chisquare(4)) / 40.0, 6), "t": now, "counted": counted}
            batch.checkpoints[name] = {"asset": name, "sequence": commit, "state": state, "status": status, "at": now}
        store.write(batch, "bench", commit)
        made[now] = time.time()
        time.sleep(max(0.0, begun + commit / RATE - time.monotonic()))
    store.close()
    answer.send(made)


async def read(url: str, until: float, heard: dict[str, Any]) -> None:
    """Be a page: take events as they come, and the time that they took."""
    async with httpx.AsyncClient(timeout=30.0) as client, client.stream("GET", f"{url}/api/v1/live") as stream:
        parts: list[bytes] = []
        async for chunk in stream.aiter_bytes():
            parts.append(chunk)
            if not chunk.endswith(b"\n\n"):
                continue
            now, whole, parts = time.time(), b"".join(parts), []
            for text in whole.split(b"\n\n"):
                if text.startswith(HEAD) and (rows := json.loads(text[len(HEAD) :])["assets"]):
                    heard["at"].append((now, max(row["at"] for row in rows)))
                    heard["bytes"] += len(text)
                    heard["rows"] += len(rows)
            if now > until:
                return


def pages(url: str, count: int, until: float, answer: Any) -> None:
    """Be several pages."""

    async def together() -> None:
        heard: dict[str, Any] = {"at": [], "bytes": 0, "rows": 0}
        await asyncio.gather(*(read(url, until, heard) for _ in range(count)))
        answer.send(heard)

    asyncio.run(together())


def usage(pid: int) -> tuple[float, float]:
    """Return processor time [s] and resident memory [MB] of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    ticks = os.sysconf("SC_CLK_TCK")
    memory = int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return (int(fields[11]) + int(fields[12])) / ticks, memory / 1e6


def timed(url: str) -> float:
    """Return how long an answer takes [s]."""
    begun = time.monotonic()
    httpx.get(url).raise_for_status()
    return time.monotonic() - begun


def measure(seconds: float, assets: int, count: int) -> dict[str, float]:
    """Return what was measured."""
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "bench.sqlite")
        done, wrote = multiprocessing.Pipe()
        writer = multiprocessing.Process(target=write, args=(path, assets, seconds + 3.0 * WARM_S, wrote))
        writer.start()
        time.sleep(WARM_S / 2.0)
        command = [sys.executable, "-m", "servoscope", "serve", "--store", path, "--listen", "127.0.0.1:0"]
        environment = {**os.environ, "PYTHONPATH": str(SOURCE)}
        server = subprocess.Popen(command, cwd=folder, env=environment, stderr=subprocess.PIPE, text=True)
        try:
            os.sched_setaffinity(server.pid, {0})
            assert server.stderr is not None
            url = re.findall(r"(http\S+)/ ", server.stderr.readline())[0]
            time.sleep(WARM_S / 2.0)
            ours, theirs = multiprocessing.Pipe()
            until = time.time() + seconds
            reader = multiprocessing.Process(target=pages, args=(url, count, until, theirs))
            reader.start()
            time.sleep(2.0)
            asked = [timed(f"{url}/api/v1/assets") for _ in range(10)]
            before, memory = usage(server.pid)
            begun = time.monotonic()
            time.sleep(max(1.0, until - time.time() - 2.0))
            after, later = usage(server.pid)
            wall = time.monotonic() - begun
            heard, made = ours.recv(), done.recv()
            reader.join()
        finally:
            server.terminate()
            server.wait()
            writer.terminate()
            writer.join()
    lags = np.array([now - made[at] for now, at in heard["at"]])
    commits = sum(until - seconds < at < until for at in made.values())
    return {
        "assets": assets,
        "pages": count,
        "seconds": seconds,
        "commits per second": commits / seconds,
        "events per page and second": len(lags) / count / seconds,
        "rows per page and second": heard["rows"] / count / seconds,
        "kB per page and second": heard["bytes"] / count / seconds / 1e3,
        "lag, median [s]": float(np.median(lags)),
        "lag, 99 % [s]": float(np.quantile(lags, 0.99)),
        "lag, largest [s]": float(lags.max()),
        "the fleet on request, median [s]": float(np.median(asked)),
        "processor of the server [%]": 100.0 * (after - before) / wall,
        "memory of the server [MB]": later,
        "growth of it [MB]": later - memory,
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--assets", type=int, default=500)
    parser.add_argument("--pages", type=int, default=20)
    said = parser.parse_args()
    for name, value in measure(said.seconds, said.assets, said.pages).items():
        print(f"{name:36}{value:10.4g}")
