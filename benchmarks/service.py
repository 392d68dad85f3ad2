"""What a sample costs on its way through the service: over MQTT, JSON, blocks of a second; by layer.

    python benchmarks/service.py [--assets 1000] [--rate 100] [--blocks 60] [--speed 0] [--workers 1] [--postgres]
    python benchmarks/service.py --overview [--json]

`--speed 1` sends in true time and shows the latency; 0 sends as fast as broker and service take it. Broker, sender and
PostgreSQL run on the same cores, and are reported apart. `--overview` runs several cases.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import tomllib
import urllib.request
from collections import Counter
from importlib.resources import files
from pathlib import Path
from threading import Thread
from typing import NamedTuple

import numpy as np
from reliability.servers import Mosquitto, Postgres, mosquitto, programs
from tables import Table, parser, show

import servoscope as ss
from servoscope.diagnosis.monitor import Monitor
from servoscope.service.mqtt.client import BrokerSettings, create_mqtt_client
from servoscope.service.mqtt.payload import encode_json
from servoscope.service.mqtt.topics import data_topic
from servoscope.service.sources.block import Block
from servoscope.simulation import reference, simulate

RIG = Path(str(files("servoscope"))) / "simulation" / "reference-rig.toml"
START_S = 300.0  # in which a service begins
WARM_BLOCKS = 10  # of each asset, before anything is counted: filters, first verdicts, memory
TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


class Case(NamedTuple):
    """What is measured."""

    assets: int
    rate: float = 100.0  # of samples [Hz]
    blocks: int = 60  # of each asset
    speed: float = 1.0  # over true time; 0: as fast as they are taken
    workers: int = 1
    postgres: bool = False

    @property
    def words(self) -> str:
        """How the table calls it."""
        store, workers = "PostgreSQL" if self.postgres else "SQLite", f", {self.workers} workers" * (self.workers > 1)
        return f"{self.assets} at {self.rate:g} Hz, {store}{workers}" + ", as fast as they are taken" * (not self.speed)


OVERVIEW = (
    Case(1000, blocks=20),
    Case(1000, blocks=20, postgres=True),
    Case(100, rate=1000.0, blocks=20),
)


def make_hall(folder: Path, case: Case, port: int, listen: int, store: str) -> tuple[Monitor, ss.Recording]:
    """Write baseline and service file; return a monitor of the baseline and a healthy recording."""
    loop = ss.Loop.from_dict(ss.Loop.load(RIG).to_dict() | {"sample_rate": case.rate})
    recordings = [simulate(loop, reference("multisine", 120.0, loop.sample_rate), seed=seed)[0] for seed in range(3)]
    baseline = ss.learn(loop, recordings[:2])
    baseline.save(folder / "baseline.json")
    lines = [
        f'name = "hall"\n[service]\nlisten = "127.0.0.1:{listen}"\nworkers = {case.workers}\nlog = "error"',
        f'[store]\nurl = "{store}"',
        '[sources.line]\nkind = "mqtt"',
        f'host = "127.0.0.1"\nport = {port}\nin_flight = 65535',
        *(f'[assets.axis{i:05d}]\nbaseline = "baseline.json"\nsource = "line"' for i in range(case.assets)),
    ]
    text = "\n".join(lines) + "\n"
    tomllib.loads(text)
    (folder / "hall.toml").write_text(text, encoding="utf-8")
    return Monitor(baseline), recordings[2]


class Sender:
    """Sends the same recording for all assets, block by block."""

    def __init__(self, port: int, assets: int, recording: ss.Recording, blocks: int) -> None:
        self._client = create_mqtt_client(BrokerSettings(host="127.0.0.1", port=port), Path(), "sender")
        self._client.max_inflight_messages_set(2000)
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()
        self._assets, self._blocks, self._began = assets, blocks, 0.0
        self._recording, self._n = recording, round(recording.sample_rate)  # samples of a block of a second

    def send(self, speed: float) -> None:
        """Send all blocks, at so many times the true speed; 0: as they are taken."""
        start = time.monotonic()
        self._began = time.time() - (0.0 if speed else self._blocks)
        for k in range(self._blocks):
            rows = np.arange(k * self._n, (k + 1) * self._n) % self._recording.samples
            t = self._began + k + np.arange(self._n) / self._n
            signals = (getattr(self._recording, name)[rows] for name in "ruy")
            message = encode_json(Block("", k, t, *signals))
            for i in range(self._assets):
                if speed:
                    due = start + (k + (i + 1) / self._assets) / speed
                    time.sleep(max(0.0, due - time.monotonic()) if i % 50 == 0 else 0.0)
                sent = self._client.publish(data_topic("servoscope", f"axis{i:05d}"), message, qos=1)
                if not speed and i % 1000 == 999:
                    sent.wait_for_publish(600.0)
        sent.wait_for_publish(600.0)
        self._client.disconnect()  # the next sender has the same name
        self._client.loop_stop()


def scrape(port: int) -> Counter[str]:
    """Return the service's metrics, those of assets added up."""
    found: Counter[str] = Counter()
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=120.0) as answer:
        for line in answer.read().decode().splitlines():
            if not line.startswith("#"):
                key, _, value = line.rpartition(" ")
                name, _, labels = key.partition("{")
                found[name if "asset=" in labels else key] += float(value)
    return found


