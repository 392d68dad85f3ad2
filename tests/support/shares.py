"""A folder of logs, a source that follows it, and what was counted of it."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import halls
import numpy as np
from brokers import until

from servoscope.models.loop import Loop
from servoscope.service.sources.block import Block, ResumePosition
from servoscope.service.sources.folder import FolderSettings
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.message import Rejection, SourceAsset

LOOP = Loop.load(halls.LOOP)  # at 100 Hz
BEGAN = 1767225600.0  # 2026-01-01T00:00:00Z
QUICK = {"complete_after_s": 0.05, "poll_s": 0.02, "interval_s": 1.0, "block": 0.5}


def rows(first: int, count: int, *, origin: float = BEGAN) -> list[tuple[float, float, float, float]]:
    """Return rows number `first` and following of a log; the number of a row is its r."""
    return [(origin + 0.01 * k, float(k), k + 0.5, 2.0 * k) for k in range(first, first + count)]


def csv(*lines: tuple[Any, ...], header: str = "t,r,u,y") -> str:
    return "\n".join([header, *(",".join(map(repr, line)) for line in lines)]) + "\n"


class Share:
    """A folder of logs, and a source that follows it, which may be killed."""

    def __init__(self, folder: Path, *assets: str, loop: Loop = LOOP, **settings: Any) -> None:
        self.folder, self.assets = folder / "share", assets or ("press",)
        self.folder.mkdir(parents=True)
        self.settings = FolderSettings.model_validate({"kind": "folder", "path": "share", **QUICK, **settings})
        self.loop, self.kept = loop, dict[str, ResumePosition]()
        self.counted: dict[str, list[np.ndarray]] = {name: [] for name in self.assets}
        self.rejections = Counter[str]()
        self.reasons: list[Rejection] = []
        self.source: Inbox | None = None
        self.ahead_s = np.inf
        self.note: Path | None = None  # where the source notes what must survive it

    def put(self, name: str, content: str | bytes, *, modified: float | None = None) -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        if modified is not None:
            os.utime(path, (modified, modified))
        return path

    def open(self) -> Inbox:
        assets = {name: SourceAsset(self.loop, None, self.ahead_s) for name in self.assets}
        self.source = self.settings.create("hall.share", assets, self.folder.parent)
        self.source.state_file = self.note
        self.source.open(self.kept)
        return self.source

    def turn(self, limit: int = 1000, *, commit: bool = True) -> list[Block]:
        """Poll, and store what came."""
        assert self.source is not None
        blocks = self.source.poll(limit)
        if commit:
            for block in blocks:
                self.counted[block.asset].append(block.signals)
                self.kept[block.asset] = ResumePosition(block.sequence, BEGAN, 0, float(block.t[-1]))
                self.source.acknowledge(block.asset, 1)
        for one in self.source.rejections.take():
            self.rejections[one.kind] += one.count
            self.reasons.append(one)
        return blocks

    def kill(self) -> None:
        assert self.source is not None
        self.source.close()

    def rows_of(self, asset: str = "press") -> list[float]:
        return np.concatenate([block[1] for block in self.counted[asset]] or [np.zeros(0)]).tolist()

    def until(self, holds: Callable[[], Any], seconds: float = 60.0) -> None:
        until(lambda: (self.turn(), holds())[1], seconds)

    def until_rows(self, count: int, asset: str = "press") -> list[float]:
        self.until(lambda: len(self.rows_of(asset)) >= count)
        return self.rows_of(asset)

    def settle(self) -> None:
        """Wait until nothing waits any more."""
        self.until(lambda: self.source is not None and self.source.pause_s < np.inf)
