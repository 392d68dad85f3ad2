"""Results on their way to the store: gathered, committed together, kept within bounds while it is unavailable."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

from servoscope.core.errors import StoreUnavailableError
from servoscope.service.assets.asset import Asset
from servoscope.service.assets.checkpoint import pack_state
from servoscope.service.assets.records import TableRow
from servoscope.service.log import log
from servoscope.service.store import Batch, Store
from servoscope.service.store.bundles import SampleBlock

MIN_RETRY_S, MAX_RETRY_S = 0.1, 2.0  # between two attempts at a store that is unavailable
MIN_CHECKPOINTS = 16  # that a commit writes at least, if there are so many
CHECKPOINT_SHARE = 40  # beyond, each commit writes one of so many that can wait


@dataclass
class PendingCommit:
    """A batch, and the blocks that are to be acknowledged when it is stored."""

    batch: Batch = field(default_factory=Batch)
    samples: list[SampleBlock] = field(default_factory=list)
    blocks: Counter[str] = field(default_factory=Counter)  # how many of each asset
    completion_times: list[float] = field(default_factory=list)  # of these blocks, by the monotonic clock [s]


class StoreWriter:
    """Gathers what is to be written about up to `capacity` blocks, and writes each batch exactly once.

    A commit whose end was not confirmed may have been made: before it is tried again, the number of the owner's last
    commit is read from the store.

    Samples are in the store with the first commit after them. Where they have led to nothing else, the state after them
    may wait some commits: a restart computes it again from the last one and the samples since then.
    """

    def __init__(self, store: Store, owner: str, capacity: int) -> None:
        self._store, self._owner, self.capacity = store, owner, capacity
        self._number, self._bundles = store.last_commit(owner), store.bundle_index(owner)
        self._gathered = PendingCommit()
        self._sealed: PendingCommit | None = None  # on its way: nothing is added to it any more
        self._checkpoints: dict[str, Asset] = {}  # whose states are to be written as they are then
        self._urgent: dict[str, None] = {}  # assets whose checkpoint cannot wait, in order
        self._in_doubt = False
        self._retry_s = self._retry_at = 0.0
        self.unavailable_since: float | None = None  # [UTC s]

    @property
    def waiting(self) -> int:
        """How many blocks wait."""
        sealed = self._sealed.completion_times if self._sealed else []
        return len(self._gathered.completion_times) + len(sealed)

    @property
    def free(self) -> int:
        """How many more blocks may be taken."""
        return max(0, self.capacity - self.waiting)

    @property
    def fill_ratio(self) -> float:
        """How full it is; 1: no further block is taken."""
        return self.waiting / self.capacity

    @property
    def empty(self) -> bool:
        """Whether nothing waits."""
        gathered = self._gathered
        return self._sealed is None and gathered.batch.empty and not gathered.samples and not self._checkpoints

    @property
    def batch(self) -> Batch:
        """The batch that is being gathered."""
        return self._gathered.batch

    def add(self, owner: str, rows: Iterable[TableRow]) -> None:
        """Take rows of an asset, or of the service."""
        for table, values in rows:
            if table == "recent":
                self.add_block(owner, **values)
                continue
            # only the audit says when it was written: all else is the same for every run over the same samples
            at = {"at": time.time()} if table == "audit" else {}
            self._gathered.batch.rows[table].append({"asset": owner, **at, **values})

    def add_block(self, asset: str, sequence: int, samples: bytes, regular: bool) -> None:
        """Take a block of an asset under the store's number, packed as `pack_samples` does."""
        self._gathered.samples.append((asset, sequence, samples, regular))

    def set_checkpoint(self, asset: Asset, completed_at: float | None = None, *, can_wait: bool = False) -> None:
        """Take the state of an asset, after a block that had been complete at `completed_at`, if there was one.

        `can_wait`: whether the samples in the store lead to it.
        """
        if completed_at is not None:
            self._gathered.blocks[asset.name] += 1
            self._gathered.completion_times.append(completed_at)
        if not asset.has_state:
            return
        self._checkpoints[asset.name] = asset
        if not can_wait:
            self._urgent[asset.name] = None

    def set_checkpoints(self, assets: Iterable[Asset], completed_at: Iterable[float]) -> None:
        """Take the states of assets after a block of each, as `set_checkpoint` does; they can wait."""
        own = {asset.name: asset for asset in assets}
        self._gathered.blocks.update(own.keys())
        self._gathered.completion_times.extend(completed_at)
        self._checkpoints.update(own)

    def finish(self) -> None:
        """Let no checkpoint wait any longer: nothing follows."""
        self._urgent |= dict.fromkeys(self._checkpoints)

    def add_checkpoint(self, row: Mapping[str, Any]) -> None:
        """Take a checkpoint that is no asset's."""
        self._gathered.batch.checkpoints[row["asset"]] = {**row, "at": time.time()}

    def write(self) -> PendingCommit | None:
        """Write what was gathered; return what is stored now, or None if that was nothing.

        Raises StoreUnavailableError if the store cannot take it for now; nothing is lost, try again.
        """
        if self._sealed is None:
            if self.empty:
                return None
            self._sealed, self._gathered = self._seal(), PendingCommit()
        if time.monotonic() < self._retry_at:
            return None
        try:
            if not (self._in_doubt and self._store.last_commit(self._owner) == self._number + 1):
                for refused in self._store.write(self._sealed.batch, self._owner, self._number + 1):
                    log("error", "row set aside", **refused._asdict())
        except StoreUnavailableError:
            self._in_doubt = True
            self._retry_s = min(max(2.0 * self._retry_s, MIN_RETRY_S), MAX_RETRY_S)
            self._retry_at = time.monotonic() + self._retry_s
            self.unavailable_since = self.unavailable_since or time.time()
            raise
        stored, self._sealed = self._sealed, None
        self._number += 1
        self._in_doubt, self._retry_s, self._retry_at, self.unavailable_since = False, 0.0, 0.0, None
        return stored

    def _seal(self) -> PendingCommit:
        batch, count = self._gathered.batch, max(MIN_CHECKPOINTS, len(self._checkpoints) // CHECKPOINT_SHARE)
        waiting = (name for name in self._checkpoints if name not in self._urgent)  # the oldest first
        for name in [*self._urgent, *islice(waiting, count)]:
            asset = self._checkpoints.pop(name)
            state, batch.first_needed[name] = asset.renew_record(), asset.first_needed_sequence
            batch.checkpoints[name] = {
                "asset": name,
                "sequence": state.position.sequence,
                "state": pack_state(state),
                "status": asset.status(state),
                "at": time.time(),
            }
        self._urgent = {}
        batch.bundles = self._bundles.advance(self._gathered.samples, batch.first_needed)
        self._gathered.samples = []
        return self._gathered
