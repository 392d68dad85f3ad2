"""Verdicts and alarms published to an MQTT broker, retained: whoever subscribes knows at once how assets are."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from servoscope.broker import KEEPALIVE_S, BrokerSettings, reach
from servoscope.live.mqtt import topics
from servoscope.live.outlet import Statuses
from servoscope.settings import NotNegative

__all__ = ["MqttOutlet", "MqttOutletSettings"]

ALWAYS = ("verdict", "ne107", "alarms", "faults", "quality", "service")  # a change of these is told at once


class MqttOutletSettings(BrokerSettings):
    """An outlet of kind ``mqtt``.

    Parameters
    ----------
    topic
        What all topics begin with: an asset is told of under ``TOPIC/v1/status/ASSET``.
    client
        Name of the session at the broker; None: ``SERVICE.OUTLET``.
    every_s
        Time between two messages about an asset of which nothing but numbers has changed [s].
    """

    kind: Literal["mqtt"]
    topic: topics.Prefix = "servoscope"
    client: Annotated[str, Field(strict=True, min_length=1, max_length=200)] | None = None
    every_s: NotNegative = 10.0


class MqttOutlet:
    """Publishes the newest status of each asset.

    Parameters
    ----------
    settings
        Of the outlet.
    folder
        What files are relative to.
    client
        Name of the session, unless the settings have one.
    """

    def __init__(self, settings: MqttOutletSettings, folder: Path, client: str) -> None:
        self.settings = settings
        self._client = reach(settings, folder, settings.client or client)
        self._client.on_connect, self._client.on_disconnect = self._connected, self._disconnected
        self._lock = threading.Lock()
        self._newest: dict[str, bytes] = {}
        self._told: dict[str, tuple[Any, float]] = {}
        self._up = False

    def open(self, statuses: Statuses) -> None:
        """Connect, now or as soon as the broker is there."""
        self.tell(statuses)
        self._client.connect_async(*self.settings.address, keepalive=KEEPALIVE_S)
        self._client.loop_start()

    def tell(self, statuses: Statuses) -> None:
        """Publish what is news."""
        now = time.monotonic()
        for name, status in statuses.items():
            news = {key: status.get(key) for key in ALWAYS}
            before, at = self._told.get(name, (None, 0.0))
            if news == before and now < at + self.settings.every_s:
                continue
            self._told[name] = news, now
            message = json.dumps({"asset": name, **status}, separators=(",", ":")).encode()
            with self._lock:
                self._newest[name] = message
                if self._up:
                    self._publish(name)

    def _publish(self, name: str) -> None:
        self._client.publish(topics.status(self.settings.topic, name), self._newest[name], qos=1, retain=True)

    def _connected(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        with self._lock:
            self._up = not reason.is_failure
            for name in self._newest if self._up else ():  # the broker may have forgotten, or never have heard
                self._publish(name)

    def _disconnected(self, *_: Any) -> None:
        with self._lock:
            self._up = False

    def close(self) -> None:
        """Disconnect."""
        self._client.disconnect()
        self._client.loop_stop()
