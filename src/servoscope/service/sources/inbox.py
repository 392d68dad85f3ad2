"""The one source: messages of a transport to blocks in order; a message is released once all of it is stored."""

from __future__ import annotations

import math
import threading
import time
import zlib
from collections import defaultdict, deque
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from servoscope.core.errors import MessageError
from servoscope.core.messages import message as text
from servoscope.core.messages import render
from servoscope.service.assets.reception import Reception
from servoscope.service.log import log
from servoscope.service.sources.assembly import AssetStream, Receipt
from servoscope.service.sources.block import Block, ResumePosition
from servoscope.service.sources.guard import MessageGuard
from servoscope.service.sources.message import (
    Content,
    Decoder,
    InboxMessage,
    RejectionCounter,
    SignalValue,
    SourceAsset,
    Transport,
)

MAX_QUIET_S = 2.0  # without a message of an asset for so long, what has come of it is made a block, however short
MAX_TURN_S = 0.25  # that messages are decoded at once: then it is the turn of other sources
MAX_READY = 10_000  # blocks that wait where messages cannot; then the oldest are dropped, and counted
MARK = 2**32  # added to the checksum by which a message is known, so that it is never 0


class _UnstoredBlock(NamedTuple):
    """A block that is not stored: what its sender knows it by, if it keeps blocks; the messages that end in it."""

    position: tuple[int, int] | None
    receipts: list[Receipt]


