"""What is left in the store after a trial, held against what has to be there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import sqlalchemy as sa

from reliability.fleet import Fleet
from servoscope.service.build import build_components
from servoscope.service.config import ServiceFile
from servoscope.service.service import Service
from servoscope.service.store import Store
from servoscope.service.store.tables import diagnoses, residuals, transitions

__all__ = ["Found", "check"]


@dataclass(frozen=True)
class Found:
    """What is wrong, all of it 0 where nothing is.

    Parameters
    ----------
    blocks
        That were to be counted.
    lost, duplicated
        Blocks that were not counted, or more than once.
    other
        Assets whose samples, by their digest, are not those of the recordings.
    rows
        Residuals, diagnoses and transitions.
    misnumbered
        Rows that are missing, or twice, in the numbers of their asset.
    compared, different
        Assets that were run once more without disturbance, and those whose results are not the same to the last bit.
    """

    blocks: int
    lost: int
    duplicated: int
    other: int
    rows: int
    misnumbered: int
    compared: int
    different: int


def check(fleet: Fleet, config: Path, compared: list[str]) -> Found:
    """Look at everything that a trial has left."""
    expected = fleet.expected()
    store = opened(config)
    statuses = store.statuses(fleet.names)
    lost = duplicated = other = rows = misnumbered = 0
    for name, (blocks, _, digest) in expected.items():
        counted = statuses[name]["status"]["counted"] if name in statuses else {"blocks": 0, "digest": 0, "rows": 0}
        lost += max(0, blocks - counted["blocks"])
        duplicated += max(0, counted["blocks"] - blocks)
        other += counted["digest"] != digest
        numbers = sorted(row["number"] for table in NUMBERED for row in store.fetch(numbers_of(table, name)))
        rows += len(numbers)
        misnumbered += len(set(range(1, counted["rows"] + 1)).symmetric_difference(numbers))
        misnumbered += len(numbers) - len(set(numbers))
    calm = fleet.config("calm", "calm.sqlite", "", compared, 0.0)
    settings = ServiceFile.load(calm)
    Service(settings, build_components(settings)).run()
    again = opened(calm)
    different = sum(results(store, name) != results(again, name) for name in compared)
    for one in (store, again):
        one.close()
    return Found(
        sum(blocks for blocks, *_ in expected.values()),
        lost,
        duplicated,
        other,
        rows,
        misnumbered,
        len(compared),
        different,
    )


NUMBERED = (residuals, diagnoses, transitions)


def opened(config: Path) -> Store:
    """Open the store of a service file."""
    settings = ServiceFile.load(config)
    return Store.open(settings.store.url, settings.folder, lock_timeout_s=10.0)


def numbers_of(table: sa.Table, asset: str) -> sa.Select[tuple[int]]:
    """Ask for the numbers of an asset's rows."""
    return sa.select(table.c.number).where(table.c.asset == asset)


def results(store: Store, asset: str) -> list[object]:
    """Return all that is stored of an asset."""
    found: list[object] = [
        store.fetch(sa.select(table).where(table.c.asset == asset).order_by(*table.primary_key)) for table in NUMBERED
    ]
    row = store.checkpoints([asset])[asset]
    return [*found, store.recent_samples(asset), row["sequence"], bytes(row["state"]), row["status"]]
