"""What is followed at a server: arrays that are blocks, or single values that are made into blocks."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Any, Protocol

import numpy as np

from servoscope.errors import MessageError
from servoscope.live.block import Block, Resume
from servoscope.live.mqtt.payload import LATEST
from servoscope.live.opcua.aligning import SET_BACK_S, Aligner, Gap
from servoscope.live.refusals import Refusals

__all__ = ["Arrays", "Followed", "Scalars", "block_of"]

AHEAD_S = 10.0  # a server's clock may stand still for a second or more
OVERFLOW = 0x480  # info type "data value" and its bit "overflow": the server's queue was too short
MARGIN = 2  # times what a queue has to hold for two publishing intervals
PASSING = {  # what a server says, or the library for it, while something is wrong that will not stay
    "BadTimeout", "BadRequestTimeout", "BadConnectionClosed", "BadSessionClosed", "BadSessionIdInvalid",
    "BadSecureChannelClosed", "BadSecureChannelIdInvalid", "BadCommunicationError", "BadServerNotConnected",
    "BadShutdown", "BadServerHalted", "BadDisconnect", "BadNotConnected", "BadTooManyOperations", "BadTcpServerTooBusy",
}  # fmt: skip
LARGEST_EXACT = 2.0**53  # beyond, a binary64 cannot count


class Followed(Protocol):
    """Nodes of one asset."""

    asset: str

    @property
    def nodes(self) -> Sequence[str]:
        """Which nodes."""

    @property
    def sampling_ms(self) -> float:
        """How often the server looks at a node."""

    def queue(self, publishing_s: float) -> int:
        """Return how many values the server keeps between two messages."""

    async def catch_up(self, client: Any, now: float) -> None:
        """Read from the server's history what was missed up to `now` [UTC s], where it offers that."""

    def take(self, node: int, value: Any) -> None:
        """Take a value of a node."""

    def make(self, alive: float) -> None:
        """Make blocks of what is complete; up to `alive` [UTC s] all changes were told."""


class Arrays:
    """One node whose value is a block.

    Parameters
    ----------
    asset, node
        Whose, and which.
    resume
        Where the asset stands.
    hand_on
        Takes the blocks.
    refusals
        Takes what is none.
    """

    sampling_ms = 0.0  # as fast as the server can

    def __init__(
        self, asset: str, node: str, resume: Resume, hand_on: Callable[[Block], None], refusals: Refusals
    ) -> None:
        self.asset, self.nodes = asset, (node,)
        self._last, self._hand_on, self._refusals = resume.t, hand_on, refusals
        self._sequence = resume.sequence

    def queue(self, publishing_s: float) -> int:
        """Return how many blocks the server keeps between two messages: blocks of 10 ms, and twice that."""
        return max(10, math.ceil(2 * MARGIN * publishing_s / 0.01))

    async def catch_up(self, client: Any, now: float) -> None:
        """Read from the server's history what was missed."""
        if math.isnan(self._last):
            return
        for value in await history(client, self.nodes[0], self._last, now + AHEAD_S) or []:
            self.take(0, value)

    def take(self, node: int, value: Any) -> None:
        """Take a block, unless history or a new subscription tells it once more."""
        try:
            block = block_of(self.asset, value)
        except MessageError as error:
            self._refusals.add(self.asset, error.kind, str(error))
            return
        if (block.sequence, float(block.t[-1])) != (self._sequence, self._last):
            self._sequence, self._last = block.sequence, float(block.t[-1])
            self._hand_on(block)

    def make(self, alive: float) -> None:
        """Do nothing: blocks come as they are."""


