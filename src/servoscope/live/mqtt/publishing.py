"""Recordings sent to a broker as if measured now; each block is kept until the service says that it is safe."""

from __future__ import annotations

import math
import time
from collections import deque
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, PrivateAttr, ValidationError

from servoscope.broker import KEEPALIVE_S, BrokerSettings, reach
from servoscope.complaints import describe
from servoscope.errors import ConfigError, MessageError, SourceError
from servoscope.live.block import Block, Resume
from servoscope.live.logs import log
from servoscope.live.mqtt import payload, topics
from servoscope.live.replay import Replay, ReplaySettings
from servoscope.live.settings import Seconds
from servoscope.loop import Loop
from servoscope.settings import Settings, Word, parsed, text_of

if TYPE_CHECKING:
    from paho.mqtt.client import MQTTMessage, MQTTMessageInfo

__all__ = ["PublishSettings", "Publisher"]

TURN_S = 0.02
HEARS_S = 1.0  # that is waited for what the broker retains: how far an earlier run had come
LONGEST_S = 60.0  # between two attempts to have a block acknowledged


class Published(Settings):
    """An asset whose recordings are sent: its loop file, and the recordings, one after the other."""

    loop: Word
    files: Annotated[tuple[Word, ...], Field(min_length=1)]


class PublishSettings(Settings):
    """A file for ``publish``.

    Parameters
    ----------
    broker
        Where to.
    topic
        What all topics begin with.
    format
        Of the messages.
    replay
        How fast, and in which blocks. With a fixed `start`, a run that was interrupted is gone on with.
    ahead
        How many blocks are kept per asset while they wait for their acknowledgement.
    again_s
        How long an acknowledgement is waited for, at least, before the oldest block is sent again; twice as long as the
        last one took, and doubled as long as there is none [s].
    assets
        Tables by name: ``[assets.NAME]``.
    """

    broker: BrokerSettings
    topic: topics.Prefix = "servoscope"
    format: Literal["binary", "json"] = "binary"
    replay: ReplaySettings = ReplaySettings()
    ahead: Annotated[int, Field(strict=True, ge=1)] = 100
    again_s: Seconds = 5.0
    assets: Annotated[dict[Annotated[str, Field(pattern=r"^[\w][\w.:-]*$")], Published], Field(min_length=1)]
    _folder: Path = PrivateAttr(default=Path())

    @property
    def folder(self) -> Path:
        """What its paths are relative to."""
        return self._folder

    @classmethod
    def load(cls, path: str | Path) -> PublishSettings:
        """Read a file.

        Raises
        ------
        ConfigError
            If it cannot be read, is not TOML, or a key in it is wrong.
        """
        path = Path(path)
        mapping = parsed(text_of(path, "file of what to publish", ConfigError), path, ConfigError)
        try:
            found = cls.model_validate(mapping)
        except ValidationError as error:
            raise ConfigError(f"{path}: {describe(error, cls)}") from None
        found._folder = path.absolute().parent
        return found


@dataclass
class _Kept:
    """A block that is not known to be safe, its last way to the broker, and when it was sent, if it was so once."""

    sequence: int
    message: bytes
    info: MQTTMessageInfo | None = None
    once: float | None = None


@dataclass
class _Line:
    """The blocks of one asset on their way: kept, of which `sent` were sent; at `again` the oldest is, as a `probe`."""

    wait: float
    kept: deque[_Kept] = field(default_factory=deque)
    sent: int = 0
    again: float = math.inf
    probe: int | None = None


