"""Blocks from an MQTT broker, acknowledged only after their results are stored: to the broker and to their senders."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

from pydantic import Field

from servoscope.core.errors import MessageError
from servoscope.service.config_types import Seconds
from servoscope.service.mapping.collector import MessageCollector, MessageSource
from servoscope.service.mapping.settings import PayloadSettings
from servoscope.service.mapping.sparkplug import MAX_NODES, encode_rebirth
from servoscope.service.mqtt import topics
from servoscope.service.mqtt.client import KEEPALIVE_S, BrokerConnection, SessionSettings, create_bulk_client
from servoscope.service.mqtt.payload import BlockMessage, DecodedBlock, decode_blocks
from servoscope.service.sources.base import BlockSource, SourceAsset, SourceSettings
from servoscope.service.sources.block import Block, ResumePosition

if TYPE_CHECKING:
    from servoscope.service.mqtt.paho_clients import ReceivedMessage


POLL_S = 0.02
REBIRTH_EVERY_S = 10.0  # how often a node of Sparkplug is asked for its births
TOPICS_AT_ONCE = 100  # that one message subscribes to
OVERSIZE_FACTOR = 4  # times the largest message: so far it is received and rejected, beyond that the broker drops it


class MqttSourceSettings(SessionSettings, SourceSettings):
    """A source of kind ``mqtt``."""

    kind: Literal["mqtt"]
    # what all topics begin with; blocks of an asset are expected under ``TOPIC/v1/data/ASSET``
    topic: topics.TopicPrefix = "servoscope"
    # most messages that are received before the first of them is acknowledged. The broker may have a lower limit.
    in_flight: Annotated[int, Field(strict=True, ge=1, le=65535)] = 1000
    largest: Annotated[int, Field(strict=True, ge=1024, le=2**28)] = 2**20  # longest message that is accepted [bytes]
    # how long the broker keeps the session, and what comes for it, while we are disconnected [s]
    session_s: Annotated[Seconds, Field(lt=2**32 - 1)] = 7 * 86400.0
    payload: PayloadSettings | None = None  # where the samples are in a plant's own messages; None: blocks are sent

    visit_changes: ClassVar[Mapping[str, Any]] = {"client": None, "session_s": 1.0}  # which the broker does not keep

    def carries(self, covariate: str, address: Any) -> bool:
        """Blocks have what the loop's columns name; a plant's own messages, what the payload names."""
        return self.payload is None or self.payload.carries(covariate)

    def create(self, name: str, assets: Mapping[str, SourceAsset], folder: Path) -> MqttSource:
        """Return the source."""
        if self.payload is None:
            list(decode_blocks([BlockMessage("", b"")]))  # compiles it, so that the first block does not wait for it
            covariates = {asset: one.covariates for asset, one in assets.items()}
            return MqttSource(self, frozenset(assets), folder, name, covariates)
        return PlantSource(self, assets, folder, name)


class _AckHandle(NamedTuple):
    """How a message is acknowledged, and in which connection; stream and sequence, if its sender waits for them."""

    mid: int
    qos: int
    connection: int
    position: tuple[int, int] | None = None


@dataclass(slots=True)
class _Arrival:
    """A message that waits to be decoded, and when it came at the earliest, monotonic [s]."""

    message: ReceivedMessage
    asset: str
    connection: int
    came_at: float

    @property
    def key(self) -> tuple[str, bytes]:
        """What it is known by when it is sent again."""
        return self.message.topic, self.message.payload

    @property
    def handle(self) -> _AckHandle:
        """How it is acknowledged."""
        return _AckHandle(self.message.mid, self.message.qos, self.connection)


class MqttSource(BlockSource):
    """Receives blocks of several assets from a broker; `client` names its session, unless the settings do."""

    def __init__(
        self,
        settings: MqttSourceSettings,
        assets: frozenset[str],
        folder: Path,
        client: str,
        covariates: Mapping[str, tuple[str, ...]] | None = None,
    ) -> None:
        """`covariates`: names of the further columns that blocks of an asset carry."""
        super().__init__()
        self._covariates = covariates or {}
        self.settings, self._assets = settings, assets
        self._client = create_bulk_client(settings, folder, settings.client or client, self._on_message)
        self._broker = BrokerConnection(settings, settings.client or client)
        self._client.on_connect, self._client.on_disconnect = self._on_connect, self._on_disconnect
        self._client.on_connect_fail = lambda *_: self._broker.handle_failure()
        self._lock = threading.Lock()  # held while a message is acknowledged: never one of another connection
        self._connection = 0
        # decoded where they are processed: a thread that decodes each as it comes does so with cold caches
        self._waiting = deque[_Arrival]()
        self._waiting_again: dict[tuple[str, bytes], _Arrival] = {}  # those of earlier connections
        self._unacknowledged: dict[str, deque[_AckHandle]] = {name: deque() for name in assets}
        self._newest: dict[str, tuple[int, int]] = {}  # stream and sequence of the newest block that was received
        self._acknowledged: dict[str, tuple[int, int]] = {}

    def open(self, resume: Mapping[str, ResumePosition]) -> None:
        """Connect, now or as soon as the broker is there."""
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        self._newest = {asset: (one.stream, one.sequence) for asset, one in resume.items()}
        self._acknowledged = dict(self._newest)
        session: Any = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        session.SessionExpiryInterval = int(self.settings.session_s)
        session.ReceiveMaximum = self.settings.in_flight
        session.MaximumPacketSize = OVERSIZE_FACTOR * self.settings.largest
        self._client.connect_async(*self.settings.address, keepalive=KEEPALIVE_S, clean_start=False, properties=session)
        self._client.loop_start()

    def _on_connect(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        with self._lock:
            self._connection += 1
            self._waiting_again = {one.key: one for one in self._waiting}
        if not self._broker.handle_connect(reason):
            return
        # also where the broker has the session: that of a killed process may have an old subscription
        self._client.unsubscribe(topics.data_topic(self.settings.topic, "+"))
        wanted = self._topic_filters()
        for k in range(0, len(wanted), TOPICS_AT_ONCE):
            self._client.subscribe([(topic, 1) for topic in wanted[k : k + TOPICS_AT_ONCE]])

    def _topic_filters(self) -> list[str]:
        """Return what to subscribe to: another service at this broker may follow other assets."""
        return [topics.data_topic(self.settings.topic, asset) for asset in sorted(self._assets)]

    def _on_disconnect(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        with self._lock:
            self._connection += 1
        self._broker.handle_disconnect(reason)

    @property
    def layer_seconds(self) -> Mapping[str, float]:
        """Processor time of the client's thread, as it was at the last message [s]."""
        return {"receive": self._client.thread_s}

    @property
    def connected(self) -> bool:  # type: ignore[override]  # others set it
        """Whether the broker has accepted us."""
        return self._broker.connected

    @property
    def trouble(self) -> str:
        """What is wrong with the connection, in words; empty: nothing."""
        return self._broker.trouble

    def _check_size(self, message: ReceivedMessage, waiting: int) -> None:
        """Raise MessageError if a message is too large to wait in memory, or one too many beside those that do."""
        if len(message.payload) > self.settings.largest:
            raise MessageError("oversized", f"{len(message.payload)} bytes, largest = {self.settings.largest}")
        if not message.qos and waiting >= self.settings.in_flight:
            raise MessageError("overflow", "sent without acknowledgement, faster than it can be processed")

    def _on_message(self, message: ReceivedMessage) -> None:
        """Queue a message, in the client's thread."""
        one = _Arrival(message, topics.parse_asset(message.topic), self._connection, self._client.empty_at)
        try:
            self._check_size(message, len(self._waiting))
        except MessageError as error:
            self._reject(one, one.asset if one.asset in self._assets else "", error)
            return
        if self._waiting_again:
            with self._lock:
                # sent again in a new connection, it replaces its earlier copy: the queue does not grow by it
                if (earlier := self._waiting_again.pop(one.key, None)) is not None:
                    earlier.message, earlier.connection = message, one.connection
                    return
        self._waiting.append(one)

    def _reject_stranger(self, one: _Arrival) -> None:
        """Reject a message of another asset: an earlier service file had it, and the broker has kept that."""
        if 0 < len(one.message.topic) < 1000:  # empty: an alias, which we have not allowed; too long: made up
            self._client.unsubscribe(one.message.topic)
        self._reject(
            one, "", MessageError("unknown asset", f"{one.asset[:100]!r} is none of the assets of this source")
        )

    def _reject(self, one: _Arrival, asset: str, error: MessageError) -> None:
        """Count a message that cannot be used, and acknowledge it: it would come again otherwise."""
        self.rejections.add(asset, error.kind, str(error))
        self._ack(one.handle)

    def _find_misorder(self, decoded: DecodedBlock) -> MessageError | None:
        """Return why a block must wait that comes before one which its sender retains, and will send again."""
        block, oldest = decoded
        if oldest is None:
            return None
        stream, sequence = self._newest.get(block.asset, (0, -1))
        following = sequence + 1 if stream == block.stream else 0
        if block.stream >= stream and block.sequence > max(following, oldest):
            reason = f"block {block.sequence} came before block {following}, which its sender keeps"
            return MessageError("ahead", reason)
        return None

    def poll(self, limit: int) -> list[Block]:
        """Return blocks in the order in which they came; messages that are none are rejected, and acknowledged."""
        with self._lock:
            arrivals = [self._waiting.popleft() for _ in range(min(limit, len(self._waiting)))]
            if self._waiting_again:
                for one in arrivals:
                    self._waiting_again.pop(one.key, None)
        own = list[_Arrival]()
        for one in arrivals:
            if one.asset in self._assets:
                own.append(one)
            else:
                self._reject_stranger(one)
        further, found = self._covariates, list[Block]()
        messages = [BlockMessage(x.asset, x.message.payload, x.came_at, further.get(x.asset, ())) for x in own]
        for one, decoded in zip(own, decode_blocks(messages), strict=True):
            if isinstance(decoded, MessageError):
                self._reject(one, one.asset, decoded)
                continue
            if (misorder := self._find_misorder(decoded)) is not None:
                self._reject(one, one.asset, misorder)
                continue
            block, position = decoded.block, (decoded.block.stream, decoded.block.sequence)
            self._newest[one.asset] = max(position, self._newest.get(one.asset, position))
            message = one.message
            handle = _AckHandle(message.mid, message.qos, one.connection, position if block.retained else None)
            self._unacknowledged[one.asset].append(handle)
            found.append(block)
        return found

    def acknowledge(self, asset: str, blocks: int) -> None:
        """Acknowledge to the broker, and to a sender that retains its blocks, that they are stored."""
        position: tuple[int, int] | None = None
        for _ in range(blocks):
            handle = self._unacknowledged[asset].popleft()
            self._ack(handle)
            if handle.position is not None:
                position = max(handle.position, self._acknowledged.get(asset, handle.position))
                self._acknowledged[asset] = position
        if position is not None and self.connected:
            message = topics.encode_ack(*position)
            self._client.publish(topics.ack_topic(self.settings.topic, asset), message, qos=1, retain=True)

    def _ack(self, handle: _AckHandle) -> None:
        with self._lock:
            if handle.connection == self._connection:  # otherwise the broker sends it again, and it is a repetition
                self._client.ack(handle.mid, handle.qos)

    @property
    def next_block_s(self) -> float:
        """How long until the next block may be due [s]."""
        return 0.0 if self._waiting else POLL_S

    def close(self) -> None:
        """Disconnect; the broker keeps what comes meanwhile."""
        self._broker.leave()
        self._client.disconnect()
        self._client.loop_stop()


