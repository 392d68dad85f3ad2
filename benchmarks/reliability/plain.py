"""A sender over MQTT that keeps nothing, as most do."""

from __future__ import annotations

import threading
import time
from pathlib import Path

from reliability.fleet import BLOCK_S, Fleet
from reliability.plc import BEGAN, tape
from servoscope.service.mqtt import payload, topics
from servoscope.service.mqtt.client import BrokerSettings, create_mqtt_client

__all__ = ["Plain"]


class Plain:
    """A sender that keeps nothing: what its broker forgets is gone."""

    def __init__(self, fleet: Fleet, port: int) -> None:
        self._tape = tape(fleet.folder)
        self._client = create_mqtt_client(BrokerSettings(host="127.0.0.1", port=port), Path(), "plain")
        self._client.connect_async("127.0.0.1", port, keepalive=5)
        self._client.loop_start()
        self._over, self._every = threading.Event(), BLOCK_S / fleet.speed
        self.sent = 0
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._over.wait(self._every):
            block = self._tape.block("plain", self.sent, BEGAN)
            assert block is not None
            self._client.publish(topics.data_topic("servoscope", "plain"), payload.encode_binary(block), qos=1)
            self.sent += 1

    def close(self) -> None:
        """Stop, and give the last one time to arrive."""
        self._over.set()
        self._thread.join()
        time.sleep(2.0)
        self._client.disconnect()
        self._client.loop_stop()
