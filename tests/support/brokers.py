"""What the MQTT tests share: a broker, a source's taker that commits or dies, publishers that keep nothing, or all."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from inboxes import STUB
from reliability.servers import Mosquitto, mosquitto

from servoscope.service.assets.checkpoint import StreamPosition
from servoscope.service.assets.records import check_continuity
from servoscope.service.mqtt import payload
from servoscope.service.mqtt.client import BrokerSettings, create_mqtt_client
from servoscope.service.mqtt.replay_client import ReplayClient, ReplayClientSettings
from servoscope.service.mqtt.source import MqttSourceSettings
from servoscope.service.service import Service
from servoscope.service.sources.block import Block, ResumePosition
from servoscope.service.sources.inbox import Inbox

BEGAN = 1767225600.0  # 2026-01-01T00:00:00Z
LOOP = Path(__file__).parents[2] / "src/servoscope/simulation/reference-rig.toml"


def until(holds: Callable[[], Any], seconds: float = 300.0) -> Any:
    """Wait until something holds, and return it."""
    deadline = time.monotonic() + seconds
    while not (found := holds()):
        assert time.monotonic() < deadline, "it never came to that"
        time.sleep(0.02)
    return found


def started_broker(folder: Path) -> Mosquitto:
    """Return a broker that runs; whoever asks for it stops it."""
    program = mosquitto()
    if program is None:
        pytest.skip("Mosquitto is not on this machine: scripts/install-test-servers installs it")
    server = Mosquitto(folder, program)
    server.start()
    return server


def block(sequence: int, *, stream: int = 0, samples: int = 50, value: float = 0.0) -> Block:
    """Return a block of the asset press."""
    t = BEGAN + 0.01 * (samples * sequence + np.arange(samples))
    return Block("press", sequence, t, *np.full((3, samples), value), stream=stream)


@dataclass
class Taker:
    """Takes blocks as the service does, and commits what it has counted; what was not committed dies with it."""

    port: int
    assets: frozenset[str] = frozenset({"press"})
    kept: dict[str, tuple[StreamPosition, list[tuple[int, int]]]] = field(
        default_factory=dict
    )  # what a store would hold

    def start(self) -> Inbox:
        settings = MqttSourceSettings(kind="mqtt", host="127.0.0.1", port=self.port, client="hall")
        self.source = settings.create("hall", dict.fromkeys(self.assets, STUB), Path())
        self.source.open(
            {asset: ResumePosition(one.sequence, BEGAN, one.stream) for asset, (one, _) in self.kept.items()}
        )
        self._now, self._taken = dict(self.kept), dict.fromkeys(self.assets, 0)
        until(lambda: self.source.connected)
        time.sleep(0.1)  # the broker has the subscription by then
        return self.source

    def turn(self, *, commit: bool = True) -> None:
        for one in self.source.poll(1000):
            counted, order = self._now.get(one.asset, (None, []))
            found = check_continuity(counted, one)
            before = counted or StreamPosition(BEGAN, BEGAN)
            if found is None:
                counted = replace(before, repeated=before.repeated + 1)
            else:
                counted = replace(
                    before, sequence=one.sequence, stream=one.stream, t=one.t[-1], lost=before.lost + found.lost
                )
                order = [*order, (one.stream, one.sequence)]
            self._now[one.asset] = counted, order
            self._taken[one.asset] += 1
        if commit:
            self.kept = dict(self._now)
            for asset, blocks in self._taken.items():
                self.source.acknowledge(asset, blocks)
                self._taken[asset] = 0

    def until(self, holds: Callable[[], Any]) -> None:
        until(lambda: (self.turn(), holds())[1])

    def die(self) -> None:
        """End without a word to the broker but that the connection is gone."""
        self.source.close()


class Sender:
    """A publisher that sends what it is told, and keeps nothing."""

    def __init__(self, port: int) -> None:
        self.client = create_mqtt_client(BrokerSettings(host="127.0.0.1", port=port), Path(), "")
        self.heard: dict[str, Any] = {}
        self.client.on_message = lambda *words: self.heard.update({words[-1].topic: json.loads(words[-1].payload)})
        self.client.connect("127.0.0.1", port)
        self.client.loop_start()

    def send(self, *messages: bytes | Block, asset: str = "press") -> None:
        for one in messages:
            message = payload.encode_json(one) if isinstance(one, Block) else one
            self.client.publish(f"servoscope/v1/data/{asset}", message, qos=1).wait_for_publish(30.0)

    def close(self) -> None:
        self.client.disconnect()
        self.client.loop_stop()


def kafka_cluster() -> Any:
    """Return a producer whose library simulates a Kafka of one broker, as long as it lives."""
    import confluent_kafka

    return confluent_kafka.Producer({"test.mock.num.brokers": 1, "bootstrap.servers": "none", "log_level": 0})


def kafka_brokers(producer: Any) -> list[str]:
    """Return the addresses of the simulated brokers."""
    return [f"{one.host}:{one.port}" for one in producer.list_topics(timeout=10.0).brokers.values()]


def publisher(folder: Path, port: int, *, speed: float = 0.0, files: str = "press.csv", more: str = "") -> ReplayClient:
    """Return a publisher of a recording in a folder, in blocks of half a second."""
    path = folder / "publish.toml"
    path.write_text(
        f"again_s = 0.5\n[replay]\nspeed = {speed}\nblock = 0.5\nstart = 2026-01-01T00:00:00Z\n"
        f'[broker]\nhost = "127.0.0.1"\nport = {port}\n{more}\n'
        f'[assets.press]\nloop = "{LOOP}"\nfiles = ["{files}"]\n'
    )
    return ReplayClient(ReplayClientSettings.load(path))


class Running:
    """A service, or a publisher, in a thread of its own."""

    error: Exception | None = None

    def __init__(self, one: Service | ReplayClient) -> None:
        self.one = one
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.one.run()
        except Exception as error:
            self.error = error

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def end(self, seconds: float = 300.0, *, stop: bool = False) -> None:
        if stop:
            self.one.stop()
        self._thread.join(seconds)
        assert not self._thread.is_alive()
        if self.error is not None:
            raise self.error
