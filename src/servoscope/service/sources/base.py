"""What a source is: it returns blocks when they are due, and again after a restart those that were not acknowledged."""

from __future__ import annotations

import math
import threading
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

from pydantic import PrivateAttr

from servoscope.core.settings import Settings
from servoscope.models.loop import Loop
from servoscope.service.assets.reception import AssetTrouble
from servoscope.service.sources.block import Block, ResumePosition

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


class BlockSource(ABC):
    """Streams of blocks of several assets, which never end, as a rule.

    The service polls: one that cannot keep up, or cannot store, stops polling. Blocks that it has polled and not
    acknowledged are returned again after a restart.
    """

    clock_rate = (
        1.0  # how fast the clock of the samples runs: 1 where they are measured now; 0 where it waits for polls
    )

    # where it may note what must survive the process, however that ends; set before `open`. None: nowhere
    state_file: Path | None = None
    connected = True  # whether it is connected to where its blocks come from

    def __init__(self) -> None:
        self.rejections = RejectionCounter()  # what came and could not be used

    @property
    def trouble(self) -> str:
        """Why none of its assets can be followed as they should be, in words; empty: nothing is wrong."""
        return ""

    @property
    def asset_troubles(self) -> Mapping[str, AssetTrouble]:
        """Why some of its assets cannot be followed although it is connected."""
        return {}

    @property
    def update_intervals_s(self) -> Mapping[tuple[str, str], float]:
        """Time between two updates of single values, as measured, by asset and signal [s]; empty where blocks come."""
        return {}

    @property
    def layer_seconds(self) -> Mapping[str, float]:
        """Processor time of threads of its own so far, by layer [s]: receive, decode."""
        return {}

    @property
    def pause_s(self) -> float:
        """How long an asset may pause without being silent [s]; infinite while something of it may be on its way."""
        return 0.0

    def preview(self) -> Sequence[str]:
        """Return what it would do, line by line, for somebody who checks a service file; it need not be open."""
        return ()

    @abstractmethod
    def open(self, resume: Mapping[str, ResumePosition]) -> None:
        """Start; assets in `resume` continue behind that sequence, others start at their beginning."""

    @abstractmethod
    def poll(self, limit: int) -> list[Block]:
        """Return up to `limit` blocks that are due and were not returned before, in the order of time; at once."""

    def acknowledge(self, asset: str, blocks: int) -> None:  # noqa: B027 - a file or a history has to know nothing
        """Register that so many more of an asset's blocks are stored, in the order in which they were polled."""

    @property
    @abstractmethod
    def next_block_s(self) -> float:
        """How long until the next block may be due [s]; infinite where the source has ended."""

    @abstractmethod
    def close(self) -> None:
        """Stop."""


class SourceAsset(NamedTuple):
    """What a source is told of an asset: its loop, and the value of the settings' `asset_key`, if they have one."""

    loop: Loop
    address: Any
    ahead_s: float = math.inf  # how far its time stamps may be ahead of our clock [s]
    covariates: tuple[str, ...] = ()  # channels that its blocks carry beside r, u and y


class SourceSettings(Settings):
    """A table ``[sources.NAME]``; a subclass adds the keys of its kind and says which source it creates."""

    asset_key: ClassVar[str] = ""  # the key of ``[assets.NAME]`` under which such a source finds an asset; empty: none
    asset_example: ClassVar[str] = ""  # what to write there
    visit_changes: ClassVar[Mapping[str, Any]] = {}  # values of keys for a client that only listens for a while
    _is_visit: bool = PrivateAttr(default=False)

    kind: str

    def identity(self, name: str) -> str:
        """Return what no other source or outlet may share, in words; empty: nothing. `name`: as in `create`."""
        return ""

    def for_visit(self) -> Self:
        """Return the settings of a client that only listens for a while, beside a service that runs."""
        visit = self.model_copy(update=self.visit_changes)
        visit._is_visit = True
        return visit

    @property
    def is_visit(self) -> bool:
        """Whether the client only listens, and may hear what is not for its assets, too."""
        return self._is_visit

    @property
    def pause_s(self) -> float:
        """How long an asset may pause, as a rule, without being silent [s]."""
        return 0.0

    @property
    def is_exclusive(self) -> bool:
        """Whether one process has to follow all its assets."""
        return False

    def carries(self, covariate: str, address: Any) -> bool:
        """Return whether blocks of an asset carry a covariate; `address`: the value of `asset_key`, if there is one."""
        return False

    def create(self, name: str, assets: Mapping[str, SourceAsset], folder: Path) -> BlockSource:
        """Return the source, not yet open; `name` is unique among services, paths are relative to `folder`.

        Raises ConfigError if something that the settings name cannot be used.
        """
        raise NotImplementedError