def is_connected(port: int) -> bool:
    """Return whether all of the service follows its source."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/health/ready", timeout=30.0):
            return bool(scrape(port)['servoscope_source_up{source="line"}'])
    except OSError:
        return False


def processor_time(pid: int) -> float:
    """Return the processor time of a process and of those that it has started, all threads [s]."""
    found = 0.0
    for file in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = file.read_text(encoding="utf-8").rpartition(")")[2].split()
        except OSError:
            continue
        if pid in (int(file.parent.name), int(fields[1])):
            found += TICK_S * (int(fields[11]) + int(fields[12]))
    return found


def quantile(before: Counter[str], after: Counter[str], share: float) -> float:
    """Return a quantile of the latencies between two scrapes: the upper end of its bin [s]."""
    edges = sorted(
        (float(key.split('"')[1]), after[key] - before[key])
        for key in after
        if key.startswith("servoscope_latency_seconds_bucket")
    )
    return next(edge for edge, count in edges if count >= share * edges[-1][1])


def wait_for_blocks(port: int, blocks: float, seconds: float = 600.0, *, stored: bool = True) -> Counter[str]:
    """Wait until so many blocks are counted, and `stored`."""
    deadline = time.monotonic() + seconds
    while True:
        found = scrape(port)
        if found["servoscope_blocks_total"] >= blocks and (found["servoscope_buffered_blocks"] == 0.0 or not stored):
            return found
        if time.monotonic() > deadline:
            raise TimeoutError(f"{found['servoscope_blocks_total']:.0f} of {blocks:.0f} blocks came")
        time.sleep(2.0)  # each look makes the service list the metrics of all assets


def kernel_time(monitor: Monitor, recording: ss.Recording) -> float:
    """Return the processor time of a sample of one log [s]."""
    signals = recording.r[:6000], recording.u[:6000], recording.y[:6000]
    best = float("inf")
    for _ in range(20):
        start = time.thread_time()
        monitor.run(monitor.init(), *signals)
        best = min(best, time.thread_time() - start)
    return best / 6000


def measure(case: Case) -> tuple[Table, tuple[str, ...]]:
    """Run broker, service and sender; return the table by layer, and the case's row of the overview."""
    program, server_programs = mosquitto(), programs() if case.postgres else None
    if program is None or (case.postgres and server_programs is None):
        raise SystemExit("mosquitto or PostgreSQL is not on this machine: scripts/install-test-servers installs them")
    assets, server = case.assets, Postgres.temporary(server_programs) if server_programs is not None else None
    with tempfile.TemporaryDirectory() as name, socket.socket() as free:
        folder = Path(name)
        more = ("allow_anonymous true", "max_inflight_messages 65535", "max_queued_messages 0", "max_queued_bytes 0")
        broker = Mosquitto(folder, program, *more)
        free.bind(("127.0.0.1", 0))
        listen = int(free.getsockname()[1])
        monitor, recording = make_hall(folder, case, broker.port, listen, server.url if server else "history.sqlite")
        free.close()
        broker.start()
        if server is not None:
            server.start()
        service = subprocess.Popen([sys.executable, "-m", "servoscope", "run", str(folder / "hall.toml")])
        try:
            deadline = time.monotonic() + START_S
            while not is_connected(listen):
                if time.monotonic() > deadline:
                    raise TimeoutError("the service does not begin")
                time.sleep(0.5)
            time.sleep(2.0)  # until the broker knows what each worker wants: earlier blocks are not for it
            # without a pause between those that warm up and those that count: silence would be an alarm of each asset
            given = broker.port, assets, recording, WARM_BLOCKS + case.blocks
            sender = Thread(target=Sender(*given).send, args=(case.speed,))
            sender.start()
            before, used = wait_for_blocks(listen, assets * WARM_BLOCKS, stored=False), processor_time(service.pid)
            broker_used, own, begin = processor_time(broker.pid), time.process_time(), time.monotonic()
            sender.join()
            after = wait_for_blocks(listen, assets * (WARM_BLOCKS + case.blocks))
            seconds, used = time.monotonic() - begin, processor_time(service.pid) - used
            broker_used, own = processor_time(broker.pid) - broker_used, time.process_time() - own
            kernel = kernel_time(monitor, recording)
        finally:
            service.send_signal(signal.SIGTERM)
            service.wait(120)
            broker.stop()
            if server is not None:
                server.remove()
    samples = after["servoscope_samples_total"] - before["servoscope_samples_total"]
    if not samples:
        raise SystemExit("all blocks came before the first look: more --blocks are needed")
    prefix = 'servoscope_processor_seconds_total{layer="'
    layers = {key.split('"')[1]: after[key] - before[key] for key in after if key.startswith(prefix)}
    receive = layers.pop("receive", 0.0)
    rows = [(layer, spent) for layer, spent in layers.items()]
    rows += [
        ("the client, with its acknowledgements", receive),
        ("the service, without the client", used - receive),
        ("the service, all of it", used),
        ("the broker", broker_used),
        ("the sender", own),
    ]
    cells = [(words, f"{1e6 * spent / samples:.3f} us", f"{spent / samples / kernel:.1f}") for words, spent in rows]
    cells.append(("one log's kernel, in the same minute", f"{1e6 * kernel:.3f} us", "1"))
    load, blocks = f"{os.getloadavg()[0]:.1f}", samples / case.rate / assets
    late = tuple(f"{quantile(before, after, share):g} s" for share in (0.5, 0.99))
    note = (
        f"{case.words}: blocks of a second as JSON, {blocks:.0f} of each after those that warm up, in {seconds:.0f} s; "
        f"latency p50 and p99 {late[0]} and {late[1]} at most. Load of the machine at the end: {load}."
    )
    per_sample = (f"{1e6 * spent / samples:.2f}" for spent in (used - receive, used))
    row = case.words, *per_sample, f"{used / samples / kernel:.0f}", *late, load
    return Table("A sample through the service", note, ("layer", "time", "over the kernel"), tuple(cells)), row


if __name__ == "__main__":
    command = parser(__doc__)
    command.add_argument("--assets", type=int, default=1000)
    command.add_argument("--rate", type=float, default=100.0, help="of samples [Hz]")
    command.add_argument("--blocks", type=int, default=60, help="of each asset")
    command.add_argument("--speed", type=float, default=0.0, help="over true time; 0: as fast as they are taken")
    command.add_argument("--workers", type=int, default=1)
    command.add_argument("--postgres", action="store_true", help="the store is a PostgreSQL server")
    command.add_argument("--overview", action="store_true", help="several cases")
    given = command.parse_args()
    cases = OVERVIEW
    if not given.overview:
        cases = (Case(given.assets, given.rate, given.blocks, given.speed, given.workers, given.postgres),)
    measured = [measure(one) for one in cases]
    columns = ("assets", "without the client, us", "service, us", "over the kernel", "p50", "p99", "load")
    note = "Processor time of the service per sample; latency from the last sample of a block to its results stored."
    rows = tuple(row for _, row in measured)
    show([measured[0][0], Table("The service end to end", note, columns, rows)], given.json, {})
