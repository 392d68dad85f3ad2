"""How fast the pages of an asset are with a year of its sizes in the store, and how large that store is.

    python benchmarks web/years [--assets 50] [--keep FOLDER] [--json]

A leak that grows and the four coefficients of the reference rig, one value every ten minutes for a year, are written
for one asset and thinned as the service does; the other assets get the same rows. Times are of `servoscope serve`, the
medians of nine: as a reader waits, and of its processor, which tells more on a busy machine.
"""

from __future__ import annotations

import copy
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import sqlalchemy as sa
from tables import Table, parser, show

from servoscope.service.store import Batch, Store, tables
from servoscope.service.store.rows import SIZE_EVERY_S, coefficient_rows, fault_rows
from servoscope.service.store.series import thin_sizes
from web import store
from web.load import SOURCE, usage

REPEATS = 9
YEAR_S = 365 * 86400.0
LEAK, STD = 0.35, 0.004  # how far it grows in a year, and how sure each value is
PAGE = ("", "/sizes?of=faults&points=600", "/sizes?of=coefficients&points=600", "/alarms", "/history", "/signals")


def year(now: float) -> list[dict[str, Any]]:
    """Return the rows of one asset, as it would have written them."""
    rng, rows = np.random.default_rng(1), []
    for k, t in enumerate(np.arange(now - YEAR_S, now, SIZE_EVERY_S).tolist()):
        age = (t - now + YEAR_S) / YEAR_S
        day = 0.003 * np.sin(2.0 * np.pi * t / 86400.0)  # of temperature
        leak = 1.05 + LEAK * age**1.3 + day + STD * rng.standard_normal()
        fault = {"name": "leakage", "ratio": leak, "interval": (leak - 1.96 * STD, leak + 1.96 * STD)}
        rows += fault_rows(t, "full" if k % 144 == 0 else "live", [fault])
        noise = 0.002 * rng.standard_normal(4)
        rows += coefficient_rows(t, [(f"theta_{i}", leak + noise[i], 0.002, 1.0) for i in range(4)])
    return rows


def fill(folder: Path, assets: int) -> tuple[int, int, float]:
    """Write the store; return rows of an asset before and after thinning, and how long thinning took [s]."""
    store.prepare(folder)
    known = json.loads((folder / "statuses.json").read_text(encoding="utf-8"))
    one = Store.open(store.FILE, folder, write=True)
    now = known["leaky"]["counted"]["t"]
    rows, batch, names = year(now), Batch(), [f"axis-{i:03d}" for i in range(assets)]
    batch.rows["sizes"] = [{"asset": names[0], **row} for row in rows]
    for i, name in enumerate(names):
        status = copy.deepcopy(known["leaky"])
        batch.checkpoints[name] = {"asset": name, "sequence": i, "state": b"", "status": status, "at": time.time()}
    one.write(batch, "hall", 1)
    start = time.perf_counter()
    thin_sizes(one, names[0], now)
    took = time.perf_counter() - start
    table = tables.sizes
    kept = one.fetch(sa.select(table).where(table.c.asset == names[0]))
    more = Batch()
    more.rows["sizes"] = [{**row, "asset": name} for name in names[1:] for row in kept]
    one.write(more, "hall", 2)
    one.close()
    return len(rows), len(kept), took


def size_of_table(folder: Path) -> float:
    """Return the size of the table of sizes [MB]."""
    only = folder / "sizes.sqlite"
    copied = Store.open(str(folder / store.FILE), folder)
    with copied._engine.connect() as connection:
        connection.exec_driver_sql("ATTACH DATABASE ? AS only", (str(only),))
        connection.exec_driver_sql(
            "CREATE TABLE only.sizes (asset TEXT, t DOUBLE, kind TEXT, name TEXT, value DOUBLE, low DOUBLE,"
            " high DOUBLE, healthy DOUBLE, PRIMARY KEY (asset, t, kind, name)) WITHOUT ROWID"
        )
        connection.exec_driver_sql("INSERT INTO only.sizes SELECT * FROM main.sizes")
        connection.commit()
    copied.close()
    return only.stat().st_size / 1e6


def measure(client: httpx.Client, pid: int, paths: tuple[str, ...]) -> str:
    """Return how long it takes to get all of these, one after the other, and the server's processor time for it."""
    times, used = [], []
    for _ in range(REPEATS):
        start, before = time.perf_counter(), usage(pid)[0]
        for path in paths:
            client.get(f"/api/v1/assets/axis-007{path}").raise_for_status()
        times.append(time.perf_counter() - start)
        used.append(usage(pid)[0] - before)
    return f"{statistics.median(times):.2f} s, {statistics.median(used):.2f} s"


def serve(folder: Path, stack: ExitStack) -> tuple[int, str]:
    """Serve what `fill` has written until the stack ends; return the server's process and address."""
    two = (folder / "two.toml").read_text(encoding="utf-8")
    (folder / "hall.toml").write_text(two.replace("two.sqlite", store.FILE), encoding="utf-8")
    command = [sys.executable, "-m", "servoscope", "serve", "hall.toml", "--listen", "127.0.0.1:0"]
    environment = {**os.environ, "PYTHONPATH": str(SOURCE)}
    server = subprocess.Popen(command, cwd=folder, env=environment, stderr=subprocess.PIPE, text=True)
    stack.callback(lambda: (server.terminate(), server.wait(30)))
    assert server.stderr is not None
    address = next(found[1] for line in server.stderr if (found := re.match(r"servoscope: (https?://\S+)/ ", line)))
    return server.pid, address


def main() -> None:
    """Fill a store, serve it, measure, print."""
    command = parser(__doc__)
    command.add_argument("--assets", type=int, default=50)
    command.add_argument("--keep", type=Path, help="folder that the store is left in, to look at")
    given = command.parse_args()
    with ExitStack() as stack:
        folder = given.keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        before, after, thinning = fill(folder, given.assets)
        pid, address = serve(folder, stack)
        client = stack.enter_context(httpx.Client(base_url=address, timeout=60.0))
        page = measure(client, pid, (*PAGE, "/trend?limit=2"))
        series = measure(client, pid, ("/sizes?of=faults&points=600",))
        trend = measure(client, pid, ("/trend?limit=1.5",))
        rows = (
            ("rows of an asset, as written and thinned", f"{before}, {after}"),
            ("thinning an asset's year at once", f"{thinning:.2f} s"),
            ("store of the series", f"{size_of_table(folder):.0f} MB"),
            ("all that an asset's page asks for, with the forecast", page),
            ("a year of sizes", series),
            ("a year of sizes with the forecast", trend),
        )
    load = os.getloadavg()[0]
    note = (
        f"{given.assets} assets, a leak and four coefficients each, for a year; a machine with a load of {load:.1f}. "
        "Of answers: as a reader waits, and processor time of the server."
    )
    show([Table("A year of sizes", note, ("what", "value"), rows)], given.json)
