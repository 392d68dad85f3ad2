"""How long pages of 50 assets with a year of sizes take: each answer of the server, and a browser to its first chart.

    python benchmarks web/first_chart [--assets 50] [--looks 10] [--json]

The store is that of years.py. All that the page of an asset asks for is asked for once for each asset, and the fleet
and the alarms as often; then a browser opens the pages of some of the assets, each with an empty cache. A chart is
there when a canvas has something in it. Times are as a reader waits; the processor time of the server tells
more on a busy machine.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import httpx
import numpy as np
from playwright.sync_api import sync_playwright
from tables import Table, parser, show

from web.load import usage
from web.years import PAGE, fill, serve

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
DRAWN = """() => [...document.querySelectorAll("canvas")].some((c) => c.width && c.height
  && c.getContext("2d").getImageData(0, 0, c.width, c.height).data.some(Boolean))"""


def answers(client: httpx.Client, pid: int, assets: int) -> tuple[list[float], list[float]]:
    """Return how long each answer took, and the server's processor time for it [s]."""
    waits, used = [], []
    for number in range(assets):
        own = [f"/assets/axis-{number:03d}{path}" for path in (*PAGE, "/trend?limit=2", "/notes", "/limits")]
        for path in (*own, "/assets", "/alarms"):
            start, before = time.perf_counter(), usage(pid)[0]
            client.get(f"/api/v1{path}").raise_for_status()
            waits.append(time.perf_counter() - start)
            used.append(usage(pid)[0] - before)
    return waits, used


def first_charts(address: str, looks: int) -> tuple[list[float], list[float]]:
    """Return how long a browser takes to the first chart on the pages of some assets, and its processor time [s]."""
    found = next(filter(None, map(shutil.which, BROWSERS)))
    waits, used = [], []
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=found, args=["--no-sandbox", "--disable-dev-shm-usage"])
        for number in range(looks):
            context = browser.new_context(viewport={"width": 1366, "height": 768})
            page = context.new_page()
            metrics = context.new_cdp_session(page)
            metrics.send("Performance.enable")
            start = time.perf_counter()
            page.goto(f"{address}/assets/axis-{number:03d}", wait_until="commit")
            page.wait_for_function(DRAWN, timeout=120000)
            waits.append(time.perf_counter() - start)
            told = {one["name"]: one["value"] for one in metrics.send("Performance.getMetrics")["metrics"]}
            used.append(told["ProcessTime"])
            context.close()
        browser.close()
    return waits, used


def main() -> None:
    """Fill a store, serve it, ask, look, print."""
    command = parser(__doc__)
    command.add_argument("--assets", type=int, default=50)
    command.add_argument("--looks", type=int, default=10)
    given = command.parse_args()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        fill(folder, given.assets)
        pid, address = serve(folder, stack)
        client = stack.enter_context(httpx.Client(base_url=address, timeout=60.0))
        answers(client, pid, 1)  # what the first one imports
        waits, used = answers(client, pid, given.assets)
        first_charts(address, 1)  # the browser's own start
        charts, drawn = first_charts(address, given.looks)
    spread = "{:.2f} s, {:.2f} s, {:.2f} s"
    of = lambda values: spread.format(*np.quantile(values, (0.5, 0.95, 1.0)))  # noqa: E731
    rows = (
        (f"{len(waits)} answers of the server, as a reader waits", of(waits)),
        ("its processor time for each", of(used)),
        (f"{given.looks} pages in a browser to the first chart, as a reader waits", of(charts)),
        ("processor time of the browser's page until then", of(drawn)),
    )
    note = (
        f"{given.assets} assets with a year of a leak and four coefficients; a machine with a load of "
        f"{os.getloadavg()[0]:.1f}. Median, 95 % and largest."
    )
    show([Table("Pages of a year", note, ("what", "value"), rows)], given.json)
