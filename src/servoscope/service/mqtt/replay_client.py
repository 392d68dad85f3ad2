"""Recordings sent to a broker as if measured now; each block is kept until the service has acknowledged it."""

from __future__ import annotations

import math
import time
from collections import deque
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from queue import SimpleQueue
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field

from servoscope.core.errors import MessageError, SourceError
from servoscope.core.settings import NonEmptyStr, Settings
from servoscope.models.loop import Loop
from servoscope.service.config_types import FileSettings, Seconds
from servoscope.service.log import log
from servoscope.service.mqtt import payload, topics
from servoscope.service.mqtt.client import BrokerConnection, BrokerSettings, create_mqtt_client
from servoscope.service.sources.block import Block, ResumePosition
from servoscope.service.sources.replay import ReplaySettings, ReplayTransport

if TYPE_CHECKING:
    from paho.mqtt.client import MQTTMessage, MQTTMessageInfo


POLL_S = 0.02
RETAINED_WAIT_S = 1.0  # for the acknowledgements that the broker retains: how far an earlier run had come
MAX_RETRY_S = 60.0  # between two attempts to have a block acknowledged


class ReplayAssetSettings(Settings):
    """An asset whose recordings are sent: its loop file, and the recordings, in this order."""

    loop: NonEmptyStr
    files: Annotated[tuple[NonEmptyStr, ...], Field(min_length=1)]


class ReplayClientSettings(FileSettings):
    """A file for ``publish``."""

    kind_of_file: ClassVar[str] = "file of what to publish"

    broker: BrokerSettings
    topic: topics.TopicPrefix = "servoscope"  # what all topics begin with
    format: Literal["binary", "json"] = "binary"  # of the messages
    # how fast, and in which blocks. With a fixed `start`, the next run continues an interrupted one.
    replay: ReplaySettings = ReplaySettings()
    # how many blocks are kept per asset while they wait for their acknowledgement
    ahead: Annotated[int, Field(strict=True, ge=1)] = 100
    # least wait for an acknowledgement before the oldest block is sent again: twice as long as the last one took, and
    # doubled as long as there is none [s]
    again_s: Seconds = 5.0
    # tables by name: ``[assets.NAME]``
    assets: Annotated[dict[Annotated[str, Field(pattern=r"^[\w][\w.:-]*$")], ReplayAssetSettings], Field(min_length=1)]


@dataclass
class _UnacknowledgedBlock:
    """A block on its way, how the client sends it, and when it was sent; None: not yet, or more than once."""

    sequence: int
    message: bytes
    publish_info: MQTTMessageInfo | None = None
    first_sent_at: float | None = None


@dataclass
class _SendQueue:
    """The blocks of one asset: `sent` of them were sent; at `retry_at` the oldest is sent again, as a `probe`."""

    retry_s: float
    blocks: deque[_UnacknowledgedBlock] = field(default_factory=deque)
    sent: int = 0
    retry_at: float = math.inf
    probe: int | None = None


