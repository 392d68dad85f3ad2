"""Recordings replayed as if they were measured now, at true or accelerated speed, once or over and over."""

from __future__ import annotations

import heapq
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import AwareDatetime

from servoscope.live.block import Block, Resume
from servoscope.live.refusals import Refusal
from servoscope.live.settings import Seconds
from servoscope.loop import Loop
from servoscope.readers import read
from servoscope.recording import Recording
from servoscope.settings import NotNegative, Settings

__all__ = ["Replay", "ReplaySettings", "Tape"]

SEAM = 2  # sample times between two recordings, or two rounds: a gap, for the one does not go on where the other ended


class ReplaySettings(Settings):
    """A source of kind ``replay``.

    Parameters
    ----------
    speed
        How many times as fast as they were recorded; 0: as fast as they are taken.
    block
        Length of a block [s].
    repeat
        Whether the recordings begin again when they have ended.
    start
        Time of the first sample; None: when the service first ran.
    """

    kind: Literal["replay"] = "replay"
    speed: NotNegative = 1.0
    block: Seconds = 1.0
    repeat: bool = False
    start: AwareDatetime | None = None


@dataclass(frozen=True, eq=False)
class Tape:
    """The recordings of one asset, laid end to end and cut into blocks.

    Parameters
    ----------
    recordings
        What is replayed, in this order.
    samples
        Per block, at most: blocks end where a recording does.
    repeat
        Whether it begins again.
    """

    recordings: tuple[Recording, ...]
    samples: int
    repeat: bool

    @property
    def _blocks(self) -> list[int]:
        return [math.ceil(recording.samples / self.samples) for recording in self.recordings]

    def locate(self, sequence: int) -> tuple[Recording, slice, float] | None:
        """Return a block's recording, its rows there, and the time of the tape where that recording begins [s].

        None behind the end.
        """
        blocks, periods = self._blocks, [SEAM / recording.sample_rate for recording in self.recordings]
        lengths = [x.t[-1] - x.t[0] + period for x, period in zip(self.recordings, periods, strict=True)]
        rounds, within = divmod(sequence, sum(blocks))
        if rounds and not self.repeat:
            return None
        begins = rounds * sum(lengths)
        for recording, count, length in zip(self.recordings, blocks, lengths, strict=True):
            if within < count:
                rows = slice(within * self.samples, min((within + 1) * self.samples, recording.samples))
                return recording, rows, begins
            within, begins = within - count, begins + length
        raise AssertionError("a block of the round lies in one of its recordings")

    def block(self, asset: str, sequence: int, began: float) -> Block | None:
        """Return a block; `began` is when the tape began [UTC s]. None behind the end."""
        found = self.locate(sequence)
        if found is None:
            return None
        recording, rows, begins = found
        t = began + begins + (recording.t[rows] - recording.t[0])
        return Block(asset, sequence, np.asarray(t), recording.r[rows], recording.u[rows], recording.y[rows])


@dataclass
class _Reel:
    """Where the replay of one asset stands."""

    asset: str
    tape: Tape
    began: float
    sequence: int


class Replay:
    """Replays recordings for several assets, in the order of time.

    Parameters
    ----------
    settings
        Of the source.
    assets
        The files and the loop of each asset.
    """

    def __init__(self, settings: ReplaySettings, assets: Mapping[str, tuple[tuple[Path, ...], Loop]]) -> None:
        self.settings = settings
        self._tapes: dict[str, Tape] = {}
        shared: dict[tuple[Path, str], Recording] = {}  # assets may replay the same file
        for asset, (files, loop) in assets.items():
            for path in files:
                if (path, loop.hash()) not in shared:
                    shared[path, loop.hash()] = read(path, loop)
            recordings = tuple(shared[path, loop.hash()] for path in files)
            self._tapes[asset] = Tape(recordings, max(1, round(settings.block * loop.sample_rate)), settings.repeat)
        self._next: list[tuple[float, int, _Reel, Block]] = []
        self._pace = (0.0, 0.0)

    up = True

    @property
    def pace(self) -> float:
        """How many times as fast as it was recorded."""
        return self.settings.speed

    def open(self, resume: Mapping[str, Resume]) -> None:
        """Begin, or go on where the streams were; the clock of the replay goes on with them, without a rush."""
        now = time.time() if self.settings.start is None else self.settings.start.timestamp()
        for order, (asset, tape) in enumerate(self._tapes.items()):
            at = resume.get(asset, Resume(-1, now))
            self._advance(order, _Reel(asset, tape, at.began, at.sequence + 1))
        first = self._next[0] if self._next else None
        self._pace = time.monotonic(), float(first[3].t[0]) if first else 0.0

    def _advance(self, order: int, reel: _Reel) -> None:
        block = reel.tape.block(reel.asset, reel.sequence, reel.began)
        if block is not None:
            heapq.heappush(self._next, (float(block.t[-1]), order, reel, block))

    def _due(self, t: float, now: float) -> float:
        """Return when a time of the replay is reached, by the monotonic clock [s]."""
        begun, first = self._pace
        return begun + (t - first) / self.settings.speed if self.settings.speed else now

    def poll(self, most: int) -> list[Block]:
        """Return the blocks that are due."""
        now, found = time.monotonic(), list[Block]()
        while self._next and len(found) < most and (due := self._due(self._next[0][0], now)) <= now:
            _, order, reel, block = heapq.heappop(self._next)
            found.append(Block(block.asset, block.sequence, block.t, block.r, block.u, block.y, due))
            reel.sequence += 1
            self._advance(order, reel)
        return found

    def acknowledge(self, asset: str, blocks: int) -> None:
        """Do nothing: a file is still there after a restart."""

    def refused(self) -> list[Refusal]:
        """Return nothing: files are checked when they are read."""
        return []

    @property
    def waits(self) -> float:
        """How long until the next block is due [s]."""
        now = time.monotonic()
        return max(0.0, self._due(self._next[0][0], now) - now) if self._next else math.inf

    def close(self) -> None:
        """Stop."""
        self._next.clear()
