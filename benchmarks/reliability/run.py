"""Let the service run through a day of 200 assets in minutes, disturb it, and write docs/reliability.md.

    python benchmarks/reliability/run.py [sqlite|postgresql ...] [--hours 24] [--assets 200] [--speed 40] [--render]

Everything is on this machine: the full disk is a file system in memory, and the database a server of its own, on
loopback. --render writes the tables from the results that are there; together with names, after running them.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

BENCHMARKS = Path(__file__).resolve().parent.parent
sys.path[0] = str(BENCHMARKS)  # where `reliability` is a package, and `tables` lies
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from tables import machine  # noqa: E402

from reliability.checks import check  # noqa: E402
from reliability.fleet import BLOCK_S, Fleet  # noqa: E402
from reliability.servers import Postgres, programs  # noqa: E402
from reliability.trial import Disturbance, Measured, Trial, quantile  # noqa: E402
from servoscope.core.files import atomic_write  # noqa: E402
from servoscope.service import log  # noqa: E402
from servoscope.service.metrics import BUCKETS_S  # noqa: E402

RESULTS = BENCHMARKS / "reliability" / "results"
PAGE = BENCHMARKS.parent / "docs" / "reliability.md"
TRIALS = ("sqlite", "postgresql")
COMPARED = 10  # assets that are run once more without disturbance
CALM = 0.25  # share of the run at the end that is left in peace
EVERY_S = 25.0  # mean time between disturbances
FULL_DAY = 24.0 * 200
DISK_MB = 256
DISK_MB_OF_ASSET_HOUR = 0.25  # rows and their log; the disk must be full only when it is filled on purpose
BUSY = 1.0  # load from which times mean little


def trial(name: str, fleet_of: tuple[int, float, float], every_s: float, seed: int = 1) -> dict[str, Any]:
    """Run one trial, of so many assets, hours and times the true speed; return what was measured, ready for JSON."""
    load = round(os.getloadavg()[0], 1)
    with workplace(fleet_of[0] * fleet_of[1]) as (folder, disk):
        fleet = Fleet(folder, *fleet_of)
        fleet.make()
        port = free_port()
        blocks = sum(blocks for blocks, *_ in fleet.expected().values())
        with database(name, disk) as (url, disturbances):
            config = fleet.config("fleet", url, f"127.0.0.1:{port}", fleet.names, fleet.speed)
            measured = Trial(config, port, disturbances, every_s, CALM, blocks, seed).run()
            compared = fleet.names[:: max(1, fleet.assets // COMPARED)]
            found = check(fleet, config, compared)
    return {
        "name": name,
        "machine": machine(),
        "settings": {**settings_of(fleet, seed), "load": load},
        **told(measured),
        **asdict(found),
    }


def settings_of(fleet: Fleet, seed: int) -> dict[str, Any]:
    """Return what a trial was made with."""
    return {"hours": fleet.hours, "assets": fleet.assets, "speed": fleet.speed, "block_s": BLOCK_S, "seed": seed}


def told(measured: Measured) -> dict[str, Any]:
    """Return what was seen from outside, ready for JSON."""
    seen = measured.memory
    life = seen[-1][0] - seen[0][0]
    settled = [size for at, size in seen if at - seen[0][0] > 0.3 * life]
    fifth = max(1, len(settled) // 5)
    early, late = (sum(part) / len(part) for part in (settled[:fifth], settled[-fifth:]))
    return {
        "seconds": round(measured.seconds, 1),
        "lives": measured.lives,
        "recoveries": {name: [round(one, 2) for one in times] for name, times in measured.recoveries.items()},
        "latency_s": {
            state: {f"p{share:g}": quantile(buckets, share / 100.0) for share in (50.0, 99.0)}
            for state, buckets in (
                ("undisturbed", measured.latencies.calm),
                ("disturbed", measured.latencies.disturbed),
            )
        },
        "memory": {"early_mb": round(early, 1), "late_mb": round(late, 1), "over_s": round(0.7 * life, 1)},
    }


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


def render() -> None:
    """Write the tables of all results between their markers on the page."""
    page = PAGE.read_text(encoding="utf-8")
    paths = [RESULTS / f"{name}{part}.json" for part in ("", "-reduced") for name in TRIALS]
    found = [json.loads(path.read_text(encoding="utf-8")) for path in paths if path.is_file()]
    marked = re.compile("<!-- trials -->.*?<!-- end of trials -->", re.DOTALL)
    if not marked.search(page):
        sys.exit(f"{PAGE}: markers <!-- trials --> and <!-- end of trials --> are missing")
    atomic_write(
        PAGE, marked.sub(lambda _: f"<!-- trials -->\n\n{markdown(found)}\n\n<!-- end of trials -->", page).encode()
    )


def markdown(found: list[dict[str, Any]]) -> str:
    """Return one table, a column per trial."""
    if not found:
        return "Not measured yet."
    names = {"sqlite": "SQLite", "postgresql": "PostgreSQL"}
    lines = [("", *(names[one["name"]] for one in found)), ("---",) * (1 + len(found))]
    columns = [column(one) for one in found]
    lines += [(rows[0][0], *(value for _, value in rows)) for rows in zip(*columns, strict=True)]
    reduced = [one for one in found if one["settings"]["hours"] * one["settings"]["assets"] < FULL_DAY]
    words = " **Reduced: not the whole day of 200 assets**, where the table says so." if reduced else ""
    machines = "; ".join(sorted({one["machine"] for one in found}))
    loads = ", ".join(f"{one['settings']['load']:g}" for one in found)
    words += f" Load of the machine by other work, before each: {loads}."
    if any(one["settings"]["load"] > BUSY for one in found):
        words += " **So recovery and latency say more of that work than of the service.**"
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + f"\n\n{machines}.{words}"


def column(one: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of one trial."""
    settings, memory, latency = one["settings"], one["memory"], one["latency_s"]
    growth = memory["late_mb"] / memory["early_mb"] - 1.0
    rows = [
        ("simulated", f"{settings['hours']:g} h, {settings['assets']} assets at 100 Hz"),
        (
            "at",
            f"{settings['speed']:g} times true speed, blocks of {settings['block_s']:g} s, in {one['seconds']:.0f} s",
        ),
        ("blocks", f"{one['blocks']}"),
        ("lost, counted twice, other samples", f"{one['lost']}, {one['duplicated']}, {one['other']}"),
        ("rows of results; missing or twice", f"{one['rows']}; {one['misnumbered']}"),
        ("assets run once more undisturbed; different in any bit", f"{one['compared']}; {one['different']}"),
    ]
    outages = {"full disk", "database crash"}
    for words, names in (
        ("kill -9: times, longest recovery", {"kill -9"}),
        ("store out: times, longest recovery", outages),
    ):
        times = [time for name, each in one["recoveries"].items() if name in names for time in each]
        rows.append((words, f"{len(times)}, {max(times):.1f} s" if times else "none"))
    p50, p99 = latency["undisturbed"]["p50"], latency["undisturbed"]["p99"]
    of = [f"{x:.2g} s" if math.isfinite(x) else f"over {BUCKETS_S[-1]:g} s" for x in (p50, p99)]
    rows.append(("latency undisturbed, p50 and p99", ", ".join(of)))
    rows.append(("memory, growth", f"{memory['late_mb']:.0f} MB, {100.0 * growth:+.1f} % in {memory['over_s']:.0f} s"))
    return rows


