"""Let many pages look at many assets, and write the table of benchmarks/STUDIES.md.

    python benchmarks web/run [--assets 500] [--pages 4] [--readers 16] [--seconds 60] [--hour 3600] [--render]

The server has one core to itself; pages in a real browser, readers of the same events without one, and what moves the
assets share the others. Reduced runs are marked as such. --render writes the table from the results that are there;
alone, it measures nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

BENCHMARKS = Path(__file__).resolve().parent.parent
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from playwright.sync_api import Browser, Page, sync_playwright  # noqa: E402
from tables import machine  # noqa: E402

from servoscope.core.files import atomic_write  # noqa: E402
from web import store  # noqa: E402

RESULTS = BENCHMARKS / "web" / "results.json"
PAGE = BENCHMARKS / "STUDIES.md"
SOURCES = str(BENCHMARKS.parent / "src")
RATE = 2.0  # Hz: of the statuses in the store
FULL = {"assets": 500, "pages": 4, "readers": 16, "seconds": 60.0, "hour": 3600.0}
SETTLED = 0.2  # of the hour: by then all that a page keeps a bounded number of is full
SPEEDUP = 20.0  # of the hour: the server looks and tells so many times as often
OF_THE_HOUR = 100  # assets in it, so that one core carries the speed
VIEWS = 7
BUSY = 1.5  # load from which times mean little
# What a page shows is so old [s]; the next row is told half a second after the last.
AGE = "Date.now() / 1000 - Number(document.documentElement.dataset.told)"
COUNT = """
const listen = EventSource.prototype.addEventListener;
window.heard = 0;
EventSource.prototype.addEventListener = function (kind, told) {
  listen.call(this, kind, (event) => { window.heard += kind.startsWith("asset") ? 1 : 0; told(event); });
};
"""
SERVE = "import sys, servoscope.web.event_hub as hub; hub.EVERY_S /= {speed}; from servoscope.cli import main; main()"


READ = """
import sys, threading, urllib.request
def read():
    with urllib.request.urlopen(sys.argv[1]) as told:
        while told.read1(1 << 20): pass
