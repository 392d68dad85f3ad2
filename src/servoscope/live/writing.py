"""Results on their way to the store: gathered, committed together, kept within bounds while it is unavailable."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from servoscope.errors import StoreUnavailable
from servoscope.live.asset import Asset
from servoscope.live.checkpoint import pack
from servoscope.live.rows import Row
from servoscope.store import Batch, Store

__all__ = ["Commit", "Writer"]

FIRST_WAIT_S, LONGEST_WAIT_S = 0.1, 2.0  # between two attempts at a store that is unavailable


@dataclass
class Commit:
    """A batch on its way, and what is to be told when it is safe.

    Parameters
    ----------
    batch
        What is written.
    taken
        How many blocks of each asset.
    due
        When each of its blocks had been complete, by the monotonic clock [s].
    """

    batch: Batch = field(default_factory=Batch)
    taken: Counter[str] = field(default_factory=Counter)
    due: list[float] = field(default_factory=list)


class Writer:
    """Gathers what is to be written and writes it, each batch exactly once.

    A commit whose end was not heard may have been made: before it is tried again, the store is asked for the number of
    its last one.

    Parameters
    ----------
    store
        Where to.
    owner
        Name of the service.
    bound
        How many blocks may wait.
    """

    def __init__(self, store: Store, owner: str, bound: int) -> None:
        self._store, self._owner, self._bound = store, owner, bound
        self._number = store.last_commit(owner)
        self._gathered = Commit()
        self._sealed: Commit | None = None  # on its way: nothing joins it any more
        self._stand: dict[str, Callable[[], tuple[dict[str, Any], int]]] = {}
        self._in_doubt = False
        self._wait = self._again = 0.0
        self.unavailable_since: float | None = None  # [UTC s]

    @property
    def waiting(self) -> int:
        """How many blocks wait."""
        return len(self._gathered.due) + (len(self._sealed.due) if self._sealed else 0)

    @property
    def room(self) -> int:
        """How many more blocks may be taken."""
        return max(0, self._bound - self.waiting)

    @property
    def share(self) -> float:
        """Share of the buffer that is filled."""
        return self.waiting / self._bound

    @property
    def empty(self) -> bool:
        """Whether nothing waits."""
        return self._sealed is None and not self._stand and self._gathered.batch.empty

    @property
    def batch(self) -> Batch:
        """What is being gathered, for outcomes of commands and deliveries."""
        return self._gathered.batch

    def add(self, owner: str, rows: Iterable[Row]) -> None:
        """Take rows of an asset, or of the service."""
        for table, values in rows:
            # the audit alone tells when it was written: all else is the same for every run over the same samples
            at = {"at": time.time()} if table == "audit" else {}
            self._gathered.batch.rows[table].append({"asset": owner, **at, **values})

    def stands(self, asset: Asset, due: float | None = None) -> None:
        """Take note of where an asset stands, after a block that had been complete at `due`, if there was one."""
        if due is not None:
            self._gathered.taken[asset.name] += 1
            self._gathered.due.append(due)
        if asset.progress is None:
            return
        progress, keep = asset.progress, asset.keep
        status = asset.status

        def checkpoint() -> tuple[dict[str, Any], int]:
            row = {"asset": progress.asset, "sequence": progress.counted.sequence}
            return {**row, "state": pack(progress), "status": status(progress), "at": time.time()}, keep

        self._stand[progress.asset] = checkpoint  # made when it is written: of many blocks, only the last one counts

    def remember(self, row: dict[str, Any]) -> None:
        """Take a checkpoint that is no asset's."""
        self._gathered.batch.checkpoints[row["asset"]] = {**row, "at": time.time()}

    def write(self) -> Commit | None:
        """Write what was gathered; return what is safe now, or None if that was nothing.

        Raises
        ------
        StoreUnavailable
            If the store cannot take it for now; nothing is lost, try again.
        """
        if self._sealed is None:
            if self.empty:
                return None
            self._sealed, self._gathered = self._seal(), Commit()
        if time.monotonic() < self._again:
            return None
        try:
            if not (self._in_doubt and self._store.last_commit(self._owner) == self._number + 1):
                self._store.write(self._sealed.batch, self._owner, self._number + 1)
        except StoreUnavailable:
            self._in_doubt = True
            self._wait = min(max(2.0 * self._wait, FIRST_WAIT_S), LONGEST_WAIT_S)
            self._again = time.monotonic() + self._wait
            self.unavailable_since = self.unavailable_since or time.time()
            raise
        done, self._sealed = self._sealed, None
        self._number += 1
        self._in_doubt, self._wait, self._again, self.unavailable_since = False, 0.0, 0.0, None
        return done

    def _seal(self) -> Commit:
        for name, checkpoint in self._stand.items():
            self._gathered.batch.checkpoints[name], self._gathered.batch.keep[name] = checkpoint()
        self._stand = {}
        return self._gathered
