"""Recordings replayed as if they were measured now, at true or accelerated speed, once or over and over."""

from __future__ import annotations

import heapq
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import AwareDatetime

from servoscope.core.arrays import FloatArray
from servoscope.core.settings import NonNegative
from servoscope.models.loop import Loop
from servoscope.service.config_types import Seconds
from servoscope.service.sources.block import Block, ResumePosition
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.message import BlockDecoder, InboxMessage, SourceAsset, Transport
from servoscope.service.sources.settings import SourceSettings
from servoscope.signals import Recording
from servoscope.signals.readers import is_address, read
from servoscope.signals.readers.archives import archive_of
from servoscope.signals.readers.reader_process import run_restricted

SEPARATION_SAMPLES = 2  # sample times between two recordings, or two rounds: a gap, for they do not join


class ReplaySettings(SourceSettings):
    """A source of kind ``replay``."""

    asset_key: ClassVar[str] = "files"
    asset_example: ClassVar[str] = "recordings: files = [...]"

    kind: Literal["replay"] = "replay"

    speed: NonNegative = 1.0  # how many times as fast as they were recorded; 0: as fast as they are polled
    block: Seconds = 1.0  # length of a block [s]
    repeat: bool = False  # whether the recordings begin again when they have ended
    start: AwareDatetime | None = None  # time of the first sample; None: when the service first ran

    def carries(self, covariate: str, address: Any) -> bool:
        """Files have what the loop's columns name."""
        return True

    def create(self, name: str, assets: Mapping[str, SourceAsset], folder: Path) -> Inbox:
        """Return the source of these recordings."""
        files = {
            asset_name: (tuple(Path(file) if is_address(file) else folder / file for file in asset.address), asset.loop)
            for asset_name, asset in assets.items()
        }
        covariates = {asset_name: asset.covariates for asset_name, asset in assets.items()}
        return Inbox(ReplayTransport(self, files, covariates), BlockDecoder(), assets)


@dataclass(frozen=True, eq=False)
class ReplayStream:
    """The recordings of one asset, laid end to end and cut into blocks."""

    recordings: tuple[Recording, ...]  # what is replayed, in this order
    block_samples: int  # per block, at most: blocks end where a recording does
    repeat: bool  # whether it begins again
    covariates: tuple[str, ...] = ()  # channels that blocks carry beside r, u and y

    def block(self, asset: str, sequence: int, stream_start: float) -> Block | None:
        """Return a block of the stream that began at `stream_start` [UTC s]; None behind the end."""
        counts = [math.ceil(recording.samples / self.block_samples) for recording in self.recordings]
        lengths = [x.t[-1] - x.t[0] + SEPARATION_SAMPLES / x.sample_rate for x in self.recordings]
        rounds, within = divmod(sequence, sum(counts))
        if rounds and not self.repeat:
            return None
        start, place = rounds * sum(lengths), 0  # of the recording, in the stream [s]
        while within >= counts[place]:
            within, start, place = within - counts[place], start + lengths[place], place + 1
        recording = self.recordings[place]
        rows = slice(within * self.block_samples, min((within + 1) * self.block_samples, recording.samples))
        t = stream_start + start + (recording.t[rows] - recording.t[0])
        carried = [recording.channels[name][rows] for name in self.covariates]
        signals = np.stack([t, recording.r[rows], recording.u[rows], recording.y[rows], *carried])
        return Block.from_signals(asset, sequence, signals)