class Publisher:
    """Sends recordings, and ends when all of them are known to be safe.

    Parameters
    ----------
    settings
        What is sent, and where to.
    """

    def __init__(self, settings: PublishSettings) -> None:
        start = settings.replay.start or datetime.now(UTC)
        self.settings = settings
        self._stream = round(start.timestamp() * 1e6)
        self._began = start.timestamp()
        files = {
            name: (tuple(settings.folder / file for file in one.files), Loop.load(settings.folder / one.loop))
            for name, one in settings.assets.items()
        }
        self._replay = Replay(settings.replay.model_copy(update={"start": start}), files)
        self._client = reach(settings.broker, settings.folder, "")
        self._client.on_connect, self._client.on_disconnect = self._connected, self._disconnected
        self._client.on_message = self._heard
        self._acks: SimpleQueue[tuple[str, int, int]] = SimpleQueue()
        self._lines = {name: _Line(settings.again_s) for name in settings.assets}
        self._up = self._fresh = False
        self._stopping = False
        self.safe = self.repeated = 0  # blocks that were acknowledged, and messages that were sent once more

    def stop(self) -> None:
        """Ask it to stop."""
        self._stopping = True

    def run(self) -> None:
        """Send everything.

        Raises
        ------
        SourceError
            If it was stopped before all was safe, or the service has counted a later stream of an asset.
        """
        self._client.connect_async(*self.settings.broker.address, keepalive=KEEPALIVE_S)
        self._client.loop_start()
        try:
            self._begin()
            while not self._stopping and not self._done:
                self._turn()
                time.sleep(TURN_S)
        finally:
            self._client.disconnect()
            self._client.loop_stop()
        if left := sum(len(line.kept) for line in self._lines.values()):
            raise SourceError(
                f"stopped while {left} blocks were not known to be safe; the same start goes on with them"
            )
        log("info", "published", safe=self.safe, repeated=self.repeated)

    @property
    def _done(self) -> bool:
        return math.isinf(self._replay.waits) and not any(line.kept for line in self._lines.values())

    def _begin(self) -> None:
        """Go on behind what the service has."""
        while not self._up and not self._stopping:
            time.sleep(TURN_S)
        time.sleep(HEARS_S)
        known = {name: Resume(sequence, self._began, self._stream) for name, sequence in self._heard_of().items()}
        log("info", "publishing", assets=len(self._lines), going_on=len(known))
        self._replay.open(known)

    def _heard_of(self) -> dict[str, int]:
        """Return up to which block each asset is safe, as was told since the last call.

        Raises
        ------
        SourceError
            If the service is further than this stream.
        """
        found: dict[str, int] = {}
        for _ in range(self._acks.qsize()):
            asset, stream, sequence = self._acks.get()
            if stream > self._stream:
                began = datetime.fromtimestamp(stream / 1e6, UTC).isoformat()
                raise SourceError(f"{asset}: the service has a stream that began at {began}: give a later start")
            if stream == self._stream:
                found[asset] = max(sequence, found.get(asset, -1))
        return found

    def _turn(self) -> None:
        now = time.monotonic()
        for asset, sequence in self._heard_of().items():
            self._let_go(self._lines[asset], sequence, now)
        if not self._up:
            return
        room = self.settings.ahead * len(self._lines) - sum(len(line.kept) for line in self._lines.values())
        for block in self._replay.poll(room):
            self._keep(replace(block, stream=self._stream))
        fresh, self._fresh = self._fresh, False
        for asset, line in self._lines.items():
            if fresh:
                line.sent = 0
            elif line.sent and now >= line.again:
                # only slow, or lost? All of them again would make what is slow slower
                self._send(asset, line.kept[0])
                line.probe, line.wait = line.kept[0].sequence, min(2.0 * line.wait, LONGEST_S)
                line.again = now + line.wait
            if line.sent < len(line.kept):
                for one in list(line.kept)[line.sent :]:
                    self._send(asset, one)
                line.sent, line.again = len(line.kept), now + line.wait

    def _let_go(self, line: _Line, sequence: int, now: float) -> None:
        """Take note that an asset's blocks are safe, up to this one."""
        while line.kept and line.kept[0].sequence <= sequence:
            one = line.kept.popleft()
            line.sent = max(0, line.sent - 1)
            if one.once is not None:  # of one that was sent again, nobody knows which was answered (Karn, 1987)
                line.wait = max(self.settings.again_s, min(2.0 * (now - one.once), LONGEST_S))
            self.safe += 1
        if sequence == line.probe:
            line.sent = 0  # it was answered, and none behind it: they are lost as well
        line.probe, line.again = None, now + line.wait

    def _keep(self, block: Block) -> None:
        kept = self._lines[block.asset].kept
        encode = payload.encode if self.settings.format == "binary" else payload.to_json
        kept.append(_Kept(block.sequence, encode(block, kept[0].sequence if kept else block.sequence)))

    def _send(self, asset: str, one: _Kept) -> None:
        """Send a block, unless the broker has not taken it yet: then the client does so itself."""
        if one.info is None or one.info.is_published():
            self.repeated += one.info is not None
            one.once = time.monotonic() if one.info is None else None
            one.info = self._client.publish(topics.data(self.settings.topic, asset), one.message, qos=1)

    def _connected(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            log("error", "broker refuses", broker=self.settings.broker.host, why=str(reason))
            return
        self._client.subscribe([(topics.ack(self.settings.topic, name), _at_least_once()) for name in self._lines])
        self._up = self._fresh = True

    def _disconnected(self, *_: Any) -> None:
        self._up = False

    def _heard(self, _client: Any, _data: Any, message: MQTTMessage) -> None:
        try:
            self._acks.put((topics.asset_of(message.topic), *topics.ack_of(bytes(message.payload))))
        except MessageError as error:
            log("warning", "refused", topic=message.topic, why=str(error))


def _at_least_once() -> Any:
    from paho.mqtt.subscribeoptions import SubscribeOptions

    return SubscribeOptions(qos=1)