class Inbox:
    """Makes blocks of the messages of some assets; one thread calls it.

    The service polls: one that cannot keep up, or cannot store, stops polling. Blocks that it has polled and not
    acknowledged are returned again after a restart.

    A message is released when every sample of it is in a block that is stored, or was refused and counted.

    Parameters
    ----------
    transport, decoder
        Where messages come from, and what they hold.
    assets
        Those of which blocks are made.
    rejections
        Counts what cannot be used; the decoder may have it, too.
    in_flight
        Most messages that their sender has open at a time.
    """

    def __init__(
        self,
        transport: Transport,
        decoder: Decoder,
        assets: Mapping[str, SourceAsset],
        rejections: RejectionCounter | None = None,
        in_flight: int = 10**9,
    ) -> None:
        self.rejections = rejections or RejectionCounter()  # what came and could not be used
        self.transport, self.decoder, self._assets = transport, decoder, assets
        self._in_flight, self.clock_rate = in_flight, transport.clock_rate
        transport.bind(decoder, self.rejections)
        # where messages in hand are noted, so that they survive the process; set before `open`. None: nowhere
        self.state_file: Path | None = None
        self._guard: MessageGuard | None = None
        self._resume: Mapping[str, ResumePosition] = {}
        self._streams: dict[str, AssetStream] = {}  # of the assets that single values have come of
        self._steps: Iterator[bool] = iter(())  # through the messages in hand: whether to go on
        self._is_busy = False
        self._ready = deque[Block]()
        self._unstored: defaultdict[str, deque[_UnstoredBlock]] = defaultdict(deque)  # ready or polled, in order
        self._newest: dict[str, tuple[int, int]] = {}  # stream and sequence of the newest numbered block
        self._confirmed: dict[str, tuple[int, int]] = {}

    def open(self, resume: Mapping[str, ResumePosition]) -> None:
        """Start; assets in `resume` continue behind that position."""
        self._resume = resume
        self._newest = {asset: (position.stream, position.sequence) for asset, position in resume.items()}
        self._confirmed = dict(self._newest)
        self.transport.state_file = self.state_file
        if self.state_file is not None and self.decoder.trial is not None:
            try:
                self._guard = MessageGuard(self.state_file, *self.decoder.trial)
            except OSError as error:
                log("warning", "messages in hand cannot be noted", file=str(self.state_file), why=error.strerror)
        self.decoder.open(resume)
        self.transport.open(resume)

    @property
    def connected(self) -> bool:
        """Whether the transport is connected."""
        return self.transport.connected

    @property
    def trouble(self) -> str:
        """Why nothing can be received, in words; empty: nothing is wrong."""
        return self.transport.trouble

    @property
    def asset_troubles(self) -> Mapping[str, Reception]:
        """Assets that come too slowly, or whose sender is gone or refuses them."""
        own = {name: stream.trouble for name, stream in self._streams.items() if stream.trouble is not None}
        return {**own, **self.transport.asset_troubles}

    @property
    def update_intervals_s(self) -> Mapping[tuple[str, str], float]:
        """Time between two updates of single values, as measured, by asset and signal [s]."""
        streams = self._streams.items()
        own = {(name, signal): s for name, stream in streams for signal, s in stream.intervals_s.items()}
        return {**own, **self.transport.update_intervals_s}

    @property
    def pause_s(self) -> float:
        """How long an asset may pause without being silent [s]; infinite while something may be on its way."""
        pause_s = self.transport.pause_s  # first: what its thread hands over meanwhile is seen behind it
        return math.inf if pause_s > 0.0 and self.next_block_s == 0.0 else pause_s

    @property
    def next_block_s(self) -> float:
        """How long until the next block may be due [s]."""
        return 0.0 if self._ready or self._is_busy else self.transport.next_message_s

    def poll(self, limit: int) -> list[Block]:
        """Return up to so many blocks, in the order in which they were complete."""
        self._take_messages(limit if self.transport.keeps else len(self._ready) + MAX_READY)
        while len(self._ready) > MAX_READY and not self.transport.keeps:
            lost = self._ready.popleft()
            self._unstored[lost.asset].popleft()
            self.rejections.add(lost.asset, "overflow", "blocks wait longer than there is room for them")
        return [self._ready.popleft() for _ in range(min(limit, len(self._ready)))]

    def _take_messages(self, limit: int) -> None:
        """Decode messages until so many blocks wait, nothing has come, or it takes too long."""
        deadline, self._is_busy = time.monotonic() + MAX_TURN_S, False
        while len(self._ready) < limit:
            can_go_on = next(self._steps, None)
            if can_go_on is None:
                room = limit - len(self._ready)
                messages = self.transport.receive(room) if room > 0 else ()
                if not messages:
                    break
                self._steps = self._take(messages)
            elif not can_go_on or time.monotonic() > deadline:
                self._is_busy = True
                break
        else:
            self._is_busy = True
        if self._guard is not None:
            self._guard.end()
        if self._streams:
            # no more may come before some of these are released
            is_full = sum(len(stream.open) for stream in self._streams.values()) > self._in_flight // 2
            quiet_s = max(MAX_QUIET_S, 2.0 * self.decoder.block_s)
            self._flush(math.inf if is_full else time.monotonic() - quiet_s)

    def _take(self, messages: Sequence[InboxMessage]) -> Iterator[bool]:
        """Take messages one by one, and block by block; yield whether to go on now."""
        is_guarded = self._guard is not None
        decoded = self._decode_guarded(messages) if is_guarded else map(self.decoder.try_decode, messages)
        for message in messages:
            yield True
            while (content := next(decoded)) is None:
                yield False
            for address, request in self.decoder.requests():
                self.transport.send(address, request)
            if isinstance(content, MessageError):
                if content.kind == "unknown asset":
                    self.transport.leave(message.address)
                self.rejections.add(self.decoder.find_asset(message.address), content.kind, str(content))
                message.release()
                continue
            receipt = Receipt(message.release)
            if content.values or content.gone:
                self._take_values(message, content, receipt)
            for block in content.blocks:
                yield True  # before it is taken: behind the last one the message is released without another poll
                self._take_block(block, receipt)
            receipt.release()

    def _decode_guarded(self, messages: Sequence[InboxMessage]) -> Iterator[Content | MessageError | None]:
        """Yield what each message holds, or why it is refused; None while one is tried in another process."""
        assert self._guard is not None
        for message in messages:
            mark = _mark(message)
            tried = mark, message.address, message.content
            if self._guard.is_suspect(mark):  # what comes behind it waits, for seconds perhaps; other sources do not
                trial = threading.Thread(target=self._guard.try_message, args=tried, daemon=True)
                trial.start()
                while trial.is_alive():
                    yield None
            try:
                self._guard.check(*tried)
            except MessageError as error:
                yield error
            else:
                self._guard.begin(mark)
                yield self.decoder.try_decode(message)

    def _take_block(self, block: Block, receipt: Receipt) -> None:
        """Take a block that its sender has numbered, unless it sends again one that comes before."""
        position = block.stream, block.sequence
        if block.oldest is not None:
            stream, sequence = self._newest.get(block.asset, (0, -1))
            following = sequence + 1 if stream == block.stream else 0
            if block.stream >= stream and block.sequence > max(following, block.oldest):
                why = f"block {block.sequence} came before block {following}, which its sender keeps"
                self.rejections.add(block.asset, "ahead", why)
                return
        self._newest[block.asset] = max(position, self._newest.get(block.asset, position))
        receipt.holders += 1
        self._ready.append(block)
        self._unstored[block.asset].append(_UnstoredBlock(position if block.retained else None, [receipt]))

    def _stream(self, asset: str) -> AssetStream:
        """Return the stream of an asset, which begins with its first values."""
        if (stream := self._streams.get(asset)) is None:
            told, decoder = self._assets[asset], self.decoder
            at = self._resume.get(asset, ResumePosition(-1, math.nan))
            block_s, lists = decoder.block_s, (decoder.covariates, told.covariates)
            stream = AssetStream(asset, at, self.rejections, told.loop.sample_rate, block_s, decoder.hold_s, *lists)
            self._streams[asset] = stream
        return stream

    def _take_values(self, message: InboxMessage, content: Content, receipt: Receipt) -> None:
        """Take single values, and that assets are gone."""
        if message.is_old and not self.decoder.is_dated:
            why = "the broker had kept it, and it does not say when it was sent"
            self.rejections.add(self.decoder.find_asset(message.address), "retained", why)
            return
        for name in content.gone:
            stream = self._stream(name)
            self._collect(stream, short=True)
            stream.restart()
            stream.trouble = Reception("silent", render(text("service.trouble.death", topic=message.address)))
        now = time.time()
        for name, values in content.values.items():
            values = self._drop_future(name, values, now + self._assets[name].ahead_s)
            if not values:
                continue
            stream = self._stream(name)
            stream.hold(values, receipt)
            if self.decoder.is_dated and stream.knows(_mark(message)):
                self.rejections.add(name, "repeated", "the same message once more")
                self._collect(stream, short=False)
            elif stream.take(values, content.complete):
                self._collect(stream, short=False)

    def _drop_future(self, name: str, values: list[SignalValue], latest: float) -> list[SignalValue]:
        """Return the values that do not claim to be later than that [UTC s]; count others."""
        credible = [value for value in values if value.t <= latest]
        if len(credible) < len(values):
            words = text("service.reception.future", ahead_s=round(max(value.t for value in values) - latest, 1))
            self.rejections.add(name, "future", render(words), len(values) - len(credible))
        return credible

    def _collect(self, stream: AssetStream, *, short: bool) -> None:
        """Take the blocks of an asset that are complete, and see which messages end in them."""
        unstored = self._unstored[stream.asset]
        for block in stream.collect_blocks(short=short):
            self._ready.append(block)
            unstored.append(_UnstoredBlock(None, []))
        for receipt in stream.take_closed():
            if unstored:
                unstored[-1].receipts.append(receipt)
            else:
                receipt.release()

    def _flush(self, heard_before: float) -> None:
        """Make blocks, however short, of assets without r, u and y since then, by the monotonic clock [s]."""
        for stream in self._streams.values():
            if stream.heard_at < heard_before and not stream.is_flushed:
                self._collect(stream, short=True)
                stream.is_flushed = True

    def refuse(self, block: Block, kind: str, why: str) -> None:
        """Count a block that the service has left out for its time stamps, before it is acknowledged."""
        self.rejections.add(block.asset, kind, why)
        if kind == "future":
            self.decoder.refuse(block)

    def acknowledge(self, asset: str, blocks: int) -> None:
        """Release the messages that end in so many more blocks, and confirm these to a sender that keeps them."""
        last: tuple[int, int] | None = None
        for _ in range(blocks):
            position, receipts = self._unstored[asset].popleft()
            for receipt in receipts:
                receipt.release()
            if position is not None:
                last = self._confirmed[asset] = max(position, self._confirmed.get(asset, position))
        if last is not None:
            self.transport.confirm(asset, *last)

    def close(self) -> None:
        """Stop."""
        self.transport.close()


def _mark(message: InboxMessage) -> int:
    """Return the number by which a message is known."""
    return MARK | zlib.crc32(message.content, zlib.crc32(message.address.encode()))
