"""What is subscribed to at a server: arrays that are blocks, or single values from which blocks are made."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np

from servoscope.core.errors import MessageError
from servoscope.core.messages import message, render
from servoscope.service.assets.reception import Reception
from servoscope.service.sources.assembly import MAX_PERIODS, SIGNALS, BlockAssembler
from servoscope.service.sources.block import MAX_TIME_S, Block, ResumePosition
from servoscope.service.sources.message import RejectionCounter
from servoscope.service.sources.resample import CLOCK_STEP_S

CLOCK_MARGIN_S = 10.0  # a server's clock may stand still for a second or more
OVERFLOW_BITS = 0x480  # info type "data value" and its bit "overflow": the server's queue was too short
QUEUE_MARGIN = 2  # times what a queue has to hold for two publishing intervals
MIN_BLOCK_S = 0.01  # the shortest block that a server's queue is made for
TRANSIENT_STATUSES = {  # status codes, the library's among them, of trouble that will pass
    "BadTimeout", "BadRequestTimeout", "BadConnectionClosed", "BadSessionClosed", "BadSessionIdInvalid",
    "BadSecureChannelClosed", "BadSecureChannelIdInvalid", "BadCommunicationError", "BadServerNotConnected",
    "BadShutdown", "BadServerHalted", "BadDisconnect", "BadNotConnected", "BadTooManyOperations", "BadTcpServerTooBusy",
}  # fmt: skip
MAX_HELD_S = 60.0  # of samples that wait for the decision whether they come too slowly
MAX_EXACT_INT = 2.0**53  # beyond, a binary64 cannot count


class ItemTerms(NamedTuple):
    """How a node is watched: the interval at which it is sampled [ms], and how many values the server keeps.

    As it is asked for, or as the server has revised it; `refusal`: why it grants nothing, else empty.
    """

    sampling_ms: float
    queue: int
    refusal: str = ""


class _AnswerRecorder:
    """Stands before a session while items are created: the library returns their numbers, and drops the rest."""

    def __init__(self, session: Any) -> None:
        self._session, self.answers = session, list[Any]()

    def __getattr__(self, name: str) -> Any:
        # the first values may come before the last item is created; they are the session's
        return getattr(self._session, name)

    async def create_monitored_items(self, parameters: Any) -> Any:
        """Create them, and keep the answers."""
        self.answers = await self._session.create_monitored_items(parameters)
        return self.answers


async def monitor_nodes(subscription: Any, wanted: Mapping[str, ItemTerms], first: int) -> dict[str, ItemTerms]:
    """Subscribe to nodes; return what the server grants of each. `first`: number of the first, unique in it."""
    from asyncua import ua
    from asyncua.ua.attribute_ids import AttributeIds

    stamped = ua.DataChangeFilter(Trigger=ua.DataChangeTrigger.StatusValueTimestamp)
    items = [
        ua.MonitoredItemCreateRequest(
            ua.ReadValueId(NodeId=ua.NodeId.from_string(node), AttributeId=AttributeIds.Value),
            ua.MonitoringMode.Reporting,
            ua.MonitoringParameters(ClientHandle=k, SamplingInterval=sampling, QueueSize=queue, Filter=stamped),
        )
        for k, (node, (sampling, queue, _)) in enumerate(wanted.items(), first)
    ]
    session = subscription.server
    subscription.server = recorder = _AnswerRecorder(session)
    try:
        await subscription.create_monitored_items(items)
    finally:
        subscription.server = session
    return {
        node: ItemTerms(answer.RevisedSamplingInterval, answer.RevisedQueueSize)
        if answer.StatusCode.is_good()
        else ItemTerms(0.0, 0, answer.StatusCode.name)
        for node, answer in zip(wanted, recorder.answers, strict=True)
    }


async def shorten_interval(subscription: Any, interval_s: float) -> float:
    """Ask for messages that come so much sooner [s]; return what is granted."""
    from asyncua import ua

    parameters = subscription.parameters
    answer = await subscription.update(
        ua.ModifySubscriptionParameters(
            SubscriptionId=subscription.subscription_id,
            RequestedPublishingInterval=1000.0 * interval_s,
            RequestedLifetimeCount=parameters.RequestedLifetimeCount,
            RequestedMaxKeepAliveCount=parameters.RequestedMaxKeepAliveCount,
            MaxNotificationsPerPublish=parameters.MaxNotificationsPerPublish,
            Priority=parameters.Priority,
        )
    )
    return float(answer.RevisedPublishingInterval) / 1000.0


class _Subscription(ABC):
    """Nodes of one asset; `emit` takes its blocks, `rejections` what is of no use; `covariates` by name."""

    value_s = MIN_BLOCK_S  # time between two values of a node, at least

    def __init__(
        self,
        asset: str,
        nodes: Sequence[str],
        resume: ResumePosition,
        emit: Callable[[Block], None],
        rejections: RejectionCounter,
        covariates: tuple[str, ...] = (),
    ) -> None:
        self.asset, self.nodes, self._covariates = asset, nodes, covariates
        self._sequence, self._last_t = resume.sequence, resume.last_t
        self._emit, self._rejections = emit, rejections
        self.trouble: Reception | None = None  # why there are no samples although the server is there

    def queue_size(self, publishing_s: float) -> int:
        """Return how many values the server keeps between two messages: those of two intervals, and twice that."""
        return max(10, math.ceil(2 * QUEUE_MARGIN * publishing_s / self.value_s))

    def check_grants(self, grants: Mapping[str, ItemTerms], publishing_s: float) -> None:
        """Take what the server grants of each node, and of the time between two messages [s]."""
        refused = [(node, grants[node].refusal) for node in self.nodes if grants[node].refusal]
        words = [render(message("service.trouble.node", node=node, reason=reason)) for node, reason in refused]
        self.trouble = Reception("refused", ", ".join(words)) if words else None

    def longest_interval_s(self, grants: Mapping[str, ItemTerms]) -> float:
        """Return how long messages may be apart before values are lost [s]; of blocks nobody knows."""
        return math.inf

    @property
    def intervals_s(self) -> dict[str, float]:
        """Time between two updates of each signal, as measured [s]."""
        return {}

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
            block = parse_block(self.asset, value, len(self._covariates))
        except MessageError as error:
            self._rejections.add(self.asset, error.kind, str(error))
            return
        if (block.sequence, float(block.t[-1])) != (self._sequence, self._last_t):
            self._sequence, self._last_t = block.sequence, float(block.t[-1])
            self._emit(block)


class ScalarSubscription(_Subscription):
    """Nodes of single values: r, u, y and covariates, at a sample `rate` [Hz], for blocks of `size` samples."""

    def __init__(
        self,
        asset: str,
        nodes: Sequence[str],
        resume: ResumePosition,
        emit: Callable[[Block], None],
        rejections: RejectionCounter,
        rate: float,
        size: int,
        covariates: tuple[str, ...] = (),
    ) -> None:
        super().__init__(asset, nodes, resume, emit, rejections, covariates)
        self.value_s, self.sampling_ms = 1.0 / rate, 1000.0 / rate
        self._assembler = BlockAssembler(asset, resume, rejections, rate, size, covariates=covariates)
        self._read_until = [-math.inf] * len(nodes)  # the last time that was read from the history of each node
        self._granted_ms: dict[int, float] = {}  # what the server says of signals that it would sample too slowly
        self._short_queues, self._undecided = "", False

    def longest_interval_s(self, grants: Mapping[str, ItemTerms]) -> float:
        """Return how long messages may be apart before the shortest queue of its nodes runs over [s]."""
        queues = [grants[node].queue for node in self.nodes[: len(SIGNALS)] if not grants[node].refusal]
        return self.value_s * max(1, min(queues, default=0)) if queues else math.inf

    def check_grants(self, grants: Mapping[str, ItemTerms], publishing_s: float) -> None:
        """Take what the server grants: slower than the samples it has no samples for us."""
        super().check_grants(grants, publishing_s)
        self._assembler.restart_rates()
        needed = math.ceil(publishing_s / self.value_s)
        granted = [grants[node] for node in self.nodes[: len(SIGNALS)]]
        limit_ms = MAX_PERIODS * self.sampling_ms
        self._granted_ms = {k: terms.sampling_ms for k, terms in enumerate(granted) if terms.sampling_ms > limit_ms}
        values = {"publishing_ms": 1000.0 * publishing_s, "needed": needed}
        short = [
            render(message("service.trouble.queue", signal=SIGNALS[k], queue=terms.queue, **values))
            for k, terms in enumerate(granted)
            if not terms.refusal and k not in self._granted_ms and terms.queue < needed
        ]
        self._short_queues = ", ".join(short)
        if self.trouble is None:
            self._follow_rates()

    @property
    def intervals_s(self) -> dict[str, float]:
        """Time between two updates of each signal, as measured [s]; without those of which too few have come."""
        return self._assembler.intervals_s

    def _follow_rates(self) -> None:
        """Judge how often values come: of what is too slow no samples are made, since they would look like a fault."""
        rates = self._assembler.rates
        told = [rates[k].contradicts(granted_ms / 1000.0) for k, granted_ms in self._granted_ms.items()]
        if True in told:
            self._granted_ms = {}  # a server that is wrong of one signal is of all
        slow = self._assembler.slow_ms | self._granted_ms
        words = [self._assembler.describe_slow(k, interval_ms) for k, interval_ms in sorted(slow.items())]
        words += [self._short_queues] if self._short_queues else []
        self.trouble = Reception("slow", ", ".join(words)) if words else None
        self._undecided = bool(self._granted_ms) and False not in told

    async def read_missed(self, client: Any, now: float) -> None:
        """Read the values that were missed; without a history, there is a gap."""
        last = self._assembler.resampler.last_t
        histories = []
        if not math.isnan(last):
            histories = [await read_history(client, node, last, now + CLOCK_MARGIN_S) for node in self.nodes]
        if None in histories[: len(SIGNALS)] or not any(histories):  # one signal alone may have none: it did not change
            self._assembler.resampler.restart(now)
            return
        for k, node in enumerate(self.nodes):  # what held then: the subscription reports what holds now
            for value in await read_history(client, node, last, 0.0, limit=1) or []:
                self._add(k, value)
        for k, values in enumerate(histories):
            self._read_until[k] = max((self._add(k, value) for value in values or []), default=-math.inf)
        self._assembler.resampler.restart(last, complete=True, history_until=max(self._read_until))

    def add_value(self, node: int, value: Any) -> None:
        """Take a value, unless it was read from history."""
        t = self._add(node, value, self._read_until[node])
        if math.isfinite(t):
            self._assembler.rates[node].add(t, parse_value(value)[1])

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
        self._assembler.resampler.add(node, t, number)
        return t

    def emit_blocks(self, alive_until: float) -> None:
        """Make blocks of what is complete."""
        if self.trouble is None or self.trouble.state == "slow":
            self._follow_rates()
        self._assembler.collect(alive_until)
        if self.trouble is not None:  # until it is known what a server's word is worth, a minute of samples waits
            kept = round(MAX_HELD_S / self.value_s) if self._undecided else 0
            self._assembler.discard(kept, self.trouble.state, self.trouble.why)
            return
        for block in self._assembler.take_blocks():
            self._emit(block)


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


def parse_block(asset: str, value: Any, covariates: int = 0) -> Block:
    """Return the block of an array: its number, then time stamps, r, u, y and covariates.

    Raises MessageError if it is none.
    """
    rows = 4 + covariates
    if value.StatusCode is not None and value.StatusCode.is_bad():
        raise MessageError("status", f"status {value.StatusCode.name}")
    cells = value.Value.Value if value.Value is not None else None
    if not isinstance(cells, list) or not all(isinstance(x, int | float) and not isinstance(x, bool) for x in cells):
        raise MessageError("wrong type", f"{type(cells).__name__}: the node must hold an array of numbers")
    if len(cells) <= rows or (len(cells) - 1) % rows:
        also = f", and {covariates} covariates," if covariates else ""
        words = f"{len(cells)} numbers: number of the block, then t, r, u and y{also} of one length"
        raise MessageError("lengths", words)
    try:
        signals = np.array(cells[1:], dtype=np.float64).reshape(rows, -1)
    except OverflowError:
        raise MessageError("wrong type", "holds a number that no computer can hold") from None
    if not (0 <= cells[0] < MAX_EXACT_INT and cells[0] == int(cells[0])):
        raise MessageError("out of range", f"number of the block: {cells[0]}, must be whole, from 0 to 2^53")
    if not ((signals[0] >= 0.0) & (signals[0] < MAX_TIME_S)).all():
        raise MessageError("times", "a time stamp is missing, or outside of the years 1970 to 9999")
    return Block.from_signals(asset, int(cells[0]), signals, time.monotonic())
