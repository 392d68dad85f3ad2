"""Blocks from a plant's messages, and which messages are safe once a block is stored."""

from __future__ import annotations

import math
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import MessageError
from servoscope.core.messages import message, render
from servoscope.service.assets.reception import AssetTrouble
from servoscope.service.log import log
from servoscope.service.mapping.guard import MessageGuard
from servoscope.service.mapping.rows import MessageContent, MessageMapping, SignalValue
from servoscope.service.mapping.settings import PayloadSettings
from servoscope.service.sources.assembly import SIGNALS, BlockAssembler
from servoscope.service.sources.base import BlockSource, RejectionCounter, SourceAsset
from servoscope.service.sources.block import Block, ResumePosition

POLL_S = 0.02
MAX_QUIET_S = 2.0  # without a message of an asset for so long, what has come of it is made a block, however short
MAX_KNOWN_MESSAGES = 1000  # messages of an asset by which one that comes again is known
MAX_VALUES = 100_000  # of a signal, between two looks at what is complete
SETTLED_PERIOD_SHARE = 0.75  # of a period: behind a row with all signals nothing of its moment comes
MARK = 2**32  # added to the checksum by which a message is known, so that it is never 0
LAG_S = 2.0  # how far a signal may be behind others, which come in messages of their own, by time stamps


class Receipt:
    """A message that came: `release` calls `acknowledge` when all assets that it tells of have released it."""

    def __init__(self, acknowledge: Callable[[], None]) -> None:
        self._acknowledge, self.holders = acknowledge, 1

    def release(self) -> None:
        """Release it for one asset, or for whom it was made by."""
        self.holders -= 1
        if not self.holders:
            self._acknowledge()


class _OpenMessage(NamedTuple):
    """The times of an asset's values in a message [UTC s]: until none of them waits, some are in no block."""

    first: float
    last: float
    receipt: Receipt

    def waits(self, times: FloatArray) -> bool:
        at = int(np.searchsorted(times, self.first))
        return at < times.size and times[at] <= self.last


class _AssetStream:
    """What has come of one asset, and is in no block that is stored."""

    def __init__(self, assembler: BlockAssembler, span_s: float, covariates: Sequence[str]) -> None:
        """`covariates`: those of the messages, in their order; the asset wants some of them, in its own."""
        self.assembler, self._span_s = assembler, span_s
        known = (*SIGNALS, *covariates)
        self._places = [assembler.signals.index(one) if one in assembler.signals else -1 for one in known]
        self.open = deque[_OpenMessage]()
        self.polled = deque[tuple[Receipt, ...]]()  # by block that was polled, in order
        self.ready = deque[tuple[Block, list[Receipt]]]()
        self._seen: dict[int, None] = {}
        self.trouble: AssetTrouble | None = None
        # heard_at: when r, u or y came last, by the monotonic clock [s]
        self.heard_at, self.values, self._from = time.monotonic(), 0, math.nan
        self._newest, self._complete, self.is_flushed = [-math.inf] * len(SIGNALS), False, True

    def restart(self) -> None:
        """Begin anew: what signals were before is unknown."""
        self.assembler.resampler.restart(math.nan)
        self._newest = [-math.inf] * len(SIGNALS)

    def knows(self, mark: int) -> bool:
        """Return whether a message of this mark was among the last ones; remember it."""
        known = mark in self._seen
        self._seen[mark] = None
        if len(self._seen) > MAX_KNOWN_MESSAGES:
            del self._seen[next(iter(self._seen))]
        return known

    def add(self, values: list[SignalValue], complete: bool) -> None:
        """Take values; `complete`: each moment of them has all signals."""
        newest, sampled = self._newest, False
        for signal, t, value in values:
            place = self._places[signal]
            if place < 0:
                continue
            self.assembler.add(place, t, value)
            self.assembler.rates[place].add(t, value)
            if place < len(SIGNALS):
                newest[place], sampled = max(newest[place], t), True
        self.values, self.is_flushed = self.values + len(values), False
        if sampled:
            self._complete, self.heard_at = complete, time.monotonic()
            if self.trouble is not None and self.trouble.state == "silent":
                self.trouble = None
        if math.isnan(self._from):
            self._from = values[0].t
        if abs(values[-1].t - self._from) >= self._span_s or self.values >= len(SIGNALS) * MAX_VALUES:
            self.collect(short=False)

    def collect(self, *, short: bool) -> None:
        """Make the blocks that are complete, and see which messages are in them."""
        assembler, self.values = self.assembler, 0
        last = max(self._newest)
        settled = last + SETTLED_PERIOD_SHARE * assembler.period if self._complete else last
        if not (self._complete or short):  # others may still come for what one signal has reached
            settled = max(min(self._newest), last - max(LAG_S, self._span_s))
        assembler.collect(-math.inf, settled)
        if short:  # a machine that is off makes no samples, while its thermometer goes on: no message waits for them
            assembler.resampler.take_covariates()
        if self.trouble is None or self.trouble.state == "slow":
            words = [assembler.describe_slow(k, interval_ms) for k, interval_ms in assembler.slow_ms.items()]
            self.trouble = AssetTrouble("slow", ", ".join(words)) if words else None
        if self.trouble is not None:
            assembler.discard(0, self.trouble.state, self.trouble.why)
        blocks = assembler.take_blocks(short=short)
        self.ready.extend((block, []) for block in blocks)
        self._from = last - assembler.buffered * assembler.period if math.isfinite(last) else math.nan
        times = assembler.waiting_times
        waiting = deque[_OpenMessage]()
        for one in self.open:
            if one.waits(times):
                waiting.append(one)
            elif self.ready:
                self.ready[-1][1].append(one.receipt)
            elif self.polled:
                self.polled[-1] += (one.receipt,)
            else:
                one.receipt.release()
        self.open = waiting


