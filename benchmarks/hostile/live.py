"""Slowest answer of /health/live, and memory, of a real service while it is sent messages that are made to cost much.

    python benchmarks hostile/live [--fuzzed 300]

Sends over mosquitto what hung, slowed down or filled a service once, then fuzzed messages of up to 1 MiB of all three
encodings, and asks for health meanwhile. Fails if an answer takes a second or longer, or none comes.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from http.client import HTTPException
from pathlib import Path

BENCHMARKS = Path(__file__).resolve().parent.parent
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from reliability.servers import Mosquitto, mosquitto  # noqa: E402
from reliability.workplace import free_port  # noqa: E402
from tables import machine  # noqa: E402

from hostile.damage import damaged  # noqa: E402
from servoscope.learning.learn import nominal_baseline  # noqa: E402
from servoscope.models.loop import Loop  # noqa: E402
from servoscope.service.mapping.sparkplug import payload_class  # noqa: E402
from servoscope.service.mqtt.client import BrokerSettings, create_mqtt_client  # noqa: E402

LOOP = BENCHMARKS.parent / "src/servoscope/simulation/reference-rig.toml"
MAX_ANSWER_S, START_S, ASK_EVERY_S = 1.0, 300.0, 0.02
MAX_BYTES = 2**20
SOURCES = {
    "json": 'topics = ["json/{asset}"]\nmatch = { id = "Channel1.{line}.{signal}" }\nvalue = "v"\ntime = { t = "ms" }',
    "influx": 'form = "influx"\ntopics = ["influx/{asset}"]\nmatch = { name = "axis" }',
    "sparkplug": 'form = "sparkplug"',
}
Message = tuple[str, bytes]


def write_service(folder: Path, broker: int, health: int) -> Path:
    """Write the service file: an asset for each encoding."""
    nominal_baseline(Loop.load(LOOP)).save(folder / "baseline.json")
    text = f'name = "hall"\n[service]\nlisten = "127.0.0.1:{health}"\nlog = "error"\n'
    for name, payload in SOURCES.items():
        text += f'[sources.{name}]\nkind = "mqtt"\nhost = "127.0.0.1"\nport = {broker}\n'
        text += f'[sources.{name}.payload]\n{payload}\n[assets.{name}]\nbaseline = "baseline.json"\nsource = "{name}"\n'
    (folder / "hall.toml").write_text(text, encoding="utf-8")
    return folder / "hall.toml"


def birth(node: int) -> bytes:
    """Return a birth of 730 kB that names metrics nobody maps."""
    payload = payload_class()(timestamp=1)
    for alias in range(20_000):
        payload.metrics.add(name=f"made-up/{node}/{alias}", alias=alias + 1, datatype=10, double_value=0.0)
    return bytes(payload.SerializeToString())


def costly_messages() -> Iterator[tuple[str, list[Message]]]:
    """Yield what once cost much, by name."""
    dots = json.dumps({"id": "Channel1." + (MAX_BYTES - 100) * "." + "/", "v": 1.0, "t": 1}).encode()
    yield "text of dots", [("json/json", dots)]
    rows = [{"id": "Channel1.a.y", "v": "x", "t": 1}] * 20_000
    yield "useless rows", [("json/json", json.dumps(rows).encode())]
    yield "empty rows", [("json/json", b"[" + b"{}," * 349_000 + b"{}]")]
    yield "lines of nothing", [("influx/influx", b"x a=1\n" * 174_000)]
    yield "births of made-up nodes", [(f"spBv1.0/g/NBIRTH/n{node}", birth(node)) for node in range(40)]


def fuzzed_messages(count: int, seed: int = 1) -> Iterator[Message]:
    """Yield damaged messages of up to 1 MiB."""
    chance = random.Random(seed)
    good = {
        "json/json": json.dumps([{"id": "Channel1.a.y", "v": 0.5, "t": 1767225600000}]).encode(),
        "influx/influx": b"axis,line=a r=0.1,u=2.3,y=0.099 1767225600000000000\n",
        "spBv1.0/g/DDATA/n/sparkplug": birth(0)[:200],
    }
    for number in range(count):
        topic = chance.choice(list(good))
        content = good[topic] * chance.choice((1, 100, MAX_BYTES // len(good[topic])))
        yield topic, damaged(content, chance, number)[:MAX_BYTES]


class Health:
    """Asks a service for its health again and again, and keeps the longest time that an answer took."""

    def __init__(self, port: int) -> None:
        self._url, self._over, self.slowest_s, self.answers = f"http://127.0.0.1:{port}/health/live", False, 0.0, 0
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Wait for the first answer, and ask on."""
        deadline = time.monotonic() + START_S
        while self.ask() is None:
            assert time.monotonic() < deadline, "the service does not answer"
            time.sleep(0.2)
        self._thread.start()

    def ask(self) -> float | None:
        """Return how long an answer takes [s]; None: there is none."""
        begin = time.monotonic()
        try:
            with urllib.request.urlopen(self._url, timeout=60.0) as answer:
                answer.read()
        except (OSError, HTTPException):
            return None
        return time.monotonic() - begin

    def take(self) -> float:
        """Return the longest time since the last call."""
        slowest, self.slowest_s = self.slowest_s, 0.0
        return slowest

    def _run(self) -> None:
        while True:
            taken = self.ask()
            self.slowest_s = max(self.slowest_s, float("inf") if taken is None else taken)
            self.answers += 1
            time.sleep(ASK_EVERY_S)


