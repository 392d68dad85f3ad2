"""Looks into the store twice a second, once for all readers, and tells each of them what is new since it last heard.

A reader that is slow gets the newest state when it is ready, and nothing of what it missed in between: nobody's
backlog grows. What most readers need is turned into text once.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import sqlalchemy as sa

from servoscope.errors import StoreError
from servoscope.store import Row, Store, tables
from servoscope.web import telling

__all__ = ["Hub", "Note", "event", "of_assets", "of_services", "sizes_of"]

EVERY_S = 0.5
NOTES = 2000  # that a reader may be behind
AT_ONCE = 200  # pairs of asset and number in one query


class Note(NamedTuple):
    """Something that happened once: its number, kind (``alarm`` or ``diagnosis``), asset, and text for readers."""

    number: int
    kind: str
    asset: str
    text: bytes


@dataclass
class Hub:
    """What was last seen in the store.

    Parameters
    ----------
    store
        Looked into.
    """

    store: Store
    tick: int = 0  # counts looks that found something
    unavailable: str = ""  # what the store last said; empty: it answers
    closed: bool = False
    rows: dict[str, Row] = field(default_factory=dict)  # newest checkpoint's status by asset
    notes: deque[Note] = field(default_factory=lambda: deque(maxlen=NOTES))
    noted: int = 0
    sizes: dict[str, list[dict[str, Any]]] = field(default_factory=dict)  # of named faults
    _ticks: dict[str, int] = field(default_factory=dict)  # when each asset was last news
    # urgency, name and text of each asset, made once however far behind readers are
    _assets: dict[str, tuple[float, str, str]] = field(default_factory=dict)
    _texts: dict[int, bytes] = field(default_factory=dict)  # the newest tick's event by what the reader last heard
    _news: asyncio.Event = field(default_factory=asyncio.Event)

    async def follow(self) -> None:
        """Look until cancelled."""
        while True:
            begun = time.monotonic()
            await self.look()
            await asyncio.sleep(max(0.05, EVERY_S - (time.monotonic() - begun)))

    async def look(self) -> None:
        """Look once."""
        try:
            changed, notes = await asyncio.to_thread(self._read)
        except StoreError as error:
            if not self.unavailable:
                logging.getLogger("servoscope.web").error("store: %s", error)
                self._tell()
            self.unavailable = str(error)
            return
        if changed or self.unavailable:
            self.unavailable = ""
            self.tick += 1
            self.rows.update(changed)
            self._ticks.update(dict.fromkeys(changed, self.tick))
            self._texts = {}
            for name, row in of_assets(changed).items():
                shown = telling.asset_row(name, row["at"], row["status"], self.sizes.get(name, ()))
                self._assets[name] = -shown["severity"], name, _json(shown)
            for kind, asset, plain in notes:
                self.noted += 1
                self.notes.append(Note(self.noted, kind, asset, event(kind, plain)))
            self._tell()

    def _tell(self) -> None:
        news, self._news = self._news, asyncio.Event()
        news.set()

    def close(self) -> None:
        """Let readers go."""
        self.closed = True
        self._tell()

    async def news(self, seconds: float) -> None:
        """Wait until something is new, but no longer than this."""
        try:
            await asyncio.wait_for(self._news.wait(), seconds)
        except TimeoutError:
            return

    def changed(self, asset: str, since: int) -> bool:
        """Tell whether an asset is news to a reader who last heard at this tick."""
        return self._ticks.get(asset, -1) > since

    def since(self, tick: int) -> bytes:
        """Return the events that bring a reader up to date."""
        if tick not in self._texts:
            if len(self._texts) > 100:
                self._texts = {}
            names = [name for name, when in self._ticks.items() if when > tick]
            said = {name: self.rows[name] for name in names}
            now = time.time()
            assets = sorted(self._assets[name] for name in said if name in self._assets)
            text = b""
            if assets or tick < 0:
                rows = ",".join(asset for _, _, asset in assets)
                text = f'event: assets\ndata: {{"now":{now!r},"assets":[{rows}]}}\n\n'.encode()
            if services := [telling.service_row(name, row["status"]) for name, row in of_services(said).items()]:
                text += event("services", {"now": now, "services": services})
            self._texts[tick] = text
        return self._texts[tick]

    def _read(self) -> tuple[dict[str, Row], list[tuple[str, str, Mapping[str, Any]]]]:
        """Return the statuses that have changed, and what happened meanwhile; in a thread."""
        clocks = self.store.clocks()
        names = [name for name, at in clocks.items() if name not in self.rows or self.rows[name]["at"] != at]
        if not names:
            return {}, []
        changed = self.store.statuses(names if len(names) < len(clocks) else None)
        # a service writes down about itself with every commit that it stands where it stood
        changed = {
            name: row
            for name, row in changed.items()
            if name in names and not (row["status"].get("service") and self._same(name, row))
        }
        news = {name: row for name, row in of_assets(changed).items() if self._is_news(name, row)}
        found = sizes_of(self.store, news)
        self.sizes.update({name: found.get(name, []) for name in news})
        return changed, self._happened(changed) if self.tick else []

    def _is_news(self, name: str, row: Row) -> bool:
        """Tell whether a fault may have begun, ended, or been named."""
        before = self.rows.get(name)
        keys = ("verdict", "since", "awaited")
        return before is None or any(before["status"].get(key) != row["status"].get(key) for key in keys)

    def _same(self, name: str, row: Row) -> bool:
        return name in self.rows and self.rows[name]["status"] == row["status"]

    def _happened(self, changed: Mapping[str, Row]) -> list[tuple[str, str, Mapping[str, Any]]]:
        """Return transitions and diagnoses that are new, in the order of time."""
        spans, singles = [], []
        for name, row in changed.items():
            before = self.rows.get(name)
            if before is None:
                continue
            if (first := _count(before)) < (last := _count(row)):
                spans.append((name, first, last))
            # a full diagnosis has its number from the moment when it was asked for
            told = set(before["status"].get("awaited", ())) - set(row["status"].get("awaited", ()))
            singles += [(name, number - 1, number) for number in told]
        found: list[tuple[str, str, Mapping[str, Any]]] = []
        for kind, table, tell, wanted in (
            ("alarm", tables.transitions, telling.transition, spans),
            ("diagnosis", tables.diagnoses, telling.diagnosis_row, spans + singles),
        ):
            for i in range(0, len(wanted), AT_ONCE):
                parts = [
                    (table.c.asset == name) & (table.c.number > first) & (table.c.number <= last)
                    for name, first, last in wanted[i : i + AT_ONCE]
                ]
                query = sa.select(table).where(sa.or_(*parts)).order_by(table.c.t, table.c.number)
                found += [(kind, row["asset"], tell(row)) for row in self.store.rows(query)]
        return found


def _count(row: Row) -> int:
    """Return the number of an asset's, or a service's, last row."""
    counted = row["status"].get("counted")
    return int(counted["rows"] if counted else row["sequence"])


def sizes_of(store: Store, rows: Mapping[str, Row]) -> dict[str, list[dict[str, Any]]]:
    """Return sizes of faults by asset, of those that have a fault which a full diagnosis has named since it began."""
    faulty = {name: row["status"] for name, row in rows.items() if row["status"]["verdict"] == "fault"}
    found: dict[str, list[dict[str, Any]]] = {}
    if not faulty:
        return found
    table = tables.diagnoses
    wanted = table.c.asset.in_(faulty) & (table.c.t >= min(said["since"] for said in faulty.values()))
    query = sa.select(table.c.asset, table.c.t, table.c.document).where(wanted & (table.c.verdict == "fault"))
    for row in store.rows(query.order_by(table.c.t)):
        said = faulty[row["asset"]]
        if row["t"] >= said["since"] and row["document"].get("faults"):
            found[row["asset"]] = telling.sizes(said, row["document"])
    return found


def of_assets(rows: Mapping[str, Row]) -> dict[str, Row]:
    """Return those rows of statuses that are of assets."""
    return {name: row for name, row in rows.items() if not row["status"].get("service")}


def of_services(rows: Mapping[str, Row]) -> dict[str, Row]:
    """Return those that services wrote of themselves."""
    return {name: row for name, row in rows.items() if row["status"].get("service")}


def event(kind: str, plain: Mapping[str, Any]) -> bytes:
    """Return a server-sent event."""
    return f"event: {kind}\ndata: {_json(plain)}\n\n".encode()


def _json(plain: Mapping[str, Any]) -> str:
    return json.dumps(plain, separators=(",", ":"), allow_nan=False)
