"""Blocks from a plant's messages in Kafka; offsets are committed only up to where everything is stored."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from servoscope.core.errors import ConfigError
from servoscope.core.messages import message, render
from servoscope.core.settings import NonEmptyStr
from servoscope.service.config_types import PORT, matching, read_password
from servoscope.service.log import log
from servoscope.service.mapping.rows import MessageMapping
from servoscope.service.mapping.settings import PayloadSettings
from servoscope.service.network import TlsSettings
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.message import InboxMessage, RejectionCounter, SourceAsset, ThreadTransport
from servoscope.service.sources.settings import SourceSettings

FETCH_S = 0.2  # how long one call of the client waits for messages
SESSION_MS = 6000  # after a kill so long, the brokers give our partitions away, to our next process as well
AT_ONCE = 500  # messages that one call returns


Broker = Annotated[str, Field(strict=True), matching(f".+:{PORT}", "{value!r} is no address, write kafka.example:9092")]


class KafkaSourceSettings(TlsSettings, SourceSettings):
    """A source of kind ``kafka``."""

    kind: Literal["kafka"]
    brokers: Annotated[tuple[Broker, ...], Field(min_length=1)]  # ``host:port`` of some of them
    payload: PayloadSettings  # where the samples are in messages
    # the group whose offsets are ours; None: one of our own, from the service's name. No two services may share one.
    client: Annotated[str, Field(strict=True, min_length=1, max_length=200)] | None = None
    # user, password_file: who we are (SASL PLAIN); the password is the first line of a file
    user: NonEmptyStr | None = None
    password_file: NonEmptyStr | None = None
    tls: Annotated[bool, Field(strict=True)] = False  # encrypts the connection; brokers have to prove their identity
    start: Literal["now", "beginning"] = "now"  # where a group without offsets begins
    in_flight: Annotated[int, Field(strict=True, ge=1, le=10**7)] = 100_000  # most messages that wait to be stored
    largest: Annotated[int, Field(strict=True, ge=1024, le=2**28)] = 2**20  # longest message that is accepted [bytes]

    visit_changes: ClassVar[Mapping[str, Any]] = {"client": None, "start": "now"}

    def identity(self, name: str) -> str:
        """Return what no other source may share: the group at these brokers."""
        return f"group {self.client or name} at {', '.join(sorted(self.brokers))}"

    def carries(self, covariate: str, address: Any) -> bool:
        """Messages have what the payload names."""
        return self.payload.carries(covariate)

    def create(self, name: str, assets: Mapping[str, SourceAsset], folder: Path) -> Inbox:
        """Return the source."""
        rejections = RejectionCounter()
        decoder = MessageMapping.of_assets(self.payload, assets, rejections)
        return Inbox(KafkaTransport(self, folder, name), decoder, assets, rejections, self.in_flight)

    def client_settings(self, name: str, folder: Path) -> dict[str, Any]:
        """Return what the client library calls these settings."""
        settings: dict[str, Any] = {
            "bootstrap.servers": ",".join(self.brokers),
            "group.id": self.client or name,
            "enable.auto.commit": False,
            "session.timeout.ms": SESSION_MS,
            "auto.offset.reset": "latest" if self.start == "now" else "earliest",
            "fetch.message.max.bytes": self.largest,
            "log_level": 0,  # what matters comes by error_cb
        }
        protocol = "SSL" if self.tls else "PLAINTEXT"
        if self.user is not None:
            password = read_password(self.password_file, folder) or ""
            settings |= {"sasl.mechanism": "PLAIN", "sasl.username": self.user, "sasl.password": password}
            protocol = f"SASL_{protocol}"
        files = {"ssl.ca.location": self.ca_file, "ssl.certificate.location": self.cert_file}
        files["ssl.key.location"] = self.key_file
        given = {key: str(folder / name) for key, name in files.items() if name is not None}
        if given and not self.tls:
            raise ConfigError("certificates are given, but not tls = true")
        return settings | given | {"security.protocol": protocol}


class _PartitionOffsets:
    """The offsets of one partition that are not stored."""

    def __init__(self) -> None:
        self.open: dict[int, None] = {}  # in the order in which they came
        self.next = -1  # behind the last one that came

    @property
    def committable(self) -> int:
        """The offset up to which everything is stored."""
        return next(iter(self.open), self.next)


class KafkaTransport(ThreadTransport):
    """Receives the messages of some topics; `client` names our group, unless the settings do."""

    def __init__(self, settings: KafkaSourceSettings, folder: Path, client: str) -> None:
        super().__init__()
        try:
            import confluent_kafka
        except ModuleNotFoundError:
            raise ConfigError("confluent-kafka is missing, pip install 'servoscope[kafka]'") from None
        self.settings, self._kafka = settings, confluent_kafka
        self._topics = sorted({topic.partition("/")[0] for topic in settings.payload.topics})
        if fixed := [topic for topic in self._topics if "{" in topic]:
            raise ConfigError(f"payload.topics: {fixed[0]!r}: names may stand behind / only, in the message's key")
        if not settings.rules.internal:
            raise ConfigError(
                "[network] refuses internal addresses, which Kafka's client cannot be held to: write network = {}"
            )
        named = all("{asset}" in topic for topic in settings.payload.topics)
        self._keys_name_assets = named and not settings.is_visit
        self._client_settings = settings.client_settings(client, folder)
        self._lock = threading.Lock()
        self._offsets: dict[tuple[str, int], _PartitionOffsets] = {}
        self.trouble, self.connected = render(message("service.trouble.connecting")), False

    def _run(self) -> None:
        """Follow the topics: the client's calls all come from this thread."""
        consumer = self._kafka.Consumer({**self._client_settings, "error_cb": self._note_error})
        consumer.subscribe(self._topics, on_assign=self._begin_partitions, on_revoke=self._end_partitions)
        committed: dict[tuple[str, int], int] = {}
        while not self._stop_event.is_set():
            with self._lock:
                full = sum(len(offset.open) for offset in self._offsets.values()) >= self.settings.in_flight
            if full:  # it must still be called, or the group takes it for dead
                consumer.pause(consumer.assignment())
            for record in consumer.consume(AT_ONCE, FETCH_S):
                self._receive(record)
            if full:
                consumer.resume(consumer.assignment())
            self._commit(consumer, committed)
        self._commit(consumer, committed)
        consumer.close()

    def _note_error(self, error: Any) -> None:
        trouble = render(message("service.trouble.unreachable", reason=str(error.str())[:200]))
        if trouble != self.trouble:
            log("error", "Kafka cannot be followed", brokers=", ".join(self.settings.brokers), why=trouble)
        if error.code() == self._kafka.KafkaError._ALL_BROKERS_DOWN or not self.connected:
            self.trouble, self.connected = trouble, False

    def _begin_partitions(self, _consumer: Any, _partitions: Any) -> None:
        self.trouble, self.connected = "", True
        log("info", "Kafka followed", topics=", ".join(self._topics))

    def _end_partitions(self, _consumer: Any, partitions: Any) -> None:
        with self._lock:  # what is not committed is sent to whom they belong to now
            for partition in partitions:
                self._offsets.pop((partition.topic, partition.partition), None)

    def _receive(self, record: Any) -> None:
        if record.error() is not None:
            self._note_error(record.error())
            return
        self.trouble, self.connected = "", True
        topic, partition, offset = record.topic(), record.partition(), record.offset()
        key, content = record.key(), record.value() or b""
        address = f"{topic}/{key.decode(errors='replace')}" if key else topic
        with self._lock:
            offsets = self._offsets.setdefault((topic, partition), _PartitionOffsets())
            offsets.open[offset], offsets.next = None, offset + 1
        if self._keys_name_assets and not self.decoder.find_asset(address):
            self._settle(offsets, offset)  # another service's: a topic comes as a whole
        elif len(content) > self.settings.largest:
            self.refuse(address, "oversized", f"{len(content)} bytes, largest = {self.settings.largest}")
            self._settle(offsets, offset)
        else:
            release = partial(self._settle, offsets, offset)
            self.waiting.append(InboxMessage(address, content, time.monotonic(), release))

    def _settle(self, offsets: _PartitionOffsets, offset: int) -> None:
        with self._lock:
            offsets.open.pop(offset, None)

    def _commit(self, consumer: Any, committed: dict[tuple[str, int], int]) -> None:
        with self._lock:
            now = {key: offset.committable for key, offset in self._offsets.items()}
        changed = {key: offset for key, offset in now.items() if committed.get(key) != offset and offset >= 0}
        if changed:
            offsets = [self._kafka.TopicPartition(*key, offset) for key, offset in changed.items()]
            try:
                consumer.commit(offsets=offsets, asynchronous=False)
            except self._kafka.KafkaException as error:  # they come again, and are repetitions
                self._note_error(error.args[0])
            else:
                committed.update(changed)
