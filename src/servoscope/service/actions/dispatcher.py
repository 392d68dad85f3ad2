"""Delivers what is due in the outbox, to each sink from a thread of its own: a slow one delays no other."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from queue import SimpleQueue

from servoscope.core.errors import StoreError
from servoscope.service.actions import ActionSettings, DeliveryAttempt, OutboxEntry
from servoscope.service.actions.delivery import deliver
from servoscope.service.clock import SteadyClock
from servoscope.service.store import OutboxRow, Store

POLL_S = 0.5
MAX_ROWS = 20


class OutboxDispatcher:
    """Delivers the outbox of one service, not that of others on the same store; the service stores the attempts."""

    def __init__(self, store: Store, service: str, settings: ActionSettings, clock: SteadyClock) -> None:
        self._store, self._service, self._settings, self._clock = store, service, settings, clock
        self._attempts: SimpleQueue[DeliveryAttempt] = SimpleQueue()
        self._in_progress: dict[tuple[str, int], str] = {}  # key and attempt -> sink, until the attempt is stored
        self._busy: set[str] = set()  # sinks that something is being delivered to
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
            busy = set(self._busy)
            try:
                rows = self._store.due_deliveries(self._clock.now(), MAX_ROWS, self._service, busy)
            except StoreError:
                continue  # the service notices for itself
            due = {(row["key"], row["attempts"]): row for row in rows}
            self._in_progress = {one: sink for one, sink in self._in_progress.items() if one in due or sink in busy}
            new = {one: row for one, row in due.items() if one not in self._in_progress}
            self._in_progress |= {one: row["sink"] for one, row in new.items()}
            for sink in {row["sink"] for row in new.values()}:
                self._busy.add(sink)
                job = sink, [row for row in new.values() if row["sink"] == sink]
                threading.Thread(target=self._deliver_rows, args=job, name=f"delivery to {sink}", daemon=True).start()
            self.idle = not rows and not self._busy

    def _deliver_rows(self, sink: str, rows: Sequence[OutboxRow]) -> None:
        """Deliver to one sink, one after the other."""
        try:
            for row in rows:
                if self._stop_event.is_set():
                    return
                entry = OutboxEntry(
                    row["key"], row["sink"], row["event"], row["created"], row["due"] or 0.0, row["attempts"]
                )
                self._attempts.put(deliver(entry, self._settings, self._clock.now()))
        finally:
            self._busy.discard(sink)
