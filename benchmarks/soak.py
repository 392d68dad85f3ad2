"""Let the service run through a day of 200 assets in minutes, disturb it, and write benchmarks/reliability/RESULTS.md.

    python benchmarks/soak.py [sqlite|postgresql ...] [--hours 24] [--assets 200] [--speed 40] [--render]
    python benchmarks/soak.py --kills 200 [--json]

The second kills a service again and again on each store, lets the store fail now and then, and looks at what is stored.
Each next service is forked from a warm process there, so that there is time for many kills; the first starts whole
processes.

Everything is on this machine: the full disk is a file system in memory, and the database a server of its own, on
loopback. --render writes the tables from the results that are there; together with names, after running them.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import re
import signal
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

BENCHMARKS = Path(__file__).resolve().parent
sys.path.insert(1, str(BENCHMARKS.parent / "tests" / "support"))  # where `reliability` is a package
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from reliability.carrying import Carrier  # noqa: E402
from reliability.checks import check, opened  # noqa: E402
from reliability.fleet import BLOCK_S, Fleet  # noqa: E402
from reliability.trial import Measured, Trial, quantile  # noqa: E402
from reliability.workplace import database, free_port, workplace  # noqa: E402
from tables import Table, machine, show  # noqa: E402

from servoscope.core.files import atomic_write  # noqa: E402
from servoscope.service import log  # noqa: E402
from servoscope.service.metrics import BUCKETS_S  # noqa: E402

RESULTS = BENCHMARKS / "reliability" / "results"
PAGE = BENCHMARKS / "reliability" / "RESULTS.md"
TRIALS = ("sqlite", "postgresql")
COMPARED = 10  # assets that are run once more without disturbance
CALM = 0.25  # share of the run at the end that is left in peace
EVERY_S = 25.0  # mean time between disturbances
FULL_DAY = 24.0 * 200
BUSY = 1.0  # load from which times mean little
STORES = {"sqlite": ("SQLite", "full disk"), "postgresql": ("PostgreSQL", "database crash")}
LIFE_S = 0.1, 1.5  # a commit is made every 0.5 s: some lives store nothing, some store twice
OUTAGE_EVERY = 20  # kills
OUTAGE_S = 1.0
COLUMNS = (
    "store", "kill -9", "outages", "blocks", "of them stored at the last kill", "lost, twice, other samples",
    "rows; missing or twice", "assets run once more; different in any bit",
)  # fmt: skip
NOTE = (
    "A service follows 10 assets at 100 Hz, 40 times as fast, in blocks of 5 s, and lives for 0.1 to 1.5 s. "
    "The outages (of SQLite a full disk, of PostgreSQL a crash) come between, last for 1 s, and end in a kill as well."
)


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


def killed(name: str, kills: int, hours: float, seed: int = 1) -> tuple[str, ...]:
    """Kill a service so many times on one store, let the last one end, and return the row of what was found."""
    chance, outages = random.Random(seed), 0
    with workplace(1000.0) as (folder, disk):
        fleet = Fleet(folder, 10, hours, 40.0, block_s=5.0)
        fleet.make()
        with database(name, disk) as (url, disturbances), Carrier(_warm(fleet)) as carrier:
            config = fleet.config("fleet", url, "", fleet.names, fleet.speed)
            outage = next((each for each in disturbances if not each.kills), None)
            for number in range(kills):
                process = carrier.start(config)
                time.sleep(chance.uniform(*LIFE_S))
                if outage is not None and number % OUTAGE_EVERY == OUTAGE_EVERY - 1:
                    outage.begin()
                    time.sleep(OUTAGE_S)
                    outage.end()
                    outages += 1
                carrier.kill(process)
            stored = _stored(config, fleet)
            if stored == 0:
                raise SystemExit(f"{name}: no life was long enough to store a block, so the kills show nothing")
            carrier.start(fleet.config("fleet", url, "", fleet.names, 0.0))
            assert carrier.wait() == 0
            found = check(fleet, config, fleet.names)
    title, what = STORES[name]
    return (
        title,
        str(kills),
        f"{what}: {outages}",
        str(found.blocks),
        str(stored),
        f"{found.lost}, {found.duplicated}, {found.other}",
        f"{found.rows}; {found.misnumbered}",
        f"{found.compared}; {found.different}",
    )


def _warm(fleet: Fleet) -> Path:
    """Return the file of a short service, which has all compiled and loaded when it ends."""
    # all assets, since one alone does not go through the kernels of many
    return fleet.config("warm", "warm.sqlite", "", fleet.names, 0.0)


def _stored(config: Path, fleet: Fleet) -> int:
    """Return how many blocks are stored."""
    store = opened(config)
    found = store.statuses(fleet.names)
    store.close()
    return sum(each["status"]["counted"]["blocks"] for each in found.values())


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
    command.add_argument("--hours", type=float, help="simulated hours: 24, or 3 in which all kills have to fit")
    command.add_argument("--assets", type=int, default=200, help="assets")
    command.add_argument("--speed", type=float, default=40.0, help="times true speed")
    command.add_argument("--every", type=float, default=EVERY_S, help="mean time between disturbances, in s")
    command.add_argument(
        "--render", action="store_true", help="write benchmarks/reliability/RESULTS.md from the results"
    )
    command.add_argument("--kills", type=int, help="kill it so many times on each store instead")
    command.add_argument("--json", action="store_true", help="with --kills: print JSON")
    given = command.parse_args()
    if strange := set(given.names) - set(TRIALS):
        command.error(f"{min(strange)}: no such trial, choose from {', '.join(TRIALS)}")
    log.set_up_logging("error")
    if given.kills is not None:
        rows = tuple(killed(name, given.kills, given.hours or 3.0) for name in STORES)
        show([Table("Kills", NOTE, COLUMNS, rows)], given.json)
        return
    hours = given.hours or 24.0
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # disks are unmounted and servers stopped then
    if given.names or not given.render:
        for name in given.names or TRIALS:
            found = trial(name, (given.assets, hours, given.speed), given.every)
            RESULTS.mkdir(exist_ok=True)
            full = hours * given.assets >= FULL_DAY
            file = RESULTS / (f"{name}.json" if full else f"{name}-reduced.json")
            atomic_write(file, (json.dumps(found, indent=1) + "\n").encode())
            print(json.dumps(found, indent=1))
    if given.render:
        render()


if __name__ == "__main__":
    main()
