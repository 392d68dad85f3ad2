"""Takes what is due from the outbox to webhooks and commands, each in a thread of its own: a slow one delays nobody."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from queue import SimpleQueue

from servoscope.actions import ActionSettings, Delivery, Outgoing, deliver
from servoscope.errors import StoreError
from servoscope.store import Row, Store

__all__ = ["Courier"]

EVERY_S = 0.5
AT_ONCE = 20


class Courier:
    """Delivers, and hands back how that went; the service writes it down.

    Parameters
    ----------
    store
        With the outbox.
    service
        Name of the service: what others on the same store have to deliver is theirs.
    settings
        Where to.
    """

    def __init__(self, store: Store, service: str, settings: ActionSettings) -> None:
        self._store, self._service, self._settings = store, service, settings
        self._done: SimpleQueue[Delivery] = SimpleQueue()
        self._handed: dict[tuple[str, int], str] = {}  # key and try, not yet written down, not to be tried once more
        self._busy: set[str] = set()  # sinks that something is being delivered to
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="delivery", daemon=True)
        self.idle = not settings.sinks  # whether nothing was due when it looked last

    def start(self) -> None:
        """Begin, if there is anybody to deliver to."""
        if self._settings.sinks:
            self._thread.start()

    def stop(self) -> None:
        """Stop; what is under way may be delivered once more later."""
        self._over.set()

    def expect(self) -> None:
        """Take note that something may be due."""
        self.idle = not self._settings.sinks

    def delivered(self) -> list[Delivery]:
        """Return what was tried since the last call."""
        return [self._done.get() for _ in range(self._done.qsize())]

    def _run(self) -> None:
        while not self._over.wait(EVERY_S):
            busy = set(self._busy)
            try:
                rows = self._store.due_deliveries(time.time(), AT_ONCE, self._service, busy)
            except StoreError:
                continue  # the service notices for itself
            due = {(row["key"], row["attempts"]): row for row in rows}
            self._handed = {one: sink for one, sink in self._handed.items() if one in due or sink in busy}
            fresh = [row for one, row in due.items() if one not in self._handed]
            self._handed |= {(row["key"], row["attempts"]): row["sink"] for row in fresh}
            for sink in {row["sink"] for row in fresh}:
                self._busy.add(sink)
                work = sink, [row for row in fresh if row["sink"] == sink]
                threading.Thread(target=self._bring, args=work, name=f"delivery to {sink}", daemon=True).start()
            self.idle = not rows and not self._busy

    def _bring(self, sink: str, rows: Sequence[Row]) -> None:
        """Deliver to one sink, one after the other."""
        try:
            for row in rows:
                if self._over.is_set():
                    return
                plain = {name: row[name] for name in ("key", "sink", "event", "created", "due", "attempts")}
                self._done.put(deliver(Outgoing(**plain), self._settings, time.time()))
        finally:
            self._busy.discard(sink)