class ReplayTransport(Transport):
    """Replays recordings for several assets, in the order of time; it has nothing to release."""

    def __init__(
        self,
        settings: ReplaySettings,
        assets: Mapping[str, tuple[tuple[Path, ...], Loop]],
        covariates: Mapping[str, tuple[str, ...]] | None = None,
    ) -> None:
        """`covariates`: names of the channels that blocks of an asset carry."""
        super().__init__()
        self.settings, self.clock_rate = settings, settings.speed
        self._streams: dict[str, tuple[ReplayStream, float]] = {}  # with their start [UTC s], once it is open
        shared: dict[tuple[Path, str], Recording] = {}  # assets may replay the same file
        readable = tuple(dict.fromkeys(_place(path) for files, _ in assets.values() for path in files))
        for asset, (files, loop) in assets.items():
            for path in files:
                if (path, loop.hash()) not in shared:
                    shared[path, loop.hash()] = _read(path, loop, readable)
            samples = max(1, round(settings.block * loop.sample_rate))
            recordings = tuple(shared[path, loop.hash()] for path in files)
            carried = (covariates or {}).get(asset, ())
            self._streams[asset] = ReplayStream(recordings, samples, settings.repeat, carried), math.nan
        self._queue: list[tuple[float, int, Block]] = []  # a heap of the next block of each asset: end, order, block
        self._clock_origin = (0.0, 0.0)  # the same moment by the monotonic clock and by that of the samples

    def open(self, resume: Mapping[str, ResumePosition]) -> None:
        """Start, or continue behind `resume`; the clock of the replay continues with the samples, without a rush."""
        now = time.time() if self.settings.start is None else self.settings.start.timestamp()
        for order, (asset, (stream, _)) in enumerate(self._streams.items()):
            at = resume.get(asset, ResumePosition(-1, now))
            self._streams[asset] = stream, at.stream_start
            self._schedule(order, asset, at.sequence + 1)
        self._clock_origin = time.monotonic(), float(self._queue[0][2].t[0]) if self._queue else 0.0

    def _schedule(self, order: int, asset: str, sequence: int) -> None:
        stream, start = self._streams[asset]
        block = stream.block(asset, sequence, start)
        if block is not None:
            heapq.heappush(self._queue, (float(block.t[-1]), order, block))

    def _due(self, t: float, now: float) -> float:
        """Return when a time of the samples is reached, by the monotonic clock [s]."""
        began, first = self._clock_origin
        return began + (t - first) / self.settings.speed if self.settings.speed else now

    def receive(self, most: int) -> list[InboxMessage]:
        """Return the blocks that are due."""
        now, messages = time.monotonic(), list[InboxMessage]()
        while self._queue and len(messages) < most and (due := self._due(self._queue[0][0], now)) <= now:
            _, order, block = heapq.heappop(self._queue)
            messages.append(InboxMessage(block.asset, replace(block, completed_at=due), due))
            self._schedule(order, block.asset, block.sequence + 1)
        return messages

    @property
    def next_message_s(self) -> float:
        """How long until the next block is due [s]."""
        now = time.monotonic()
        return max(0.0, self._due(self._queue[0][0], now) - now) if self._queue else math.inf

    def close(self) -> None:
        """Stop."""
        self._queue.clear()


def _read(path: Path, loop: Loop, readable: tuple[Path, ...]) -> Recording:
    """Read a recording in a restricted process, which can open what is `readable`; a table is asked from here."""
    if is_address(path):
        return read(path, loop)
    place = _place(path)
    size = place.stat().st_size if place.exists() else 0
    about, columns = run_restricted(readable, path, size, f"{__name__}:pack_recording", path, loop)
    t, r, u, y, restart, run = columns[:6]
    channels = dict(zip(about["channels"], columns[6:], strict=True))
    about = {"name": path.name, "sample_rate": float(about["rate"]), "run": run.astype(np.int32)}
    return Recording(t, r, u, y, restart.astype(np.bool_), channels, **about)


def pack_recording(path: Path, loop: Loop) -> tuple[dict[str, Any], list[FloatArray]]:
    """Return the columns of a recording, as `run_restricted` takes them."""
    recording = read(path, loop)
    about = {"channels": list(recording.channels), "rate": recording.sample_rate}
    return about, [*recording.columns, *recording.channels.values()]


def _place(path: Path) -> Path:
    """Return the file that has to be opened: the archive, where a path leads into one."""
    archive = archive_of(path)
    return (archive[0] if archive else path).absolute()
