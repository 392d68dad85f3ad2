"""What a source is: it returns blocks when they are due, and again after a restart those that were not acknowledged."""

from __future__ import annotations

import math
import threading
from collections import Counter
from dataclasses import dataclass
from typing import Any, NamedTuple

from servoscope.models.loop import Loop

CHECKS = {  # what every source guarantees; tests/service/test_source_contract.py runs them for each kind
    "numbering": "the blocks of an asset are numbered 0, 1, 2 ... without holes",
    "limit": "`poll` returns at most as many blocks as it was asked for, and each block once",
    "idle": "`poll` and `next_block_s` return at once where there is nothing",
    "repetition": "a block that was not acknowledged is returned again after a restart",
    "resumption": "after a restart an asset continues behind the block that was counted last",
    "closing": "`close` may be called twice, and before anything has come",
}


@dataclass(frozen=True)
class Rejection:
    """Messages of one kind that could not be used: of which asset, how many, and why the last one."""

    asset: str
    kind: str
    count: int
    reason: str


class RejectionCounter:
    """Counts rejected messages, from any thread; its memory stays bounded whatever comes."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[tuple[str, str]] = Counter()
        self._reasons: dict[tuple[str, str], str] = {}

    def add(self, asset: str, kind: str, reason: str, count: int = 1) -> None:
        """Count one; `asset` must be a known one, or empty."""
        with self._lock:
            self._counts[asset, kind] += count
            self._reasons[asset, kind] = reason

    def take(self) -> list[Rejection]:
        """Return what was rejected since the last call."""
        with self._lock:
            counts, self._counts = self._counts, Counter()
        return [Rejection(*key, count, self._reasons[key]) for key, count in counts.items()]


class SourceAsset(NamedTuple):
    """What a source is told of an asset: its loop, and the value of the settings' `asset_key`, if they have one."""

    loop: Loop
    address: Any
    ahead_s: float = math.inf  # how far its time stamps may be ahead of our clock [s]
    covariates: tuple[str, ...] = ()  # channels that its blocks carry beside r, u and y