class MessageCollector:
    """Collects the messages of some assets; `limit`: most that the sender has open at a time.

    `add` is called from one thread, all else from any.

    A message is acknowledged when every sample of it is in a block that is stored, or was refused and counted.
    """

    def __init__(
        self,
        settings: PayloadSettings,
        assets: Mapping[str, SourceAsset],
        rejections: RejectionCounter,
        limit: int,
    ) -> None:
        self._settings, self._assets, self._rejections, self._limit = settings, assets, rejections, limit
        self._rates = {name: one.loop.sample_rate for name, one in assets.items()}
        self.mapping = MessageMapping(settings, self._rates, rejections.add)
        self._guard: MessageGuard | None = None
        self._lock = threading.RLock()
        self._streams: dict[str, _AssetStream] = {}
        self.waiting = 0  # blocks that are not polled

    def open(self, resume: Mapping[str, ResumePosition], state_file: Path | None = None) -> None:
        """Begin; assets in `resume` continue behind what was counted. `state_file`: as in `BlockSource`."""
        if state_file is not None:
            try:
                self._guard = MessageGuard(state_file, self._settings, self._rates)
            except OSError as error:
                log("warning", "messages in hand cannot be noted", file=str(state_file), why=error.strerror)
        for name, asset in self._assets.items():
            rate = asset.loop.sample_rate
            at, size = resume.get(name, ResumePosition(-1, math.nan)), max(1, round(self._settings.block * rate))
            assembler = BlockAssembler(name, at, self._rejections, rate, size, self._settings.hold_s, asset.covariates)
            covariates = tuple(self._settings.fields.covariates)
            self._streams[name] = _AssetStream(assembler, (size - 0.5) / rate, covariates)
            self._streams[name].restart()

    def add(self, topic: str, content: bytes, acknowledge: Callable[[], None], *, old: bool = False) -> None:
        """Take a message; `old`: it was sent before we listened."""
        mark, receipt = MARK | zlib.crc32(content, zlib.crc32(topic.encode())), Receipt(acknowledge)
        try:
            if self._guard is not None:
                self._guard.check(mark, topic, content)  # for some seconds perhaps: nobody waits for the lock meanwhile
                self._guard.begin(mark)
            if old and not self._settings.time:
                raise MessageError("retained", "the broker had kept it, and it does not say when it was sent")
            found = self.mapping.read(topic, content, time.time())
            with self._lock:
                self._add(topic, found, mark, receipt)
        except MessageError as error:
            self._rejections.add(self.mapping.find_asset(topic), error.kind, str(error))
        if self._guard is not None:
            self._guard.end()
        with self._lock:
            receipt.release()
            # no more may come before some of these are acknowledged
            if sum(len(one.open) for one in self._streams.values()) > self._limit // 2:
                self._flush(math.inf)

    def _add(self, topic: str, found: MessageContent, mark: int, receipt: Receipt) -> None:
        for name in found.gone:
            stream = self._streams[name]
            stream.collect(short=True)
            stream.restart()
            stream.trouble = AssetTrouble("silent", render(message("service.trouble.death", topic=topic)))
        now = time.time()
        for name, values in found.values.items():
            stream, latest = self._streams[name], now + self._assets[name].ahead_s
            values = self._drop_future(name, values, latest)
            if not values:
                continue
            times = [one.t for one in values]
            receipt.holders += 1
            stream.open.append(_OpenMessage(min(times), max(times), receipt))
            if self._settings.time and stream.knows(mark):
                self._rejections.add(name, "repeated", "the same message once more")
                stream.collect(short=False)
                continue
            stream.add(values, found.complete)
        self._count()

    def _drop_future(self, name: str, values: list[SignalValue], latest: float) -> list[SignalValue]:
        """Return the values that do not claim to be later than that [UTC s]; count others."""
        credible = [one for one in values if one.t <= latest]
        if len(credible) < len(values):
            words = message("service.reception.future", ahead_s=round(max(one.t for one in values) - latest, 1))
            self._rejections.add(name, "future", render(words), len(values) - len(credible))
        return credible

    def _count(self) -> None:
        self.waiting = sum(len(one.ready) for one in self._streams.values())

    def _flush(self, heard_before: float) -> None:
        """Make blocks, however short, of assets without r, u and y since then, by the monotonic clock [s]."""
        for stream in self._streams.values():
            if stream.heard_at < heard_before and not stream.is_flushed:
                stream.collect(short=True)
                stream.is_flushed = True
        self._count()

    def poll(self, limit: int) -> list[Block]:
        """Return up to so many blocks that are complete."""
        with self._lock:
            self._flush(time.monotonic() - max(MAX_QUIET_S, 2.0 * self._settings.block))
            found = list[Block]()
            for stream in self._streams.values():
                while stream.ready and len(found) < limit:
                    block, receipts = stream.ready.popleft()
                    stream.polled.append(tuple(receipts))
                    found.append(block)
            self._count()
            return found

    def acknowledge(self, asset: str, blocks: int) -> None:
        """Register that so many more blocks of an asset are stored."""
        with self._lock:
            for _ in range(blocks):
                for receipt in self._streams[asset].polled.popleft():
                    receipt.release()

    @property
    def troubles(self) -> dict[str, AssetTrouble]:
        """Assets that come too slowly, or whose sender has said that it is gone."""
        return {name: one.trouble for name, one in self._streams.items() if one.trouble is not None}

    @property
    def update_intervals_s(self) -> dict[tuple[str, str], float]:
        """Time between two updates, as measured, by asset and signal [s]."""
        return {
            (name, signal): value
            for name, one in self._streams.items()
            for signal, value in one.assembler.intervals_s.items()
        }


class MessageSource(BlockSource):
    """A source of a plant's messages: its collector has the blocks, and knows what each asset lacks."""

    _collector: MessageCollector

    @property
    def asset_troubles(self) -> Mapping[str, AssetTrouble]:
        """Assets that come too slowly, or whose sender has said that it is gone."""
        return self._collector.troubles

    @property
    def update_intervals_s(self) -> Mapping[tuple[str, str], float]:
        """Time between two updates, as measured, by asset and signal [s]."""
        return self._collector.update_intervals_s

    def poll(self, limit: int) -> list[Block]:
        """Return blocks that are complete."""
        return self._collector.poll(limit)

    def acknowledge(self, asset: str, blocks: int) -> None:
        """Acknowledge the messages of which every sample is stored."""
        self._collector.acknowledge(asset, blocks)

    @property
    def next_block_s(self) -> float:
        """How long until the next block may be due [s]."""
        return 0.0 if self._collector.waiting else POLL_S
