"""Delivers what is due in the outbox, to each sink from a thread of its own: a slow one delays no other."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from pathlib import Path
from queue import SimpleQueue

from servoscope.core.errors import StoreError
from servoscope.service.actions import ActionSettings, DeliveryAttempt, OutboxEntry
from servoscope.service.actions.delivery import deliver_together
from servoscope.service.actions.mail import HourlyLimit
from servoscope.service.actions.settings import EmailSettings
from servoscope.service.clock import SteadyClock
from servoscope.service.store import Store

POLL_S = 0.5
MAX_ROWS = 20
MAX_ROWS_AS_ONE = 500  # of a sink that has been held


class OutboxDispatcher:
    """Delivers the outbox of one service, not that of others on the same store; the service stores the attempts.

    The paths of sinks are relative to a folder.
    """

    def __init__(
        self, store: Store, service: str, settings: ActionSettings, clock: SteadyClock, folder: Path = Path()
    ) -> None:
        self._store, self._service, self._settings, self._clock, self._folder = store, service, settings, clock, folder
        self._attempts: SimpleQueue[DeliveryAttempt] = SimpleQueue()
        self._in_progress: dict[tuple[str, int], str] = {}  # key and attempt -> sink, until the attempt is stored
        self._busy: set[str] = set()  # sinks that something is being delivered to
        self._limits: dict[str, HourlyLimit] = {}  # of sinks that take only so much an hour
        self._held: dict[str, float] = {}  # until when they take no more, by the monotonic clock; then all as one
        self._stop_event = threading.Event()
        self._thread = threading.Thread(target=self._run, name="delivery", daemon=True)
        self.idle = not settings.sinks  # whether nothing was due at the last poll

    def start(self) -> None:
        """Start, if there is any sink."""
        if self._settings.sinks and not self._thread.is_alive():
            self._thread.start()

    def change(self, settings: ActionSettings) -> None:
        """Deliver by other settings from now on."""
        self._settings = settings
        self.wake()
        self.start()

    def stop(self) -> None:
        """Stop; what is in progress may be delivered once more later."""
        self._stop_event.set()

    def wake(self) -> None:
        """Poll again before being idle: something may be due."""
        self.idle = not self._settings.sinks

    def take_attempts(self) -> list[DeliveryAttempt]:
        """Return the attempts since the last call."""
        return [self._attempts.get() for _ in range(self._attempts.qsize())]

    def _run(self) -> None:
        while not self._stop_event.wait(POLL_S):
            busy, now, settings = set(self._busy), self._clock.now(), self._settings
            until_by_sink = self._held.copy()
            held = {sink for sink, until in until_by_sink.items() if until > time.monotonic()}
            try:
                rows = self._store.due_deliveries(now, MAX_ROWS, self._service, busy | held)
                for sink in until_by_sink.keys() - held - busy:
                    others = settings.sinks.keys() - {sink}
                    rows += self._store.due_deliveries(now, MAX_ROWS_AS_ONE, self._service, others)
            except StoreError:
                continue  # the service notices for itself
            due = {(row["key"], row["attempts"]): OutboxEntry(**row) for row in rows}
            self._in_progress = {
                identity: sink for identity, sink in self._in_progress.items() if identity in due or sink in busy
            }
            new = {identity: entry for identity, entry in due.items() if identity not in self._in_progress}
            self._in_progress |= {identity: entry.sink for identity, entry in new.items()}
            for sink in dict.fromkeys(entry.sink for entry in new.values()):
                self._busy.add(sink)
                job = sink, [entry for entry in new.values() if entry.sink == sink]
                threading.Thread(target=self._deliver, args=job, name=f"delivery to {sink}", daemon=True).start()
            self.idle = not rows and not self._busy

    def _deliver(self, sink: str, entries: Sequence[OutboxEntry]) -> None:
        """Deliver to one sink, one after the other."""
        try:
            sink_settings = self._settings.sinks.get(sink)
            limit = self._limits.setdefault(sink, HourlyLimit())
            together = isinstance(sink_settings, EmailSettings) and self._held.pop(sink, None) is not None
            for group in [entries] if together else [[entry] for entry in entries]:
                if self._stop_event.is_set():
                    return
                wait_s = limit.wait_s(sink_settings.per_hour) if isinstance(sink_settings, EmailSettings) else 0.0
                if wait_s:
                    self._held[sink] = time.monotonic() + wait_s
                    return
                attempts = deliver_together(group, self._settings, self._clock.now(), self._folder)
                if attempts[0].delivered:
                    limit.count()
                for attempt in attempts:
                    self._attempts.put(attempt)
        finally:
            self._busy.discard(sink)
