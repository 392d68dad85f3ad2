"""Takes what is due from the outbox to webhooks and commands, in a thread of its own: a slow receiver delays nobody."""

from __future__ import annotations

import threading
import time
from queue import SimpleQueue

from servoscope.actions import ActionSettings, Delivery, Outgoing, deliver
from servoscope.errors import StoreError
from servoscope.store import Store

__all__ = ["Courier"]

EVERY_S = 0.5
AT_ONCE = 20


class Courier:
    """Delivers, and hands back how that went; the service writes it down.

    Parameters
    ----------
    store
        With the outbox.
    settings
        Where to.
    """

    def __init__(self, store: Store, settings: ActionSettings) -> None:
        self._store, self._settings = store, settings
        self._done: SimpleQueue[Delivery] = SimpleQueue()
        self._handed: set[tuple[str, int]] = set()  # key and try: not yet written down, not to be tried once more
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
            try:
                rows = self._store.due_deliveries(time.time(), AT_ONCE)
            except StoreError:
                continue  # the service notices for itself
            fresh = [row for row in rows if (row["key"], row["attempts"]) not in self._handed]
            self._handed &= {(row["key"], row["attempts"]) for row in rows}
            for row in fresh:
                if self._over.is_set():
                    return
                plain = {name: row[name] for name in ("key", "sink", "event", "created", "due", "attempts")}
                self._handed.add((row["key"], row["attempts"]))
                self._done.put(deliver(Outgoing(**plain), self._settings, time.time()))
            self.idle = not rows
