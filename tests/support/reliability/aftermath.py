"""What is left in the store after chaos, held against what was sent."""

from __future__ import annotations

import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from reliability.checks import NUMBERED, numbers_of, opened
from reliability.fleet import Fleet
from reliability.plc import tape
from servoscope.service.assets.checkpoint import unpack_state
from servoscope.service.store import Store
from servoscope.service.store.tables import audit

__all__ = ["looked_at"]


def looked_at(
    fleet: Fleet, config: Path, plain: tuple[set[int], set[int]], written: Mapping[str, Mapping[str, set[int]]]
) -> dict[str, Any]:
    """Compare.

    Parameters
    ----------
    fleet
        Whose recordings were published.
    config
        Of the service.
    plain
        Numbers of the blocks that the sender has sent that keeps nothing, and of those by a clock that was wrong.
    written
        Numbers of the blocks that each sender of another library has written, by asset.
    """
    store = opened(config)
    rows = store.checkpoints([*fleet.names, "plain", *(name for one in written.values() for name in one)])
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
    others = {"plain": named(store, fleet, {"plain": plain[0]}, rows, plain[1])}
    others |= {stack: named(store, fleet, each, rows) for stack, each in written.items()}
    store.close()
    told = {"lost": lost, "doubled": doubled, "other": other, "misnumbered": misnumbered}
    return {"blocks": blocks, **told, "left out as repeated": repeated, **others}


def named(
    store: Store,
    fleet: Fleet,
    sent: Mapping[str, set[int]],
    rows: Mapping[str, Mapping[str, Any]],
    misdated: Collection[int] = (),
) -> dict[str, int]:
    """Hold what the audit names as lost against what was sent, up to the last block that was stored.

    What is stored must be what is left: as many blocks, with the samples of just these, by their digest. What a wrong
    clock has dated must be counted as such, and left out.
    """
    played, found = tape(fleet), dict.fromkeys(("sent", "stored", "named", "future", "unnamed", "other"), 0)
    for name, numbers in sent.items():
        counted = rows[name]["status"]["counted"]
        first = round((counted["began"] - fleet.began) / fleet.block_s)
        lost = told_lost(store, name)
        reached = range(first, counted["sequence"] + 1)
        stored = [number for number in reached if number not in lost and number not in misdated]
        future = sum(number in misdated for number in reached if number not in lost)
        digest = 0
        for number in stored:
            block = played.block(name, number, fleet.began)
            assert block is not None
            digest = zlib.crc32(block.signals.tobytes(), digest)
        found["sent"] += sum(first <= number <= counted["sequence"] for number in numbers)
        found["stored"] += counted["blocks"]
        found["named"] += len(lost)
        found["future"] += counted["future"]
        found["unnamed"] += abs(len(stored) - counted["blocks"]) + abs(future - counted["future"])
        found["unnamed"] += len(set(stored) - numbers)
        found["other"] += digest != counted["digest"]
    return found


def told_lost(store: Store, asset: str) -> set[int]:
    """Return the numbers of all blocks that the audit names as lost."""
    found: set[int] = set()
    for row in store.fetch(sa.select(audit.c.document).where(audit.c.asset == asset, audit.c.what == "blocks lost")):
        document = row["document"]
        found.update(range(document["after"][1] + 1, document["before"][1]))
    return found
