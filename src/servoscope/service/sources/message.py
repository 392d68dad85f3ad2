"""What an inbox is made of: transports, which receive messages, and decoders, which say what a message holds."""

from __future__ import annotations

import math
import threading
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from servoscope.core.errors import MessageError
from servoscope.core.texts import clean_text
from servoscope.models.loop import Loop
from servoscope.service.assets.reception import Reception
from servoscope.service.sources.block import Block, ResumePosition

POLL_S = 0.02  # between two looks at a transport whose messages come from a thread of its own
NOTHING: Mapping[Any, Any] = MappingProxyType({})

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
            self._reasons[asset, kind] = clean_text(reason)  # it comes from outside, and goes everywhere

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
    alone: bool = False  # whether these are all that counts: messages need no r, u and y


class InboxMessage(NamedTuple):
    """What a transport has received; `address`: from where."""

    address: str
    content: Any  # bytes, or what the transport's library makes of them
    at: float  # when it came, by the monotonic clock [s]
    # called once all of it is stored or refused: it need not come again; by default the transport keeps no messages
    release: Callable[[], None] = lambda: None
    is_old: bool = False  # whether it was sent before anybody listened


class SignalValue(NamedTuple):
    """A value of one signal."""

    signal: int  # place among r, u, y and the decoder's covariates
    t: float  # [UTC s]
    value: float  # NaN: it is known to be bad


class Content(NamedTuple):
    """What a message holds: single values, or blocks as their sender has numbered them."""

    values: Mapping[str, list[SignalValue]] = NOTHING  # by asset
    gone: frozenset[str] = frozenset()  # assets whose sender says that it ends
    complete: bool = False  # whether each moment of the values has r, u and y
    blocks: Iterable[Block] = ()  # taken one by one, when there is room for them


class Decoder(ABC):
    """Says what messages hold; one thread calls it."""

    covariates: Sequence[str] = ()  # signals of its values behind r, u and y
    block_s = 1.0  # length of the blocks that are made of its values [s]
    hold_s = 0.0  # how long a value holds where only changes are sent [s]
    is_dated = True  # whether messages say when they were measured, so that the same bytes are the same message
    # a task for `core.workers`, and its first arguments, that decodes a message in a process with limits; None: there
    # is none, and no message can hang it
    trial: tuple[Any, ...] | None = None

    def open(self, resume: Mapping[str, ResumePosition]) -> None:  # noqa: B027 - most keep nothing of an asset
        """Begin; assets in `resume` continue behind that position."""

    def addresses(self, *, everyone: bool = False) -> Sequence[str]:
        """Return what its messages come from, for the transport; `everyone`: those of other assets, too."""
        return ()

    def find_asset(self, address: str) -> str:
        """Return which asset an address names; empty: none of ours."""
        return ""

    @abstractmethod
    def decode(self, message: InboxMessage) -> Content:
        """Return what a message holds; raises MessageError if nothing of it can be used."""

    def try_decode(self, message: InboxMessage) -> Content | MessageError:
        """Return what a message holds, or why nothing of it can be used: no message ends the service."""
        try:
            return self.decode(message)
        except MessageError as error:
            return error
        except Exception as error:  # decoders of other packages raise what they like
            return MessageError("not a block", f"{type(error).__name__}: {' '.join(str(error).split())[:100]}")

    def refuse(self, block: Block) -> None:  # noqa: B027
        """Take back a block that the service has refused as ahead of its clock."""

    def requests(self) -> Iterable[tuple[str, bytes]]:
        """Return messages, with their addresses, that ask senders for what it lacks."""
        return ()


class Backlog(NamedTuple):
    """What waits outside to be read: how many files, for how long the oldest [s]; `trouble`: in words, if too long."""

    files: int = 0
    oldest_s: float = 0.0
    trouble: str = ""


class Transport(ABC):
    """Receives messages. What its own thread appends to `waiting` is handed over; or it overrides `receive`."""

    clock_rate = 1.0  # how fast its samples' clock runs: 1 where they are measured now; 0 where it waits for polls
    keeps = True  # whether what was not released comes again, so that messages may wait; else blocks are dropped
    connected = True
    trouble = ""  # why nothing can be received, in words; empty: nothing is wrong
    asset_troubles: Mapping[str, Reception] = NOTHING
    update_intervals_s: Mapping[tuple[str, str], float] = NOTHING
    layer_seconds: Mapping[str, float] = NOTHING
    backlog: Backlog | None = None  # None: nothing can wait where it is seen
    pause_s = 0.0  # how long an asset may pause without being silent [s]
    state_file: Path | None = None  # where it may note what must survive the process; set before `open`

    def __init__(self) -> None:
        self.waiting = deque[InboxMessage]()

    def bind(self, decoder: Decoder, rejections: RejectionCounter) -> None:
        """Take who decodes its messages, and who counts those that it does not keep; before `open`."""
        self.decoder, self.rejections = decoder, rejections

    def refuse(self, address: str, kind: str, why: str) -> None:
        """Count a message that is not handed over."""
        self.rejections.add(self.decoder.find_asset(address), kind, why)

    def preview(self) -> Sequence[str]:
        """Return what it would do, line by line; it need not be open."""
        return ()

    @abstractmethod
    def open(self, resume: Mapping[str, ResumePosition]) -> None:
        """Begin to receive, now or as soon as there is a connection."""

    def receive(self, most: int) -> Sequence[InboxMessage]:
        """Return up to so many messages in the order in which they came; at once."""
        return [self.waiting.popleft() for _ in range(min(most, len(self.waiting)))]

    @property
    def next_message_s(self) -> float:
        """How long until the next message may be there [s]; infinite: none will come."""
        return 0.0 if self.waiting else POLL_S

    def confirm(self, asset: str, stream: int, sequence: int) -> None:  # noqa: B027 - only some have a way back
        """Tell the sender that its blocks are stored up to this one."""

    def send(self, address: str, content: bytes) -> None:  # noqa: B027
        """Send a request of the decoder."""

    def leave(self, address: str) -> None:  # noqa: B027
        """Receive nothing more from an address that is of no asset of ours."""

    @abstractmethod
    def close(self) -> None:
        """Stop; it may be called twice."""


class ThreadTransport(Transport):
    """Follows its source in a thread of its own, from `open` to `close`."""

    ends_within_s = 10.0  # how long `close` waits for its end [s]

    def __init__(self) -> None:
        super().__init__()
        self._stop_event = threading.Event()
        self._thread = threading.Thread(target=self._run, name=type(self).__name__, daemon=True)

    def open(self, resume: Mapping[str, ResumePosition]) -> None:
        """Begin, now or as soon as there is a connection."""
        self._thread.start()

    @abstractmethod
    def _run(self) -> None:
        """Follow the source until `_stop_event` is set."""

    def close(self) -> None:
        """Stop."""
        self._stop_event.set()
        if self._thread.is_alive():
            self._thread.join(self.ends_within_s)


class BlockDecoder(Decoder):
    """For transports whose messages are blocks already."""

    def decode(self, message: InboxMessage) -> Content:
        """Return the block."""
        return Content(blocks=(message.content,))
