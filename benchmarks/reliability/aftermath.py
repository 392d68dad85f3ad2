"""What is left in the store after chaos, held against what was sent."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from reliability.checks import NUMBERED, numbers_of, opened
from reliability.fleet import BLOCK_S, Fleet
from reliability.plc import BEGAN, tape
from servoscope.service.checkpoint import unpack_state
from servoscope.service.sources.replay import ReplayStream
from servoscope.service.store import Store
from servoscope.service.store.tables import audit

__all__ = ["looked_at"]


def looked_at(fleet: Fleet, config: Path, sent: int, written: Mapping[str, set[int]]) -> dict[str, Any]:
    """Compare.

    Parameters
    ----------
    fleet
        Whose recordings were published.
    config
        Of the service.
    sent
        How many blocks the sender has sent that keeps nothing.
    written
        Numbers of the blocks that the OPC UA server has written, by asset.
    """
    store = opened(config)
    rows = store.checkpoints([*fleet.names, "plain", *written])
    lost = doubled = other = misnumbered = repeated = blocks = 0
    for name, (expected, _, digest) in fleet.expected().items():
        counted = rows[name]["status"]["counted"]
        blocks += expected
        lost += max(0, expected - counted["blocks"]) + counted["lost"]
        doubled += max(0, counted["blocks"] - expected)
        other += counted["digest"] != digest
        repeated += counted["repeated"]
        numbers = [row["number"] for table in NUMBERED for row in store.fetch(numbers_of(table, name))]
        numbers += [
            window.number for window in unpack_state(rows[name]["state"], name).pending_diagnoses
        ]  # still to be diagnosed
        misnumbered += sorted(numbers) != list(range(1, counted["rows"] + 1))
    played = tape(fleet.folder)
    others = {
        "plain": named(store, played, {"plain": set(range(sent))}, rows),
        "plc": named(store, played, written, rows),
    }
    store.close()
    told = {"lost": lost, "doubled": doubled, "other": other, "misnumbered": misnumbered}
    return {"blocks": blocks, **told, "left out as repeated": repeated, **others}


def named(
    store: Store, played: ReplayStream, sent: Mapping[str, set[int]], rows: Mapping[str, Mapping[str, Any]]
) -> dict[str, int]:
    """Hold what the audit names as lost against what was sent, up to the last block that was stored.

    What is stored must be what is left: as many blocks, with the samples of just these, by their digest.
    """
    found = dict.fromkeys(("sent", "stored", "named", "unnamed", "other"), 0)
    for name, numbers in sent.items():
        counted = rows[name]["status"]["counted"]
        first = round((counted["began"] - BEGAN) / BLOCK_S)
        lost = told_lost(store, name)
        stored = [number for number in range(first, counted["sequence"] + 1) if number not in lost]
        digest = 0
        for number in stored:
            block = played.block(name, number, BEGAN)
            assert block is not None
            digest = block.digest(digest)
        found["sent"] += sum(first <= number <= counted["sequence"] for number in numbers)
        found["stored"] += counted["blocks"]
        found["named"] += len(lost)
        found["unnamed"] += abs(len(stored) - counted["blocks"]) + len(set(stored) - numbers)
        found["other"] += digest != counted["digest"]
    return found


def told_lost(store: Store, asset: str) -> set[int]:
    """Return the numbers of all blocks that the audit names as lost."""
    found: set[int] = set()
    for row in store.fetch(sa.select(audit.c.document).where(audit.c.asset == asset, audit.c.what == "blocks lost")):
        document = row["document"]
        found.update(range(document["after"][1] + 1, document["before"][1]))
    return found
