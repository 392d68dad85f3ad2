"""What came from outside and could not be used: counted by case, told from time to time, never in silence."""

from __future__ import annotations

import threading
from collections import Counter
from typing import NamedTuple

__all__ = ["Refusal", "Refusals"]


class Refusal(NamedTuple):
    """Messages of one kind that could not be used: whose, which case, how many, and why the last one."""

    asset: str
    kind: str
    number: int
    why: str


class Refusals:
    """Counts, from any thread; memory stays bounded whatever comes."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._fresh: Counter[tuple[str, str]] = Counter()
        self._why: dict[tuple[str, str], str] = {}

    def add(self, asset: str, kind: str, why: str, number: int = 1) -> None:
        """Count one; `asset` must be one that is known, or empty."""
        with self._lock:
            self._fresh[asset, kind] += number
            self._why[asset, kind] = why

    def taken(self) -> list[Refusal]:
        """Return what came since the last call."""
        with self._lock:
            found = [
                Refusal(asset, kind, number, self._why[asset, kind]) for (asset, kind), number in self._fresh.items()
            ]
            self._fresh.clear()
            self._why.clear()
        return found