class ReplayClient(BrokerConnection):
    """Sends recordings, and ends when all blocks are acknowledged."""

    def __init__(self, settings: ReplayClientSettings) -> None:
        start = settings.replay.start or datetime.now(UTC)
        self.settings = settings
        self._stream, self._stream_start = round(start.timestamp() * 1e6), start.timestamp()
        files = {
            name: (tuple(settings.folder / file for file in asset.files), Loop.load(settings.folder / asset.loop))
            for name, asset in settings.assets.items()
        }
        self._covariates = {name: tuple(loop.columns.covariates) for name, (_, loop) in files.items()}
        self._replay = ReplayTransport(settings.replay.model_copy(update={"start": start}), files, self._covariates)
        super().__init__(settings.broker, create_mqtt_client(settings.broker, settings.folder, ""))
        self._client.on_message = self._on_message
        self._acks: SimpleQueue[tuple[str, int, int]] = SimpleQueue()
        self._queues = {name: _SendQueue(settings.again_s) for name in settings.assets}
        self._reconnected = self._stopping = False
        self.acknowledged = self.repeated = 0  # blocks that were acknowledged, and messages that were sent once more

    def stop(self) -> None:
        """Stop soon; for a signal's handler or another thread."""
        self._stopping = True

    def run(self) -> None:
        """Send everything.

        Raises SourceError if it was stopped before all was acknowledged, or the service has counted a later stream of
        an asset.
        """
        self.connect()
        try:
            self._begin()
            while not self._stopping and not self._done:
                self._run_once()
                time.sleep(POLL_S)
        finally:
            self.close()
        if left := sum(len(queue.blocks) for queue in self._queues.values()):
            raise SourceError(
                f"stopped while {left} blocks were not known to be safe; the same start goes on with them"
            )
        log("info", "published", safe=self.acknowledged, repeated=self.repeated)

    @property
    def _done(self) -> bool:
        return math.isinf(self._replay.next_message_s) and not any(queue.blocks for queue in self._queues.values())

    def _begin(self) -> None:
        """Continue behind what the service has."""
        while not self.connected and not self._stopping:
            time.sleep(POLL_S)
        time.sleep(RETAINED_WAIT_S)
        known = {
            name: ResumePosition(sequence, self._stream_start, self._stream)
            for name, sequence in self._take_acknowledged().items()
        }
        log("info", "publishing", assets=len(self._queues), going_on=len(known))
        self._replay.open(known)

    def _take_acknowledged(self) -> dict[str, int]:
        """Return the last block of each asset that was acknowledged since the last call.

        Raises SourceError if the service has a later stream than this one.
        """
        acknowledged: dict[str, int] = {}
        for _ in range(self._acks.qsize()):
            asset, stream, sequence = self._acks.get()
            if stream > self._stream:
                began = datetime.fromtimestamp(stream / 1e6, UTC).isoformat()
                raise SourceError(f"{asset}: the service has a stream that began at {began}: give a later start")
            if stream == self._stream:
                acknowledged[asset] = max(sequence, acknowledged.get(asset, -1))
        return acknowledged

    def _run_once(self) -> None:
        now = time.monotonic()
        for asset, sequence in self._take_acknowledged().items():
            self._release(self._queues[asset], sequence, now)
        if not self.connected:
            return
        free = self.settings.ahead * len(self._queues) - sum(len(queue.blocks) for queue in self._queues.values())
        for message in self._replay.receive(free):
            self._enqueue(replace(message.content, stream=self._stream))
        reconnected, self._reconnected = self._reconnected, False
        for asset, queue in self._queues.items():
            if reconnected:
                queue.sent = 0
            elif queue.sent and now >= queue.retry_at:
                # only slow, or lost? Sending all of them again would make what is slow slower
                self._send(asset, queue.blocks[0])
                queue.probe, queue.retry_s = queue.blocks[0].sequence, min(2.0 * queue.retry_s, MAX_RETRY_S)
                queue.retry_at = now + queue.retry_s
            if queue.sent < len(queue.blocks):
                for block in list(queue.blocks)[queue.sent :]:
                    self._send(asset, block)
                queue.sent, queue.retry_at = len(queue.blocks), now + queue.retry_s

    def _release(self, queue: _SendQueue, sequence: int, now: float) -> None:
        """Drop an asset's blocks that were acknowledged, up to this one."""
        while queue.blocks and queue.blocks[0].sequence <= sequence:
            unacknowledged_block = queue.blocks.popleft()
            queue.sent = max(0, queue.sent - 1)
            if (
                unacknowledged_block.first_sent_at is not None
            ):  # of a block sent twice, it is unknown which was answered (Karn, 1987)
                queue.retry_s = max(
                    self.settings.again_s, min(2.0 * (now - unacknowledged_block.first_sent_at), MAX_RETRY_S)
                )
            self.acknowledged += 1
        if sequence == queue.probe:
            queue.sent = 0  # it was answered, and none behind it: they are lost as well
        queue.probe, queue.retry_at = None, now + queue.retry_s

    def _enqueue(self, block: Block) -> None:
        blocks = self._queues[block.asset].blocks
        oldest = blocks[0].sequence if blocks else block.sequence
        if self.settings.format == "binary":
            message = payload.encode_binary(block, oldest)
        else:
            message = payload.encode_json(block, oldest, self._covariates[block.asset])
        blocks.append(_UnacknowledgedBlock(block.sequence, message))

    def _send(self, asset: str, message: _UnacknowledgedBlock) -> None:
        """Send a block, unless the client is still sending it to the broker itself."""
        try:
            sending = message.publish_info is not None and not message.publish_info.is_published()
        except RuntimeError:  # it was handed over while the connection broke: unknown, and twice does no harm
            sending = False
        if not sending:
            self.repeated += message.publish_info is not None
            message.first_sent_at = time.monotonic() if message.publish_info is None else None
            message.publish_info = self._client.publish(
                topics.data_topic(self.settings.topic, asset), message.message, qos=1
            )

    def _on_change(self, accepted: bool) -> None:
        from paho.mqtt.subscribeoptions import SubscribeOptions

        if accepted:
            acks = [topics.ack_topic(self.settings.topic, name) for name in self._queues]
            self._client.subscribe([(topic, SubscribeOptions(qos=1)) for topic in acks])
            self._reconnected = True

    def _on_message(self, _client: Any, _data: Any, message: MQTTMessage) -> None:
        try:
            self._acks.put((topics.parse_asset(message.topic), *topics.decode_ack(bytes(message.payload))))
        except MessageError as error:
            log("warning", "refused", topic=message.topic, why=str(error))