def resident_mb(pid: int) -> float:
    """Return the resident memory of a process [MB]."""
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="utf-8").split()[1])
    return pages * resource.getpagesize() / 2**20


def trial(fuzzed: int) -> dict[str, tuple[float, float]]:
    """Return the slowest answer while each kind of message was taken [s], and by how much memory has grown [MB]."""
    program = mosquitto()
    assert program is not None, "mosquitto is missing: scripts/install-test-servers installs it"
    found = {}
    with tempfile.TemporaryDirectory(prefix="servoscope-live-") as name:
        folder, port = Path(name), free_port()
        broker = Mosquitto(folder, program)
        broker.start()
        command = [sys.executable, "-m", "servoscope", "run", str(write_service(folder, broker.port, port))]
        service, health = subprocess.Popen(command, stderr=subprocess.DEVNULL), Health(port)
        client = create_mqtt_client(BrokerSettings(host="127.0.0.1", port=broker.port), Path(), "")
        try:
            health.start()
            client.connect("127.0.0.1", broker.port)
            client.loop_start()
            time.sleep(2.0)  # it is subscribed by then
            health.take()
            memory = resident_mb(service.pid)
            for kind, messages in (*costly_messages(), ("fuzzed", fuzzed_messages(fuzzed))):
                for number, (topic, content) in enumerate(messages):
                    client.publish(topic, content, qos=1).wait_for_publish(60.0)
                    if number % 10 == 9:
                        time.sleep(0.5)  # the broker hands on faster than the service reads
                time.sleep(3.0)
                before, memory = memory, resident_mb(service.pid)
                found[kind] = round(health.take(), 3), round(memory - before)
            assert service.poll() is None, "the service has ended"
        finally:
            client.disconnect()
            client.loop_stop()
            service.kill()
            service.wait()
            broker.stop()
    return found


def main() -> None:
    """Run the command line of this process."""
    command = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    command.add_argument("--fuzzed", type=int, default=300, help="fuzzed messages")
    found = trial(command.parse_args().fuzzed)
    for kind, (seconds, grown) in found.items():
        print(f"{kind}: slowest answer {seconds:.3f} s, memory {grown:+.0f} MB")
    print(machine())
    if slow := [kind for kind, (seconds, _) in found.items() if seconds >= MAX_ANSWER_S]:
        sys.exit(f"a second or longer: {', '.join(slow)}")
