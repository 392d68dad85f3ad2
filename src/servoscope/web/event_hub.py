"""Reads the store twice a second, once for all readers, and gives each of them what is new since its last event.

A slow reader gets the newest state when it is ready, and nothing of what it missed in between: no backlog grows. What
most readers need is turned into text once.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import sqlalchemy as sa
from pydantic_core import to_json

from servoscope.core.errors import StoreError
from servoscope.core.messages import current_language, current_zone
from servoscope.service.assets.status import AssetStatus, ServiceStatus
from servoscope.service.store import Row, Store, tables
from servoscope.web.schemas.assets import AssetRow, ServiceRow, TransitionRow
from servoscope.web.schemas.responses import DiagnosisRow
from servoscope.web.statuses import FleetTable, StatusEntry, asset_statuses, read_statuses, service_statuses

EVERY_S = 0.5
ROWS_PER_EVENT = 200  # assets in one event
MAX_EVENTS = 2000  # that a reader may be behind
MAX_TEXTS = 100  # of a tick, one for each earlier tick at which a reader was last served
MAX_RANGES_PER_QUERY = 200  # pairs of asset and number


class HubEvent(NamedTuple):
    """Something that happened once: its number, kind (``alarm`` or ``diagnosis``), asset, and text for readers."""

    number: int
    kind: str
    asset: str
    text: bytes


@dataclass
class EventHub:
    """The newest statuses and events of a store."""

    store: Store
    tick: int = 0  # counts reads that found something new
    error: str = ""  # of the last read; empty: the store answers
    closed: bool = False
    statuses: dict[str, StatusEntry] = field(default_factory=dict)
    events: deque[HubEvent] = field(default_factory=lambda: deque(maxlen=MAX_EVENTS))
    last_number: int = 0  # of the events
    fleet: FleetTable = field(init=False)
    _started: str = field(default_factory=lambda: secrets.token_hex(4))  # marks of another run mean nothing
    _ticks: dict[str, int] = field(default_factory=dict)  # at which each asset was last new
    # the newest tick's event by the reader's last tick, language and clock
    _texts: dict[tuple[int, str, object], bytes] = field(default_factory=dict)
    _change: asyncio.Event = field(default_factory=asyncio.Event)

    def __post_init__(self) -> None:
        self.fleet = FleetTable(self.store)

    @property
    def mark(self) -> str:
        """What a reader is given who knows all until now."""
        return f"{self._started}-{self.tick}"

    def tick_at(self, mark: str) -> int:
        """Return the tick of a mark; -1 where it is none of this run: its reader needs everything."""
        started, _, tick = mark.partition("-")
        return int(tick) if started == self._started and tick.isdecimal() and int(tick) <= self.tick else -1

    async def run(self) -> None:
        """Poll until cancelled."""
        while True:
            start = time.monotonic()
            await self.poll()
            await asyncio.sleep(max(0.05, EVERY_S - (time.monotonic() - start)))

    async def poll(self) -> None:
        """Read what is new, and wake the readers."""
        try:
            changed, events = await asyncio.to_thread(self._read)
        except StoreError as error:
            if not self.error:
                logging.getLogger("servoscope.web").error("store: %s", error)
                self._notify()
            self.error = str(error)
            return
        if not changed and not self.error:
            return
        self.error = ""
        self.tick += 1
        self.statuses.update(changed)
        self._ticks.update(dict.fromkeys(changed, self.tick))
        self._texts = {}
        for kind, event in events:
            self.last_number += 1
            self.events.append(HubEvent(self.last_number, kind, str(event.asset), format_sse(kind, event)))
        self._notify()

    def _notify(self) -> None:
        change, self._change = self._change, asyncio.Event()
        change.set()

    def close(self) -> None:
        """End the streams of all readers."""
        self.closed = True
        self._notify()

    async def wait(self, seconds: float) -> None:
        """Wait until something is new, but no longer than this."""
        try:
            await asyncio.wait_for(self._change.wait(), seconds)
        except TimeoutError:
            return

    def has_changed(self, asset: str, tick: int) -> bool:
        """Return whether an asset is new to a reader who was last served at this tick."""
        return self._ticks.get(asset, -1) > tick

    def events_since(self, tick: int) -> bytes:
        """Return the events that bring a reader up to date who was last served at this tick."""
        key = tick, current_language(), current_zone()
        if key not in self._texts:
            if len(self._texts) > MAX_TEXTS:
                self._texts = {}
            names = [name for name, changed in self._ticks.items() if changed > tick]
            now, text = time.time(), b""
            assets = [
                AssetRow.from_status(stored.name, stored.at, status)
                for stored, status in asset_statuses(self.statuses[name] for name in names)
            ]
            services = service_statuses(self.statuses[name] for name in names)
            if shown := [ServiceRow.from_status(stored.name, status) for stored, status in services]:
                text += format_sse("services", {"now": now, "services": shown})
            if assets or tick < 0:
                ordered = sorted(assets, key=lambda row: (-row.severity, row.asset))
                for k in range(0, max(len(ordered), 1), ROWS_PER_EVENT):
                    rows = ",".join(row.model_dump_json() for row in ordered[k : k + ROWS_PER_EVENT])
                    # whose connection ends before the last one does not have them all
                    mark = f"id: {self.mark}\n" if k + ROWS_PER_EVENT >= len(ordered) else ""
                    text += f'{mark}event: assets\ndata: {{"now":{now!r},"assets":[{rows}]}}\n\n'.encode()
            self._texts[key] = text
        return self._texts[key]

    def _read(self) -> tuple[dict[str, StatusEntry], list[tuple[str, TransitionRow | DiagnosisRow]]]:
        """Return the statuses that have changed, and what happened meanwhile; in a thread."""
        clocks = self.store.checkpoint_times()
        names = [name for name, at in clocks.items() if name not in self.statuses or self.statuses[name].at != at]
        if not names:
            return {}, []
        read = read_statuses(self.store, names if len(names) < len(clocks) else None)
        changed = {name: read[name] for name in names if name in read and not self._is_unchanged(read[name])}
        return changed, self._new_events(changed) if self.tick else []

    def _is_unchanged(self, stored: StatusEntry) -> bool:
        """Return whether it is a service, which stores its status with every commit, and says the same as before."""
        before = self.statuses.get(stored.name)
        return isinstance(stored.status, ServiceStatus) and before is not None and before.status == stored.status

    def _new_events(self, changed: Mapping[str, StatusEntry]) -> list[tuple[str, TransitionRow | DiagnosisRow]]:
        """Return new transitions and diagnoses, in the order of time."""
        spans, singles = [], []
        for name, stored in changed.items():
            before = self.statuses.get(name)
            if before is None:
                continue
            if (first := before.row_number) < (last := stored.row_number):
                spans.append((name, first, last))
            # a full diagnosis has its number from the moment when it was asked for
            done = _pending_diagnoses(before) - _pending_diagnoses(stored)
            singles += [(name, number - 1, number) for number in done]
        return [
            *(("alarm", TransitionRow.from_stored(row)) for row in self._rows(tables.transitions, spans)),
            *(("diagnosis", DiagnosisRow.from_stored(row)) for row in self._rows(tables.diagnoses, spans + singles)),
        ]

    def _rows(self, table: sa.Table, ranges: list[tuple[str, int, int]]) -> list[Row]:
        """Return the rows of assets with numbers behind one and up to another."""
        rows: list[Row] = []
        for i in range(0, len(ranges), MAX_RANGES_PER_QUERY):
            parts = [
                (table.c.asset == name) & (table.c.number > first) & (table.c.number <= last)
                for name, first, last in ranges[i : i + MAX_RANGES_PER_QUERY]
            ]
            rows += self.store.fetch(sa.select(table).where(sa.or_(*parts)).order_by(table.c.t, table.c.number))
        return rows


def _pending_diagnoses(stored: StatusEntry) -> set[int]:
    return set(stored.status.pending_diagnoses) if isinstance(stored.status, AssetStatus) else set()


def format_sse(kind: str, content: object) -> bytes:
    """Return a server-sent event of records and plain values."""
    return b"event: %b\ndata: %b\n\n" % (kind.encode(), to_json(content, inf_nan_mode="null"))
