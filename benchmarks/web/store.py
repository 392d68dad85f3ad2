"""A store that looks as if hundreds of assets were followed: the statuses of real ones, copied, moving twice a second.

    python benchmarks web/store FOLDER ASSETS RATE SECONDS

writes on, `RATE` times a second, for so many seconds. What is measured is pages and interface; the samples behind the
statuses were followed once, before.
"""

from __future__ import annotations

import copy
import json
import random
import sys
import time
from pathlib import Path
from typing import Any

BENCHMARKS = Path(__file__).resolve().parent.parent

from servoscope.learning.learn import nominal_baseline  # noqa: E402
from servoscope.models.loop import Loop  # noqa: E402
from servoscope.service.build import build_components  # noqa: E402
from servoscope.service.config import ServiceFile  # noqa: E402
from servoscope.service.service import Service  # noqa: E402
from servoscope.service.store import Batch, Store  # noqa: E402
from servoscope.signals import writers  # noqa: E402
from servoscope.simulation import FaultEvent, reference, simulate  # noqa: E402

LOOP = BENCHMARKS.parent / "src/servoscope/simulation/reference-rig.toml"
GROUPS = 8
FAULTY = 25  # every so-manieth asset has the fault
FILE = "hall.sqlite"


def prepare(folder: Path) -> None:
    """Follow a healthy and a faulty asset for two minutes, and keep their statuses."""
    loop = Loop.load(LOOP)
    r = reference("multisine", 120.0, loop.sample_rate)
    nominal_baseline(loop).save(folder / "baseline.json")
    writers.write_recording(folder / "healthy.csv", simulate(loop, r, seed=1)[0])
    leak = [FaultEvent.parse("C_ie=1.2@60")]
    writers.write_recording(folder / "leaky.csv", simulate(loop, r, faults=leak, seed=2)[0])
    assets = "".join(
        f'[assets.{name}]\nbaseline = "baseline.json"\nsource = "line"\nfiles = ["{name}.csv"]\n'
        for name in ("healthy", "leaky")
    )
    config = folder / "two.toml"
    config.write_text(
        'name = "two"\n[service]\nlisten = ""\nlog = "error"\n[store]\nurl = "two.sqlite"\n'
        f'[sources.line]\nkind = "replay"\nspeed = 0\n{assets}',
        encoding="utf-8",
    )
    settings = ServiceFile.load(config)
    Service(settings, build_components(settings)).run()
    store = Store.open("two.sqlite", folder)
    found = {name: row["status"] for name, row in store.statuses(["healthy", "leaky"]).items()}
    store.close()
    (folder / "statuses.json").write_text(json.dumps(found), encoding="utf-8")


def move(folder: Path, assets: int, rate: float, seconds: float) -> None:
    """Write the newest status of all assets again and again."""
    known: dict[str, dict[str, Any]] = json.loads((folder / "statuses.json").read_text(encoding="utf-8"))
    chance = random.Random(1)
    store = Store.open(FILE, folder, write=True)
    statuses = {}
    for i in range(assets):
        one = copy.deepcopy(known["leaky" if i % FAULTY == 0 else "healthy"])
        one.setdefault("about", {})["group"] = f"hall {1 + i % GROUPS}"
        statuses[f"axis-{i:03d}"] = one
    commit, end, turn = store.last_commit("hall"), time.monotonic() + seconds, time.monotonic()
    while turn < end:
        batch, now = Batch(), time.time()
        for sequence, (name, one) in enumerate(statuses.items(), start=commit):
            one["statistic"] *= 1.0 + chance.gauss(0.0, 0.02)
            one["t"] = one["counted"]["t"] = now
            for response in one.get("responses", ()):
                response[1] *= 1.0 + chance.gauss(0.0, 0.001)
            batch.checkpoints[name] = {"asset": name, "sequence": sequence, "state": b"", "status": one, "at": now}
        commit += 1
        store.write(batch, "hall", commit)
        turn += 1.0 / rate
        time.sleep(max(0.0, turn - time.monotonic()))
    store.close()


def main() -> None:
    """Move the statuses of a store: folder, assets, rate [1/s], seconds."""
    folder, assets, rate, seconds = sys.argv[1:]
    move(Path(folder), int(assets), float(rate), float(seconds))