def main() -> None:
    """Run the command line of this process."""
    command = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    command.add_argument("names", nargs="*", metavar="NAME", help=f"trials: {', '.join(TRIALS)}; default: all")
    command.add_argument("--hours", type=float, default=24.0, help="simulated hours")
    command.add_argument("--assets", type=int, default=200, help="assets")
    command.add_argument("--speed", type=float, default=40.0, help="times true speed")
    command.add_argument("--every", type=float, default=EVERY_S, help="mean time between disturbances, in s")
    command.add_argument("--render", action="store_true", help="write docs/reliability.md from the results")
    given = command.parse_args()
    if strange := set(given.names) - set(TRIALS):
        command.error(f"{min(strange)}: no such trial, choose from {', '.join(TRIALS)}")
    log.set_up_logging("error")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # disks are unmounted and servers stopped then
    if given.names or not given.render:
        for name in given.names or TRIALS:
            found = trial(name, (given.assets, given.hours, given.speed), given.every)
            RESULTS.mkdir(exist_ok=True)
            full = given.hours * given.assets >= FULL_DAY
            file = RESULTS / (f"{name}.json" if full else f"{name}-reduced.json")
            atomic_write(file, (json.dumps(found, indent=1) + "\n").encode())
            print(json.dumps(found, indent=1))
    if given.render:
        render()


if __name__ == "__main__":
    main()
