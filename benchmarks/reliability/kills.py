"""Kill a service again and again on each store, let the store fail now and then, and look at what is stored.

    python benchmarks/reliability/kills.py [--kills 200] [--json]

Each next service is forked from a warm process, so that there is time for many kills; `run.py` starts whole processes.
"""

from __future__ import annotations

import os
import random
import sys
import time
from pathlib import Path

BENCHMARKS = Path(__file__).resolve().parent.parent
sys.path[0] = str(BENCHMARKS)  # where `reliability` is a package, and `tables` lies
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from tables import Table, parser, show  # noqa: E402

from reliability.carrying import Carrier  # noqa: E402
from reliability.checks import check, opened  # noqa: E402
from reliability.fleet import Fleet  # noqa: E402
from reliability.run import database, workplace  # noqa: E402
from servoscope.service import log  # noqa: E402

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


def main() -> None:
    """Run the command line of this process."""
    command = parser(__doc__)
    command.add_argument("--kills", type=int, default=200, help="on each store")
    command.add_argument("--hours", type=float, default=3.0, help="simulated; the kills have to fit in")
    given = command.parse_args()
    log.set_up_logging("error")
    rows = tuple(killed(name, given.kills, given.hours) for name in STORES)
    show([Table("Kills", NOTE, COLUMNS, rows)], given.json)


if __name__ == "__main__":
    main()