class PlantSource(MessageSource, MqttSource):
    """Receives a plant's own messages, as `settings.payload` describes them."""

    def __init__(
        self, settings: MqttSourceSettings, assets: Mapping[str, SourceAsset], folder: Path, client: str
    ) -> None:
        super().__init__(settings, frozenset(assets), folder, client)
        assert settings.payload is not None, "what is sent is blocks"
        self._collector = MessageCollector(settings.payload, assets, self.rejections, settings.in_flight)
        self._decode_s = 0.0
        self._asked: dict[tuple[str, str], float] = {}  # by node, when it was asked for its births, monotonic [s]

    def open(self, resume: Mapping[str, ResumePosition]) -> None:
        """Connect, now or as soon as the broker is there."""
        self._collector.open(resume, self.state_file)
        super().open(resume)

    def _topic_filters(self) -> list[str]:
        return self._collector.mapping.topic_filters(everyone=self.settings.is_visit)

    @property
    def layer_seconds(self) -> Mapping[str, float]:
        """Processor time of the client's thread, which decodes, as it was at the last message [s]."""
        return {"receive": self._client.thread_s - self._decode_s, "decode": self._decode_s}

    def _on_message(self, message: ReceivedMessage) -> None:
        """Take a message, in the client's thread."""
        mapping = self._collector.mapping
        acknowledge = partial(self._ack, _AckHandle(message.mid, message.qos, self._connection))
        try:
            self._check_size(message, self._collector.waiting)
        except MessageError as error:
            self.rejections.add(mapping.find_asset(message.topic), error.kind, str(error))
            acknowledge()
            return
        start = time.thread_time()
        self._collector.add(message.topic, message.payload, acknowledge, old=message.retain)
        self._decode_s += time.thread_time() - start
        if mapping.missing_births:
            self._ask_for_births()

    def _ask_for_births(self) -> None:
        """Ask nodes of Sparkplug for the births that we have not heard."""
        missing, now = self._collector.mapping.missing_births, time.monotonic()
        self._asked = {node: at for node, at in self._asked.items() if now - at < REBIRTH_EVERY_S}
        for group, node in sorted(missing - self._asked.keys())[: MAX_NODES - len(self._asked)]:
            self._asked[group, node] = now
            self._client.publish(f"spBv1.0/{group}/NCMD/{node}", encode_rebirth(time.time()))
        missing.clear()
