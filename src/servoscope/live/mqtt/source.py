"""Blocks from an MQTT broker: acknowledged to it only after their results are stored, and to their senders as well."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from pydantic import Field

from servoscope.broker import KEEPALIVE_S, BrokerSettings, reach
from servoscope.errors import MessageError
from servoscope.live.block import Block, Resume
from servoscope.live.logs import log
from servoscope.live.mqtt import topics
from servoscope.live.mqtt.payload import Received, decode
from servoscope.live.refusals import Refusal, Refusals
from servoscope.live.settings import Seconds

if TYPE_CHECKING:
    from paho.mqtt.client import MQTTMessage

__all__ = ["MqttSettings", "MqttSource"]

POLL_S = 0.02
SLACK = 4  # times the largest message: so far what is too long is taken and told, beyond that the broker keeps it


class MqttSettings(BrokerSettings):
    """A source of kind ``mqtt``.

    Parameters
    ----------
    topic
        What all topics begin with; blocks of an asset are expected under ``TOPIC/v1/data/ASSET``.
    client
        Name of the session at the broker; None: ``SERVICE.SOURCE``. No two clients may share one.
    in_flight
        Most messages that are taken before the first of them is acknowledged. The broker may have a lower limit.
    largest
        Longest message that is taken [bytes].
    session_s
        How long the broker keeps the session, and what comes for it, while we are away [s].
    """

    kind: Literal["mqtt"]
    topic: topics.Prefix = "servoscope"
    client: Annotated[str, Field(strict=True, min_length=1, max_length=200)] | None = None
    in_flight: Annotated[int, Field(strict=True, ge=1, le=65535)] = 1000
    largest: Annotated[int, Field(strict=True, ge=1024, le=2**28)] = 2**20
    session_s: Annotated[Seconds, Field(lt=2**32 - 1)] = 7 * 86400.0


class _Taken(NamedTuple):
    """A message that was handed on: how it is acknowledged, and in which connection; its place, if its sender asks."""

    mid: int
    qos: int
    connection: int
    place: tuple[int, int] | None


class MqttSource:
    """Takes blocks of several assets from a broker.

    Parameters
    ----------
    settings
        Of the source.
    assets
        Names.
    folder
        What files are relative to.
    client
        Name of the session, unless the settings have one.
    """

    pace = 1.0

    def __init__(self, settings: MqttSettings, assets: frozenset[str], folder: Path, client: str) -> None:
        self.settings, self._assets = settings, assets
        self._client = reach(settings, folder, settings.client or client, manual_ack=True)
        self._client.on_connect, self._client.on_disconnect = self._connected, self._disconnected
        self._client.on_connect_fail, self._client.on_message = self._failed, self._heard
        self._lock = threading.Lock()  # held while a message is acknowledged: never one of another connection
        self._connection = 0
        self._trouble = ""
        self._waiting: dict[tuple[Any, ...], tuple[Block, _Taken]] = {}
        self._taken: dict[str, deque[_Taken]] = {name: deque() for name in assets}
        self._last: dict[str, tuple[int, int]] = {}  # the newest block that was taken: stream and sequence
        self._safe: dict[str, tuple[int, int]] = {}
        self._refusals = Refusals()
        self.up = False

    def open(self, resume: Mapping[str, Resume]) -> None:
        """Connect, now or as soon as the broker is there."""
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        self._last = {asset: (one.stream, one.sequence) for asset, one in resume.items()}
        self._safe = dict(self._last)
        asked: Any = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        asked.SessionExpiryInterval = int(self.settings.session_s)
        asked.ReceiveMaximum = self.settings.in_flight
        asked.MaximumPacketSize = SLACK * self.settings.largest
        self._client.connect_async(*self.settings.address, keepalive=KEEPALIVE_S, clean_start=False, properties=asked)
        self._client.loop_start()

    def _connected(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self._tell(f"refused: {reason}")
            return
        with self._lock:
            self._connection += 1
        self.up, self._trouble = True, ""
        # also where the broker has the session: one that was killed may have an old one
        self._client.subscribe(topics.data(self.settings.topic, "+"), qos=1)
        log("info", "broker connected", broker=self.settings.host)

    def _failed(self, _client: Any, _data: Any) -> None:
        self._tell(str(sys.exc_info()[1] or "no answer"))

    def _tell(self, trouble: str) -> None:
        if trouble != self._trouble:  # it is tried again every few seconds, and told once
            log("error", "broker cannot be reached", broker=self.settings.host, why=trouble)
        self._trouble = trouble

    def _disconnected(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        with self._lock:
            self._connection += 1
        if self.up:
            log("warning", "broker lost", broker=self.settings.host, why=str(reason))
        self.up = False

    def _heard(self, _client: Any, _data: Any, message: MQTTMessage) -> None:
        """Take a message, in the client's thread."""
        taken = _Taken(message.mid, message.qos, self._connection, None)
        try:
            asset = topics.asset_of(message.topic)
            if asset not in self._assets:
                raise MessageError("unknown asset", f"{asset[:100]!r} is none of the assets of this source")
            if len(message.payload) > self.settings.largest:
                raise MessageError("oversized", f"{len(message.payload)} bytes, largest = {self.settings.largest}")
            received = decode(asset, bytes(message.payload), time.monotonic())
            self._in_order(received)
            if not message.qos and len(self._waiting) >= self.settings.in_flight:
                raise MessageError("overflow", "sent without acknowledgement, faster than it can be taken")
        except MessageError as error:
            self._refusals.add("" if error.kind == "unknown asset" else asset, error.kind, str(error))
            self._acknowledge(taken)
            return
        block = received.block
        place = block.stream, block.sequence
        self._last[asset] = max(place, self._last.get(asset, place))
        with self._lock:
            # offered once more in a new connection, it takes the place that it has: the queue does not grow by it
            key: tuple[Any, ...] = asset, *place, float(block.t[0])
            if key in self._waiting and self._waiting[key][1].connection == taken.connection:
                key = *key, taken.mid  # sent twice
            self._waiting[key] = block, taken._replace(place=place if block.kept else None)

    def _in_order(self, received: Received) -> None:
        """Wait for a block before this one, if its sender has it and will send it again."""
        block, oldest = received
        stream, sequence = self._last.get(block.asset, (0, -1))
        following = sequence + 1 if stream == block.stream else 0
        if oldest is not None and block.stream >= stream and block.sequence > max(following, oldest):
            what = f"block {block.sequence} came before block {following}, which its sender keeps"
            raise MessageError("ahead", what)

    def poll(self, most: int) -> list[Block]:
        """Return blocks in the order in which they came."""
        with self._lock:
            keys = list(islice(self._waiting, most))
            found = [self._waiting.pop(key) for key in keys]
        for block, taken in found:
            self._taken[block.asset].append(taken)
        return [block for block, _ in found]

    def acknowledge(self, asset: str, blocks: int) -> None:
        """Tell the broker, and a sender that keeps its blocks, that they are safe."""
        place: tuple[int, int] | None = None
        for _ in range(blocks):
            one = self._taken[asset].popleft()
            self._acknowledge(one)
            if one.place is not None:
                self._safe[asset] = place = max(one.place, self._safe.get(asset, one.place))
        if place is not None and self.up:
            message = topics.to_ack(*place)
            self._client.publish(topics.ack(self.settings.topic, asset), message, qos=1, retain=True)

    def _acknowledge(self, taken: _Taken) -> None:
        with self._lock:
            if taken.connection == self._connection:  # otherwise the broker offers it again, and it is a repetition
                self._client.ack(taken.mid, taken.qos)

    def refused(self) -> list[Refusal]:
        """Return what could not be used since the last call."""
        return self._refusals.taken()

    @property
    def waits(self) -> float:
        """How long until the next block may be due [s]."""
        return 0.0 if self._waiting else POLL_S

    def close(self) -> None:
        """Disconnect; the broker keeps what comes meanwhile."""
        self._client.disconnect()
        self._client.loop_stop()
