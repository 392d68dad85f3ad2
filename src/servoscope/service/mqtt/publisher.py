"""Verdicts and alarms published to an MQTT broker, retained: whoever subscribes receives the newest at once."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import Any, Literal

from servoscope.core.settings import NonNegative
from servoscope.service.mqtt import topics
from servoscope.service.mqtt.client import BrokerConnection, SessionSettings, create_mqtt_client
from servoscope.service.publishers.base import PublisherSettings, StatusByAsset

IMMEDIATE_KEYS = ("verdict", "ne107", "alarms", "faults", "quality", "service")  # changes of these are sent at once


class MqttPublisherSettings(SessionSettings, PublisherSettings):
    """An outlet of kind ``mqtt``."""

    kind: Literal["mqtt"]
    # what all topics begin with: the status of an asset is published under ``TOPIC/v1/status/ASSET``
    topic: topics.TopicPrefix = "servoscope"
    every_s: NonNegative = 10.0  # time between two messages about an asset of which nothing but numbers has changed [s]

    def create(self, name: str, folder: Path) -> MqttPublisher:
        """Return the publisher."""
        return MqttPublisher(self, folder, name)


class MqttPublisher(BrokerConnection):
    """Publishes the newest status of each asset; `client` names its session, unless the settings do."""

    def __init__(self, settings: MqttPublisherSettings, folder: Path, client: str) -> None:
        client = settings.client or client
        super().__init__(settings, create_mqtt_client(settings, folder, client), client)
        self.settings = settings
        self._lock = threading.Lock()
        self._newest: dict[str, bytes] = {}
        self._published: dict[str, tuple[Any, float]] = {}

    def open(self, statuses: StatusByAsset) -> None:
        """Connect, now or as soon as the broker is there."""
        self.publish(statuses)
        self.connect()

    def publish(self, statuses: StatusByAsset) -> None:
        """Publish what has changed."""
        now = time.monotonic()
        for name, status in statuses.items():
            immediate = {key: status.get(key) for key in IMMEDIATE_KEYS}
            before, at = self._published.get(name, (None, 0.0))
            if immediate == before and now < at + self.settings.every_s:
                continue
            self._published[name] = immediate, now
            message = json.dumps({"asset": name, **status}, separators=(",", ":")).encode()
            with self._lock:
                self._newest[name] = message
                if self.connected:
                    self._send(name)

    def _send(self, name: str) -> None:
        self._client.publish(topics.status_topic(self.settings.topic, name), self._newest[name], qos=1, retain=True)

    def _on_change(self, accepted: bool) -> None:
        with self._lock:
            for name in self._newest if accepted else ():  # the broker may have lost them, or never had them
                self._send(name)
