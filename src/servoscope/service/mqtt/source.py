"""Blocks from an MQTT broker, acknowledged only after their results are stored: to the broker and to their senders."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field

from servoscope.service.config_types import Seconds
from servoscope.service.mapping.rows import MessageMapping
from servoscope.service.mapping.settings import PayloadSettings
from servoscope.service.mqtt import topics
from servoscope.service.mqtt.client import BrokerConnection, SessionSettings, create_mqtt_client
from servoscope.service.mqtt.payload import BlockMessages
from servoscope.service.sources.block import ResumePosition
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.message import Decoder, InboxMessage, RejectionCounter, SourceAsset, Transport
from servoscope.service.sources.settings import SourceSettings

if TYPE_CHECKING:
    from servoscope.service.mqtt.paho_clients import ReceivedMessage


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

    def create(self, name: str, assets: Mapping[str, SourceAsset], folder: Path) -> Inbox:
        """Return the source."""
        rejections = RejectionCounter()
        decoder: Decoder = (
            BlockMessages(self.topic, assets)
            if self.payload is None
            else MessageMapping.of_assets(self.payload, assets, rejections)
        )
        return Inbox(MqttTransport(self, folder, name), decoder, assets, rejections, self.in_flight)


@dataclass(slots=True, eq=False)
class _Delivery:
    """How a message is acknowledged, and in which connection."""

    acknowledge: Callable[[_Delivery], None]
    mid: int
    qos: int
    connection: int

    def __call__(self) -> None:
        self.acknowledge(self)


class MqttTransport(BrokerConnection, Transport):  # type: ignore[override]  # what is wrong is asked for, not kept
    """Receives messages from a broker, which keeps those that are not released; `client` names our session."""

    def __init__(self, settings: MqttSourceSettings, folder: Path, client: str) -> None:
        Transport.__init__(self)
        client = settings.client or client
        BrokerConnection.__init__(
            self, settings, create_mqtt_client(settings, folder, client, self._on_message), client
        )
        self.settings = settings
        self._lock = threading.Lock()  # held while a message is acknowledged: never one of another connection
        self._connection = 0
        self._waiting_again: dict[tuple[str, bytes], _Delivery] = {}  # those of earlier connections

    def open(self, resume: Mapping[str, ResumePosition]) -> None:
        """Connect, now or as soon as the broker is there."""
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        session: Any = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        session.SessionExpiryInterval = int(self.settings.session_s)
        session.ReceiveMaximum = self.settings.in_flight
        session.MaximumPacketSize = OVERSIZE_FACTOR * self.settings.largest
        self.connect(clean_start=False, properties=session)

    def _on_change(self, accepted: bool) -> None:
        with self._lock:
            self._connection += 1
            self._waiting_again = {
                (message.address, message.content): message.release
                for message in self.waiting
                if isinstance(message.release, _Delivery)
            }
        if not accepted:
            return
        # also where the broker has the session: that of a killed process may have an old subscription
        self.leave(topics.data_topic(self.settings.topic, "+"))
        wanted = self.decoder.addresses(everyone=self.settings.is_visit)
        for k in range(0, len(wanted), TOPICS_AT_ONCE):
            self._client.subscribe([(topic, 1) for topic in wanted[k : k + TOPICS_AT_ONCE]])

    @property
    def layer_seconds(self) -> Mapping[str, float]:  # type: ignore[override]
        """Processor time of the client's thread, as it was at the last message [s]."""
        return {"receive": self._client.thread_s}

    def _on_message(self, message: ReceivedMessage) -> None:
        """Keep a message that is neither too large to wait in memory nor one too many; in the client's thread."""
        topic, content, qos, mid, retain = message
        delivery = _Delivery(self._acknowledge, mid, qos, self._connection)
        if len(content) > self.settings.largest:
            self.refuse(topic, "oversized", f"{len(content)} bytes, largest = {self.settings.largest}")
            return delivery()
        if not qos and len(self.waiting) >= self.settings.in_flight:
            return self.refuse(topic, "overflow", "sent without acknowledgement, faster than it can be processed")
        if self._waiting_again:
            with self._lock:
                # sent again in a new connection, it replaces its earlier copy: the queue does not grow by it
                if (earlier := self._waiting_again.pop((topic, content), None)) is not None:
                    earlier.mid, earlier.qos, earlier.connection = mid, qos, delivery.connection
                    return
        # of blocks the latency counts from when the socket was last seen empty: it came after that
        at = self._client.empty_at if self.settings.payload is None else time.monotonic()
        self.waiting.append(InboxMessage(topic, content, at, delivery, retain))

    def receive(self, most: int) -> Sequence[InboxMessage]:
        """Return messages in the order in which they came."""
        with self._lock:
            messages = super().receive(most)
            if self._waiting_again:
                for message in messages:
                    self._waiting_again.pop((message.address, message.content), None)
        return messages

    def _acknowledge(self, delivery: _Delivery) -> None:
        with self._lock:
            if delivery.connection == self._connection:  # otherwise the broker sends it again, and it is a repetition
                self._client.ack(delivery.mid, delivery.qos)

    def confirm(self, asset: str, stream: int, sequence: int) -> None:
        """Tell the sender that its blocks are stored up to this one."""
        if self.connected:
            message = topics.encode_ack(stream, sequence)
            self._client.publish(topics.ack_topic(self.settings.topic, asset), message, qos=1, retain=True)

    def send(self, address: str, content: bytes) -> None:
        """Publish a request of the decoder."""
        self._client.publish(address, content)

    def leave(self, address: str) -> None:
        """Unsubscribe: an earlier service file had it, and the broker has kept that."""
        if 0 < len(address) < 1000:  # empty: an alias, which we have not allowed; too long: made up
            self._client.unsubscribe(address)
