"""What is subscribed to at a server: arrays that are blocks, or single values from which blocks are made."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from servoscope.core.errors import MessageError
from servoscope.service.mqtt.payload import MAX_TIME_S
from servoscope.service.opcua.resample import CLOCK_STEP_S, Resampler, SampleGap
from servoscope.service.sources.base import RejectionCounter
from servoscope.service.sources.block import Block, ResumePosition

CLOCK_MARGIN_S = 10.0  # a server's clock may stand still for a second or more
OVERFLOW_BITS = 0x480  # info type "data value" and its bit "overflow": the server's queue was too short
QUEUE_MARGIN = 2  # times what a queue has to hold for two publishing intervals
MIN_BLOCK_S = 0.01  # the shortest block that a server's queue is made for
TRANSIENT_STATUSES = {  # status codes, the library's among them, of trouble that will pass
    "BadTimeout", "BadRequestTimeout", "BadConnectionClosed", "BadSessionClosed", "BadSessionIdInvalid",
    "BadSecureChannelClosed", "BadSecureChannelIdInvalid", "BadCommunicationError", "BadServerNotConnected",
    "BadShutdown", "BadServerHalted", "BadDisconnect", "BadNotConnected", "BadTooManyOperations", "BadTcpServerTooBusy",
}  # fmt: skip
MAX_EXACT_INT = 2.0**53  # beyond, a binary64 cannot count


class _Subscription(ABC):
    """Nodes of one asset; `emit` takes its blocks, `rejections` what could not be used."""

    value_s = MIN_BLOCK_S  # time between two values of a node, at least

    def __init__(
        self,
        asset: str,
        nodes: Sequence[str],
        resume: ResumePosition,
        emit: Callable[[Block], None],
        rejections: RejectionCounter,
    ) -> None:
        self.asset, self.nodes = asset, nodes
        self._sequence, self._last_t = resume.sequence, resume.last_t
        self._emit, self._rejections = emit, rejections

    def queue_size(self, publishing_s: float) -> int:
        """Return how many values the server keeps between two messages: those of two intervals, and twice that."""
        return max(10, math.ceil(2 * QUEUE_MARGIN * publishing_s / self.value_s))

    @abstractmethod
    async def read_missed(self, client: Any, now: float) -> None:
        """Read from the server's history what was missed up to `now` [UTC s], where it offers that."""

    @abstractmethod
    def add_value(self, node: int, value: Any) -> None:
        """Take a value of a node."""

    def emit_blocks(self, alive_until: float) -> None:  # noqa: B027 - arrays are blocks as they come
        """Make blocks of what is complete; up to `alive_until` [UTC s] all changes were reported."""


class ArraySubscription(_Subscription):
    """One node whose value is a block."""

    sampling_ms = 0.0  # as fast as the server can

    async def read_missed(self, client: Any, now: float) -> None:
        """Read the blocks that were missed."""
        if not math.isnan(self._last_t):
            for value in await read_history(client, self.nodes[0], self._last_t, now + CLOCK_MARGIN_S) or []:
                self.add_value(0, value)

    def add_value(self, node: int, value: Any) -> None:
        """Take a block, unless history or a new subscription repeats it."""
        try:
            block = parse_block(self.asset, value)
        except MessageError as error:
            self._rejections.add(self.asset, error.kind, str(error))
            return
        if (block.sequence, float(block.t[-1])) != (self._sequence, self._last_t):
            self._sequence, self._last_t = block.sequence, float(block.t[-1])
            self._emit(block)


