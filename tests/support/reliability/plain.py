"""A sender over MQTT that keeps nothing, as most do."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path

from reliability.fleet import Fleet
from reliability.plc import tape
from servoscope.service.mqtt import payload, topics
from servoscope.service.mqtt.client import BrokerSettings, create_mqtt_client

__all__ = ["Plain"]

AHEAD_S = 7200.0  # by which its clock is wrong after a jump


class Plain:
    """A sender that keeps nothing, what its broker forgets is gone; and whose clock may jump ahead for some blocks."""

    def __init__(self, fleet: Fleet, port: int) -> None:
        self._fleet, self._tape = fleet, tape(fleet)
        self._client = create_mqtt_client(BrokerSettings(host="127.0.0.1", port=port), Path(), "plain")
        self._client.connect_async("127.0.0.1", port, keepalive=5)
        self._client.loop_start()
        self._over, self._every = threading.Event(), fleet.block_s / fleet.speed
        self._wrong = 0  # blocks that are still to be sent by the wrong clock
        self.sent = 0
        self.misdated: set[int] = set()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._over.wait(self._every):
            block = self._tape.block("plain", self.sent, self._fleet.began)
            assert block is not None
            if self._wrong:
                block = replace(block, t=block.t - block.t[0] + time.time() + AHEAD_S)
                self._wrong -= 1
                self.misdated.add(self.sent)
            self._client.publish(topics.data_topic("servoscope", "plain"), payload.encode_binary(block), qos=1)
            self.sent += 1

    def jump(self, blocks: int) -> None:
        """Send some blocks by a clock that is ahead, and return when they are sent."""
        self._wrong = blocks
        while self._wrong:
            time.sleep(0.05)

    def close(self) -> None:
        """Stop, and give the last one time to arrive."""
        self._over.set()
        self._thread.join()
        time.sleep(2.0)
        self._client.disconnect()
        self._client.loop_stop()
