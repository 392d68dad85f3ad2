"""From the rows of log files to blocks: each row counts once, whichever file it is in."""

from __future__ import annotations

import heapq
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from servoscope.core.messages import message as text
from servoscope.core.messages import render
from servoscope.service.log import log
from servoscope.service.sources.block import Block, ResumePosition
from servoscope.service.sources.log_files import FileRows, ReadFile
from servoscope.service.sources.message import Content, Decoder, InboxMessage, RejectionCounter, SourceAsset


class LogDecoder(Decoder):
    """Cuts the rows of files into blocks, those that were not counted before, whichever file they are in.

    `block_s`: length of a block [s]; `begin_times` returns up to when the rows of each asset were counted [UTC s].
    """

    def __init__(
        self,
        block_s: float,
        begin_times: Callable[[Mapping[str, ResumePosition]], Mapping[str, float]],
        assets: Mapping[str, SourceAsset],
        rejections: RejectionCounter,
    ) -> None:
        self._block_s, self._begin_times, self._assets, self._rejections = block_s, begin_times, assets, rejections
        self._counted: dict[str, float] = {}  # by asset, up to when its rows are in blocks [UTC s]
        self._sequences: dict[str, int] = {}
        # by asset, the files whose blocks are not stored yet, each with the number of the last one
        self._open: dict[str, deque[tuple[int, ReadFile]]] = defaultdict(deque)

    def open(self, resume: Mapping[str, ResumePosition]) -> None:
        """Begin; assets in `resume` continue behind the last row that was counted."""
        self._counted = dict(self._begin_times(resume))
        self._sequences = {name: resume[name].sequence if name in resume else -1 for name in self._assets}

    def decode(self, message: InboxMessage) -> Content:
        """Return the blocks of the rows of a file that were not counted before, in the order of time."""
        read: ReadFile = message.content
        firsts = {name: self._first_new(name, rows) for name, rows in read.rows.items()}
        total = sum(rows.samples.t.size for rows in read.rows.values())
        log("info", "file read", file=read.file.name, rows=total, new=total - sum(firsts.values()))
        for name, rows in read.rows.items():
            if firsts[name] == rows.samples.t.size and read.is_new:
                self._rejections.add(name, "late", render(text("service.folder.late", file=read.file.name)))
                read.is_failed = True
        streams = (self._cut_asset(name, read, first) for name, first in firsts.items())
        return Content(blocks=heapq.merge(*streams, key=lambda block: float(block.t[-1])))

    def refuse(self, block: Block) -> None:
        """Take back a block that is ahead of the clock by now: later ones must not be late because of it."""
        period_s = 1.0 / self._assets[block.asset].loop.sample_rate
        self._counted[block.asset] = min(self._counted[block.asset], float(block.t[0]) - period_s)
        for last, read in self._open[block.asset]:
            if last >= block.sequence:
                read.is_refused = True
                break

    def _first_new(self, name: str, rows: FileRows) -> int:
        half_s = 0.5 / self._assets[name].loop.sample_rate
        return int(np.searchsorted(rows.samples.t, self._counted[name] + half_s - rows.offset, side="right"))

    def _cut_asset(self, name: str, read: ReadFile, first: int) -> Iterator[Block]:
        asset, rows, files = self._assets[name], read.rows[name], self._open[name]
        samples = rows.samples
        while files and files[0][1].is_released:
            files.popleft()
        size = max(1, round(self._block_s * asset.loop.sample_rate))
        channels = [samples.channels[covariate] for covariate in asset.covariates]
        begins = range(first, samples.t.size, size)
        files.append((self._sequences[name] + len(begins), read))
        for begin in begins:
            columns = (samples.t, samples.r, samples.u, samples.y, *channels)
            signals = np.stack([column[begin : begin + size] for column in columns])
            signals[0] += rows.offset
            self._sequences[name] += 1
            self._counted[name] = float(signals[0, -1])
            yield Block.from_signals(name, self._sequences[name], signals, time.monotonic())