for _ in range(int(sys.argv[2])): threading.Thread(target=read).start()
"""


def load(folder: Path, browser: Browser, assets: int, pages: int, readers: int, seconds: float) -> dict[str, Any]:
    """Open pages on a moving fleet: how old is what they show, and what does the server need for it."""
    with moving(folder, assets, RATE, seconds + 120.0), serving(folder, 1.0) as (server, base):
        views = [first_view(browser, base, assets) for _ in range(VIEWS)]
        opened = [browser.new_context(viewport={"width": 1366, "height": 768}).new_page() for _ in range(pages)]
        for i, page in enumerate(opened):  # one in four looks at an asset
            page.goto(base + ("/assets/axis-000" if i % 4 == 3 else "/"))
            page.locator("html[data-told]").wait_for(state="attached")
        ages: list[list[float]] = [[] for _ in opened]
        with child([sys.executable, "-c", READ, f"{base}/api/v1/live", str(readers)], cores=others()):
            time.sleep(2.0)
            before, begun = processor(server.pid), time.monotonic()
            while time.monotonic() < begun + seconds:
                for page, of in zip(opened, ages, strict=True):
                    of.append(float(page.evaluate(AGE)))
                time.sleep(0.2)
            share = (processor(server.pid) - before) / (time.monotonic() - begun)
            memory = resident(server.pid)
        for page in opened:
            page.context.close()
    with serving(folder, 1.0) as (_, base):  # nothing moves any more
        calm = [first_view(browser, base, assets) for _ in range(VIEWS)]
    half = [len(of) // 2 for of in ages]
    early = statistics.median(age for of, n in zip(ages, half, strict=True) for age in of[:n])
    late = statistics.median(age for of, n in zip(ages, half, strict=True) for age in of[n:])
    every = sorted(age for of in ages for age in of)
    return {
        "first_view_s": round(statistics.median(calm), 3),
        "first_view_moving_s": round(statistics.median(views), 3),
        "first_view_worst_s": round(max(calm), 3),
        "age_first_half_s": round(early, 3),
        "age_second_half_s": round(late, 3),
        "age_99_s": round(every[int(0.99 * (len(every) - 1))], 3),
        "server_share": round(share, 3),
        "server_mb": round(memory),
    }


def hour(folder: Path, browser: Browser, hour_s: float) -> dict[str, Any]:
    """Leave two pages open while an hour of updates passes: what they hold after a fifth of it, and at the end."""
    found: dict[str, Any] = {}
    wall = hour_s / SPEEDUP
    with moving(folder, OF_THE_HOUR, RATE * SPEEDUP, wall + 60.0), serving(folder, SPEEDUP) as (_, base):
        context = browser.new_context(viewport={"width": 1366, "height": 768})
        pages = {"fleet": context.new_page(), "asset": context.new_page()}
        for name, page in pages.items():
            page.add_init_script(COUNT)
            page.goto(base + ("/" if name == "fleet" else "/assets/axis-000"))
            page.locator("html[data-told]").wait_for(state="attached")
        time.sleep(SETTLED * wall)
        early = {name: held(page) for name, page in pages.items()}
        time.sleep((1.0 - SETTLED) * wall)
        late = {name: held(page) for name, page in pages.items()}
        for name, page in pages.items():
            found[name] = {"early": early[name], "late": late[name], "updates": page.evaluate("window.heard")}
        context.close()
    return found


def first_view(browser: Browser, base: str, assets: int) -> float:
    """Return the seconds from asking for the address until all assets stand there, with an empty cache."""
    context = browser.new_context(viewport={"width": 1366, "height": 768})
    page = context.new_page()
    begun = time.monotonic()
    page.goto(base, wait_until="commit")
    page.locator(".rows .line").nth(assets - 1).wait_for(state="attached")
    took = time.monotonic() - begun
    context.close()
    return took


def held(page: Page) -> dict[str, float]:
    """Return what a page holds after its garbage was collected: heap [MB], elements, listeners."""
    tool = page.context.new_cdp_session(page)
    tool.send("HeapProfiler.collectGarbage")
    heap = tool.send("Runtime.getHeapUsage")["usedSize"] / 1e6
    counted = tool.send("Memory.getDOMCounters")
    tool.detach()
    return {"mb": round(heap, 2), "nodes": counted["nodes"], "listeners": counted["jsEventListeners"]}


@contextmanager
def moving(folder: Path, assets: int, rate: float, seconds: float) -> Iterator[None]:
    """Let the statuses of assets move in a new store."""
    for path in folder.glob(f"{store.FILE}*"):
        path.unlink()
    command = [sys.executable, str(BENCHMARKS / "web"), "store", str(folder), str(assets), str(rate), str(seconds)]
    with child(command, cores=others()):
        while not (folder / store.FILE).exists():
            time.sleep(0.1)
        time.sleep(2.0)
        yield


@contextmanager
def serving(folder: Path, speed: float) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """Serve the store on a core of its own; return the process and its address."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    command = [sys.executable, "-c", SERVE.format(speed=speed), "serve", "--store", store.FILE, "--listen", address]
    with child(command, cores={min(os.sched_getaffinity(0))}, cwd=folder) as server:
        for _ in range(600):
            try:
                urllib.request.urlopen(f"http://{address}/health/live", timeout=1.0).close()
                break
            except OSError:
                time.sleep(0.1)
        yield server, f"http://{address}"