class Scalars:
    """Nodes of single values.

    Parameters
    ----------
    asset, nodes
        Whose, and which: r, u, y.
    rate
        Sample rate [Hz].
    size
        Samples per block.
    resume
        Where the asset stands.
    hand_on
        Takes the blocks.
    refusals
        Takes gaps, late values, and values that are none.
    """

    def __init__(
        self,
        asset: str,
        nodes: Sequence[str],
        rate: float,
        size: int,
        resume: Resume,
        hand_on: Callable[[Block], None],
        refusals: Refusals,
    ) -> None:
        self.asset, self.nodes = asset, nodes
        self._rate, self._size = rate, size
        self._sequence = resume.sequence
        self._aligner = Aligner(len(nodes), 1.0 / rate, resume.t)
        self._t, self._values = np.zeros(0), np.zeros((len(nodes), 0))
        self._read = [-math.inf] * len(nodes)  # up to which time each node was read from history
        self._hand_on, self._refusals = hand_on, refusals

    @property
    def sampling_ms(self) -> float:
        """How often the server looks at a node: at every sample."""
        return 1000.0 / self._rate

    def queue(self, publishing_s: float) -> int:
        """Return how many values the server keeps: those of two publishing intervals, and twice that."""
        return max(10, math.ceil(2 * MARGIN * publishing_s * self._rate))

    async def catch_up(self, client: Any, now: float) -> None:
        """Read from the server's history what was missed; without one, there is a gap."""
        last = self._aligner.last
        if math.isnan(last):
            self._aligner.cut(now)
            return
        found = [await history(client, node, last, now + AHEAD_S) for node in self.nodes]
        if None in found or not any(found):  # a signal that did not change has none, and that is well
            self._aligner.cut(now)
            return
        for k, node in enumerate(self.nodes):  # what held then: the subscription tells what holds now
            for value in await history(client, node, last, 0.0, most=1) or []:
                self._add(k, value)
        for k, values in enumerate(found):
            self._read[k] = max((self._add(k, value) for value in values or []), default=-math.inf)
        self._aligner.cut(last, complete=True)

    def take(self, node: int, value: Any) -> None:
        """Take a value, unless history has told it."""
        self._add(node, value, self._read[node])

    def _add(self, node: int, value: Any, read: float = -math.inf) -> float:
        """Take a value unless it was read; return its time [UTC s]."""
        try:
            t, number = single(value)
        except MessageError as error:
            self._refusals.add(self.asset, error.kind, str(error))
            return -math.inf
        if read - SET_BACK_S < t <= read:
            return t
        status = value.StatusCode.value if value.StatusCode is not None else 0
        if status & OVERFLOW == OVERFLOW:
            self._refusals.add(self.asset, "overflow", f"the server's queue of {self.nodes[node]} was too short")
        self._aligner.add(node, t, number)
        return t

    def make(self, alive: float) -> None:
        """Make blocks of what is complete."""
        t, values, gaps = self._aligner.take(alive)
        for gap in gaps:
            self._refusals.add(self.asset, "gap", words_of(gap), gap.samples)
        if self._aligner.late:
            self._refusals.add(self.asset, "late", "values came after their samples were made", self._aligner.late)
            self._aligner.late = 0
        self._t, self._values = np.append(self._t, t), np.append(self._values, values, axis=1)
        while self._t.size >= self._size:
            rows = slice(0, self._size)
            self._sequence += 1
            r, u, y = self._values[:, rows].copy()
            self._hand_on(Block(self.asset, self._sequence, self._t[rows].copy(), r, u, y, time.monotonic()))
            self._t, self._values = self._t[self._size :], self._values[:, self._size :]


def words_of(gap: Gap) -> str:
    """Return when a gap was."""
    begins, ends = (datetime.fromtimestamp(t, UTC).isoformat(timespec="milliseconds") for t in gap[:2])
    return f"{gap.samples} samples between {begins} and {ends} are known to nobody"


async def history(client: Any, node: str, begins: float, ends: float, most: int = 0) -> list[Any] | None:
    """Return the values of a node over a time, or None where the server keeps none.

    Backwards where the time ends before it begins (OPC 10000-11, 6.5.3.2); 0: as many as there are. Trouble that passes
    is raised: the connection is made anew then, and history is asked for again.
    """
    from asyncua.ua.uaerrors import UaStatusCodeError

    begin, end = (datetime.fromtimestamp(t, UTC) for t in (begins, ends))
    try:
        return list(await client.get_node(node).read_raw_history(begin, end, most, return_bounds=False))
    except UaStatusCodeError as error:
        if type(error).__name__ in PASSING:
            raise
        return None


def single(value: Any) -> tuple[float, float]:
    """Return time [UTC s] and number of a value; NaN where its status is bad.

    Raises
    ------
    MessageError
        If it is no number, or has no time.
    """
    stamp = value.SourceTimestamp or value.ServerTimestamp
    if stamp is None:
        raise MessageError("times", "a value without a time stamp")
    t = (stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)).timestamp()
    if not 0.0 <= t < LATEST:
        raise MessageError("times", "a time stamp outside of the years 1970 to 9999")
    if value.StatusCode is not None and value.StatusCode.is_bad():
        return t, math.nan
    number = value.Value.Value if value.Value is not None else None
    if isinstance(number, bool) or not isinstance(number, int | float):
        raise MessageError("wrong type", f"{type(number).__name__}: the node must hold a number")
    try:
        return t, float(number)
    except OverflowError:
        raise MessageError("wrong type", "a number that no computer can hold") from None


def block_of(asset: str, value: Any) -> Block:
    """Return the block that an array tells: its number, then time stamps, r, u and y.

    Raises
    ------
    MessageError
        If it tells none.
    """
    if value.StatusCode is not None and value.StatusCode.is_bad():
        raise MessageError("status", f"status {value.StatusCode.name}")
    cells = value.Value.Value if value.Value is not None else None
    if not isinstance(cells, list) or not all(isinstance(x, int | float) and not isinstance(x, bool) for x in cells):
        raise MessageError("wrong type", f"{type(cells).__name__}: the node must hold an array of numbers")
    if len(cells) < 5 or (len(cells) - 1) % 4:
        raise MessageError("lengths", f"{len(cells)} numbers: number of the block, then t, r, u and y of one length")
    try:
        numbers = np.array(cells[1:], dtype=np.float64).reshape(4, -1)
    except OverflowError:
        raise MessageError("wrong type", "holds a number that no computer can hold") from None
    if not (0 <= cells[0] < LARGEST_EXACT and cells[0] == int(cells[0])):
        raise MessageError("out of range", f"number of the block: {cells[0]}, must be whole, from 0 to 2^53")
    t, r, u, y = numbers
    if not ((t >= 0.0) & (t < LATEST)).all():
        raise MessageError("times", "a time stamp is missing, or outside of the years 1970 to 9999")
    return Block(asset, int(cells[0]), t.copy(), r.copy(), u.copy(), y.copy(), time.monotonic())