class ScalarSubscription(_Subscription):
    """Nodes of single values: r, u, y, at a sample `rate` [Hz], for blocks of `size` samples."""

    def __init__(
        self,
        asset: str,
        nodes: Sequence[str],
        resume: ResumePosition,
        emit: Callable[[Block], None],
        rejections: RejectionCounter,
        rate: float,
        size: int,
    ) -> None:
        super().__init__(asset, nodes, resume, emit, rejections)
        self.value_s, self.sampling_ms, self._size = 1.0 / rate, 1000.0 / rate, size
        self._resampler = Resampler(len(nodes), 1.0 / rate, resume.last_t)
        self._t, self._values = np.zeros(0), np.zeros((len(nodes), 0))
        self._read_until = [-math.inf] * len(nodes)  # the last time that was read from the history of each node

    async def read_missed(self, client: Any, now: float) -> None:
        """Read the values that were missed; without a history, there is a gap."""
        last = self._resampler.last_t
        histories = []
        if not math.isnan(last):
            histories = [await read_history(client, node, last, now + CLOCK_MARGIN_S) for node in self.nodes]
        if None in histories or not any(histories):  # one signal alone may have none: it did not change
            self._resampler.restart(now)
            return
        for k, node in enumerate(self.nodes):  # what held then: the subscription reports what holds now
            for value in await read_history(client, node, last, 0.0, limit=1) or []:
                self._add(k, value)
        for k, values in enumerate(histories):
            self._read_until[k] = max((self._add(k, value) for value in values or []), default=-math.inf)
        self._resampler.restart(last, complete=True)

    def add_value(self, node: int, value: Any) -> None:
        """Take a value, unless it was read from history."""
        self._add(node, value, self._read_until[node])

    def _add(self, node: int, value: Any, read_until: float = -math.inf) -> float:
        """Take a value unless it was read already; return its time [UTC s]."""
        try:
            t, number = parse_value(value)
        except MessageError as error:
            self._rejections.add(self.asset, error.kind, str(error))
            return -math.inf
        if read_until - CLOCK_STEP_S < t <= read_until:
            return t
        status = value.StatusCode.value if value.StatusCode is not None else 0
        if status & OVERFLOW_BITS == OVERFLOW_BITS:
            self._rejections.add(self.asset, "overflow", f"the server's queue of {self.nodes[node]} was too short")
        self._resampler.add(node, t, number)
        return t

    def emit_blocks(self, alive_until: float) -> None:
        """Make blocks of what is complete."""
        t, values, gaps = self._resampler.take_samples(alive_until)
        for gap in gaps:
            self._rejections.add(self.asset, "gap", describe_gap(gap), gap.samples)
        if self._resampler.late:
            self._rejections.add(self.asset, "late", "values came after their samples were made", self._resampler.late)
            self._resampler.late = 0
        self._t, self._values = np.append(self._t, t), np.append(self._values, values, axis=1)
        while self._t.size >= self._size:
            self._sequence += 1
            r, u, y = self._values[:, : self._size].copy()
            self._emit(Block(self.asset, self._sequence, self._t[: self._size].copy(), r, u, y, time.monotonic()))
            self._t, self._values = self._t[self._size :], self._values[:, self._size :]


def describe_gap(gap: SampleGap) -> str:
    """Return when a gap was."""
    start, end = (datetime.fromtimestamp(t, UTC).isoformat(timespec="milliseconds") for t in gap[:2])
    return f"{gap.samples} samples between {start} and {end} are missing"


def timestamp(stamp: datetime) -> float:
    """Return a time stamp of the library, which leaves out that it is UTC [s]."""
    return (stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)).timestamp()


async def read_history(client: Any, node: str, start: float, end: float, limit: int = 0) -> list[Any] | None:
    """Return the values of a node over a time [UTC s], or None where the server keeps none; limit 0: all there are.

    Backwards where the end is before the start (OPC 10000-11, 6.5.3.2). Trouble that will pass is raised: the
    connection is made anew then, and history is read again.
    """
    from asyncua.ua.uaerrors import UaStatusCodeError

    times = (datetime.fromtimestamp(t, UTC) for t in (start, end))
    try:
        return list(await client.get_node(node).read_raw_history(*times, limit, return_bounds=False))
    except UaStatusCodeError as error:
        if type(error).__name__ in TRANSIENT_STATUSES:
            raise
        return None


def parse_value(value: Any) -> tuple[float, float]:
    """Return time [UTC s] and number of a value; NaN where its status is bad.

    Raises MessageError if it is no number, or has no time.
    """
    stamp = value.SourceTimestamp or value.ServerTimestamp
    if stamp is None:
        raise MessageError("times", "a value without a time stamp")
    if not 0.0 <= (t := timestamp(stamp)) < MAX_TIME_S:
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


def parse_block(asset: str, value: Any) -> Block:
    """Return the block of an array: its number, then time stamps, r, u and y; raises MessageError if it is none."""
    if value.StatusCode is not None and value.StatusCode.is_bad():
        raise MessageError("status", f"status {value.StatusCode.name}")
    cells = value.Value.Value if value.Value is not None else None
    if not isinstance(cells, list) or not all(isinstance(x, int | float) and not isinstance(x, bool) for x in cells):
        raise MessageError("wrong type", f"{type(cells).__name__}: the node must hold an array of numbers")
    if len(cells) < 5 or (len(cells) - 1) % 4:
        raise MessageError("lengths", f"{len(cells)} numbers: number of the block, then t, r, u and y of one length")
    try:
        t, r, u, y = np.array(cells[1:], dtype=np.float64).reshape(4, -1)
    except OverflowError:
        raise MessageError("wrong type", "holds a number that no computer can hold") from None
    if not (0 <= cells[0] < MAX_EXACT_INT and cells[0] == int(cells[0])):
        raise MessageError("out of range", f"number of the block: {cells[0]}, must be whole, from 0 to 2^53")
    if not ((t >= 0.0) & (t < MAX_TIME_S)).all():
        raise MessageError("times", "a time stamp is missing, or outside of the years 1970 to 9999")
    return Block(asset, int(cells[0]), t.copy(), r.copy(), u.copy(), y.copy(), time.monotonic())