@contextmanager
def child(command: list[str], cores: set[int], cwd: Path | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """Run a process on some cores until the end of the block."""
    environment = os.environ | {"PYTHONPATH": SOURCES}
    quiet = subprocess.DEVNULL
    started = subprocess.Popen(command, cwd=cwd, env=environment, stdout=quiet, stderr=quiet)
    os.sched_setaffinity(started.pid, cores)
    try:
        yield started
    finally:
        started.terminate()
        started.wait(30)


def others() -> set[int]:
    """Return the cores that the server leaves to everybody else."""
    cores = os.sched_getaffinity(0)
    return cores - {min(cores)} or cores


def processor(process: int) -> float:
    """Return the seconds of processor time that a process has used."""
    fields = Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def resident(process: int) -> float:
    """Return the memory of a process [MB]."""
    pages = int(Path(f"/proc/{process}/statm").read_text(encoding="utf-8").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def markdown(found: dict[str, Any]) -> str:
    """Return the table of the docs."""
    settings, loaded, left = found["settings"], found["load"], found["hour"]
    reduced = "" if all(settings[key] >= FULL[key] for key in FULL) else " **A reduced run: to be repeated in full.**"
    busy = f" **The machine was busy (load {found['busy']}): to be repeated.**" if found["busy"] >= BUSY else ""
    rows = [
        ("assets, each moving twice a second", f"{settings['assets']}"),
        (
            "pages open in a browser, one in four on an asset; readers of the same events",
            f"{settings['pages']}; {settings['readers']}",
        ),
        (
            "first view of the fleet, empty cache: median, worst",
            f"{loaded['first_view_s']} s, {loaded['first_view_worst_s']} s",
        ),
        (
            "the same while all move and the browser shares its core with what moves them",
            f"{loaded['first_view_moving_s']} s",
        ),
        (
            "age of what a page shows: median in the first half, in the second",
            f"{loaded['age_first_half_s']} s, {loaded['age_second_half_s']} s",
        ),
        ("the same, 99 %", f"{loaded['age_99_s']} s"),
        ("server: share of its one core, memory", f"{100 * loaded['server_share']:.0f} %, {loaded['server_mb']} MB"),
    ]
    for name, one in left.items():
        early, late = one["early"], one["late"]
        words = f"{early['mb']} MB, {early['nodes']} nodes; {late['mb']} MB, {late['nodes']} nodes"
        rows.append((f"{name} page after a fifth of an hour's updates; after all {one['updates']}", words))
    table = "\n".join(f"| {what} | {value} |" for what, value in rows)
    return f"{found['machine']}.{reduced}{busy}\n\n| | |\n|---|---|\n{table}"


def render() -> None:
    """Write the table between its markers on the page."""
    found = json.loads(RESULTS.read_text(encoding="utf-8"))
    marked = re.compile("<!-- load -->.*?<!-- end of load -->", re.DOTALL)
    page = PAGE.read_text(encoding="utf-8")
    if not marked.search(page):
        sys.exit(f"{PAGE}: markers <!-- load --> and <!-- end of load --> are missing")
    text = marked.sub(lambda _: f"<!-- load -->\n\n{markdown(found)}\n\n<!-- end of load -->", page)
    atomic_write(PAGE, text.encode())


def main() -> None:
    """Measure, and write down."""
    command = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    for name, value in FULL.items():
        command.add_argument(f"--{name}", type=type(value), default=value)
    command.add_argument("--render", action="store_true", help="write the table of the docs from the results")
    given = command.parse_args()
    settings = {name: getattr(given, name) for name in FULL}
    if not given.render or settings != FULL:
        busy = round(os.getloadavg()[0], 1)
        chromium = shutil.which("chromium") or sys.exit("chromium is missing: scripts/install-test-servers installs it")
        with tempfile.TemporaryDirectory() as name, sync_playwright() as driver:
            store.prepare(Path(name))
            server_core = {min(os.sched_getaffinity(0))}
            os.sched_setaffinity(0, others())  # the browser too, which is started now
            browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
            os.sched_setaffinity(0, others() | server_core)
            load_ = load(Path(name), browser, given.assets, given.pages, given.readers, given.seconds)
            hour_ = hour(Path(name), browser, given.hour)
            browser.close()
        found = {"machine": machine(), "busy": busy, "settings": settings, "load": load_, "hour": hour_}
        atomic_write(RESULTS, (json.dumps(found, indent=1) + "\n").encode())
        print(json.dumps(found, indent=1))
    if given.render:
        render()
