"""What a sample costs on its way through the service: over MQTT, blocks of a second; by layer.

    python benchmarks speed/service [--assets 1000] [--rate 100] [--blocks 60 or --seconds 60] [--speed 0]
                                 [--format binary] [--workers 1] [--postgres]
    python benchmarks speed/service --overview [--json]

`--speed 1` sends in true time, evenly, and shows the latency; 0 sends as fast as the service takes it, never more than
`AHEAD` blocks of each asset ahead. Broker, sender and PostgreSQL run on the same cores, and are reported apart.
`--overview` runs several cases.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections import Counter
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np
from reliability.servers import Mosquitto, Postgres, mosquitto, programs
from tables import Table, parser, show
from tools.block_sender import GROUPS, OFFSET_S, Feed, SenderReport, send_blocks

import servoscope as ss
from servoscope.diagnosis.monitor import Monitor
from servoscope.simulation import reference, simulate

RIG = Path(str(files("servoscope"))) / "simulation" / "reference-rig.toml"
START_S = 300.0  # in which a service begins
SILENT_S = 30.0  # without a block that is counted: the rest is lost
AHEAD = 20  # blocks of each asset that are sent and not yet counted, where they are sent as fast as they are taken
WARM_BLOCKS = 10  # of each asset, before anything is counted: filters, first verdicts, memory
STRETCH = 300  # blocks of each asset: a longer run in true time is also shown by such stretches
TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


class Case(NamedTuple):
    """What is measured."""

    assets: int
    rate: float = 100.0  # of samples [Hz]
    blocks: int = 60  # of each asset
    speed: float = 1.0  # over true time; 0: as fast as they are taken
    workers: int = 1
    postgres: bool = False
    binary: bool = False

    @property
    def words(self) -> str:
        """How the table calls it."""
        store, workers = "PostgreSQL" if self.postgres else "SQLite", f", {self.workers} workers" * (self.workers > 1)
        more = ", binary" * self.binary + ", as fast as they are taken" * (not self.speed)
        return f"{self.assets} at {self.rate:g} Hz, {store}{workers}{more}"

    @property
    def feed_seconds(self) -> int:
        """How long the recording has to be: no asset ever begins anew, which would be an alarm."""
        return WARM_BLOCKS + self.blocks + GROUPS * OFFSET_S


OVERVIEW = (
    Case(1000, blocks=20),
    Case(1000, blocks=20, postgres=True),
    Case(100, rate=1000.0, blocks=20),
)


def make_hall(folder: Path, case: Case, port: int, listen: int, store: str) -> tuple[Monitor, ss.Recording]:
    """Write baseline and service file; return a monitor of the baseline and a healthy recording, long enough."""
    # what is sent as fast as possible is taken and decoded when it is processed, not all at the beginning
    in_flight = 65535 if case.speed else min(65535, 2 * case.assets)
    loop = ss.Loop.from_dict(ss.Loop.load(RIG).to_dict() | {"sample_rate": case.rate})
    seconds = 120.0, 120.0, float(case.feed_seconds)
    references = [reference("multisine", duration, loop.sample_rate) for duration in seconds]
    recordings = [simulate(loop, r, seed=seed)[0] for seed, r in enumerate(references)]
    baseline = ss.learn(loop, recordings[:2])
    baseline.save(folder / "baseline.json")
    lines = [
        f'name = "hall"\n[service]\nlisten = "127.0.0.1:{listen}"\nworkers = {case.workers}\nlog = "error"',
        f"buffer = {max(10_000, 4 * case.assets)}",
        f'[store]\nurl = "{store}"',
        '[sources.line]\nkind = "mqtt"',
        f'host = "127.0.0.1"\nport = {port}\nin_flight = {in_flight}',
        *(f'[assets.axis{i:05d}]\nbaseline = "baseline.json"\nsource = "line"' for i in range(case.assets)),
    ]
    (folder / "hall.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return Monitor(baseline), recordings[2]


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
    """Return the processor time of a process and of those that it has started, ended or not, all threads [s]."""
    found = 0.0
    for file in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = file.read_text(encoding="utf-8").rpartition(")")[2].split()
        except OSError:
            continue
        if pid in (int(file.parent.name), int(fields[1])):
            own = int(file.parent.name) == pid
            found += TICK_S * sum(int(field) for field in fields[11 : 15 if own else 13])  # user, system, ended ones
    return found


def largest_memory(pid: int) -> float:
    """Return the most memory that a process and those that it has started have held, added up [GB]."""
    found = 0
    for file in Path("/proc").glob("[0-9]*/status"):
        try:
            fields = dict(line.split(":", 1) for line in file.read_text(encoding="utf-8").splitlines())
        except OSError:
            continue
        if pid in (int(fields["Pid"]), int(fields["PPid"])):
            found += int(fields["VmHWM"].split()[0])
    return found / 2**20


def quantile(before: Counter[str], after: Counter[str], share: float) -> float:
    """Return a quantile of the latencies between two scrapes: the upper end of its bin [s]."""
    edges = sorted(
        (float(key.split('"')[1]), after[key] - before[key])
        for key in after
        if key.startswith("servoscope_latency_seconds_bucket")
    )
    return next(edge for edge, count in edges if count >= share * edges[-1][1])


class Feeder:
    """The sender, a process of its own, and what it has reported."""

    def __init__(self, feed: Feed, recording: ss.Recording) -> None:
        context, signals = multiprocessing.get_context("spawn"), np.stack([recording.r, recording.u, recording.y])
        self._feed, (self._pipe, theirs) = feed, context.Pipe()
        self._process = context.Process(target=send_blocks, args=(feed, signals, theirs), daemon=True)
        self.report, self.latest_s = SenderReport(0, 0, 0, 0, 0.0), 0.0
        self._process.start()

    @property
    def pid(self) -> int:
        """Its process, while it runs."""
        return self._process.pid or 0

    @property
    def is_paced(self) -> bool:
        """Whether it keeps to a speed, and does not wait for what is counted."""
        return bool(self._feed.speed)

    def follow(self, counted: float = 0.0) -> SenderReport:
        """Tell how many blocks are counted; return what it has reported last."""
        self._pipe.send(int(counted))
        while self._pipe.poll():
            self.report = self._pipe.recv()
            self.latest_s = max(self.latest_s, self.report.late_s)
        if not self._process.is_alive():
            raise SystemExit("the sender has ended early")
        if sys.stderr.isatty():
            of = self._feed.assets * self._feed.blocks
            print(f"\r{self.report.sent} of {of} blocks sent, {counted:.0f} counted ", end="", file=sys.stderr)
        return self.report

    def stop(self) -> None:
        """End it."""
        self._process.kill()
        self._process.join()


def wait_for_blocks(port: int, feeder: Feeder, blocks: int, *, stored: bool) -> Counter[str]:
    """Wait until so many blocks are counted, and `stored` or lost; return the metrics then."""
    best, since = -1.0, time.monotonic()
    while True:
        # each look makes the service list the metrics of all assets: none before it can say what we want to know
        while feeder.follow(max(0.0, best)).sent < (blocks if feeder.is_paced else 1):
            time.sleep(0.2)
        found = scrape(port)
        counted = found["servoscope_blocks_total"]
        if counted > best:
            best, since = counted, time.monotonic()
        done = counted >= blocks and not (stored and found["servoscope_buffered_blocks"])
        if done or time.monotonic() > since + SILENT_S:
            return found
        time.sleep(1.0 if feeder.is_paced else 2.0)


def kernel_time(monitor: Monitor, recording: ss.Recording) -> float:
    """Return the processor time of a sample of one log [s]."""
    signals = recording.r[:6000], recording.u[:6000], recording.y[:6000]
    best = float("inf")
    for _ in range(20):
        start = time.thread_time()
        monitor.run(monitor.init(), *signals)
        best = min(best, time.thread_time() - start)
    return best / 6000


class Measurement(NamedTuple):
    """What a case cost."""

    layers: Table
    row: tuple[str, ...]  # of the overview
    stretches: Table  # without rows: the run was short


def stretch_row(minute: float, before: Counter[str], after: Counter[str]) -> tuple[str, ...]:
    """Return what a stretch of a run, which begins at `minute`, shows of its latency."""
    return f"{minute:g}", *(f"{quantile(before, after, share):g} s" for share in (0.5, 0.99, 0.999, 1.0))


def measure(case: Case) -> Measurement:
    """Run broker, service and sender."""
    program, server_programs = mosquitto(), programs() if case.postgres else None
    if program is None or (case.postgres and server_programs is None):
        raise SystemExit("mosquitto or PostgreSQL is not on this machine: scripts/install-test-servers installs them")
    assets, server = case.assets, Postgres.temporary(server_programs) if server_programs is not None else None
    with tempfile.TemporaryDirectory() as name, socket.socket() as free:
        folder = Path(name)
        # a broker that wrote all that waits to its disk every second would be what is measured
        more = "allow_anonymous true", "max_inflight_messages 65535", "max_queued_messages 0", "autosave_interval 1800"
        broker = Mosquitto(folder, program, *more)
        free.bind(("127.0.0.1", 0))
        listen = int(free.getsockname()[1])
        monitor, recording = make_hall(folder, case, broker.port, listen, server.url if server else "history.sqlite")
        free.close()
        broker.start()
        if server is not None:
            server.start()
        feeder, starting = None, time.monotonic()
        service = subprocess.Popen([sys.executable, "-m", "servoscope", "run", str(folder / "hall.toml")])
        try:
            while not is_connected(listen):
                if service.poll() is not None or time.monotonic() > starting + START_S:
                    raise SystemExit("the service does not begin")
                time.sleep(0.5)
            start_s = time.monotonic() - starting
            time.sleep(2.0)  # until the broker knows what each worker wants: earlier blocks are not for it
            # without a pause between those that warm up and those that count: silence would be an alarm of each asset
            blocks = WARM_BLOCKS + case.blocks
            feeder = Feeder(Feed(broker.port, assets, blocks, case.speed, case.rate, case.binary, AHEAD), recording)
            pids = {"service": service.pid, "the broker": broker.pid, "the sender": feeder.pid}
            if server is not None:
                pids["PostgreSQL"] = server.pid
            before, begin = wait_for_blocks(listen, feeder, assets * WARM_BLOCKS, stored=False), time.monotonic()
            earlier = {name: processor_time(pid) for name, pid in pids.items()}
            looks = [before]
            for sent in range(WARM_BLOCKS + STRETCH, blocks, STRETCH) if case.speed else ():
                looks.append(wait_for_blocks(listen, feeder, assets * sent, stored=False))
            after = wait_for_blocks(listen, feeder, assets * blocks, stored=True)
            seconds, report = time.monotonic() - begin, feeder.report
            spent = {name: processor_time(pid) - earlier[name] for name, pid in pids.items()}
            kernel, memory = kernel_time(monitor, recording), largest_memory(service.pid)
        finally:
            if feeder is not None:
                feeder.stop()
            service.send_signal(signal.SIGTERM)
            service.wait(120)
            broker.stop()
            if server is not None:
                server.remove()
    counted = after["servoscope_blocks_total"]
    samples = after["servoscope_samples_total"] - before["servoscope_samples_total"]
    if not samples:
        raise SystemExit("all blocks came before the first look: more --blocks are needed")
    prefix = 'servoscope_processor_seconds_total{layer="'
    layers = {key.split('"')[1]: after[key] - before[key] for key in after if key.startswith(prefix)}
    receive, listing = layers.pop("receive", 0.0), layers.pop("metrics", 0.0)
    used = spent.pop("service") - listing  # a list of all assets every second or two is the benchmark's doing
    rows = list(layers.items())
    rows += [
        ("the client, with its acknowledgements", receive),
        ("the service, without the client", used - receive),
        ("the service, all of it", used),
        ("its metrics, as often as this benchmark asks for them", listing),
        *spent.items(),
    ]
    cells = [(words, f"{1e6 * cost / samples:.3f} us", f"{cost / samples / kernel:.1f}") for words, cost in rows]
    cells.append(("one log's kernel, in the same minute", f"{1e6 * kernel:.3f} us", "1"))
    load = f"{os.getloadavg()[0]:.1f}"
    p50, p99, p999, largest = (f"{quantile(before, after, share):g} s" for share in (0.5, 0.99, 0.999, 1.0))
    note = (
        f"{case.words}: blocks of a second, {samples / case.rate / assets:.0f} of each after those that warm up, in "
        f"{seconds:.0f} s; ready after {start_s:.0f} s, {memory:.1f} GB at most. Sent {report.sent} blocks"
        + f", the last ones of a second up to {feeder.latest_s:.1f} s late"
        * bool(case.speed)
        + f"; not acknowledged by the broker {report.sent - report.acknowledged + report.refused}, not counted "
        f"{report.sent - counted:.0f}, not stored {after['servoscope_buffered_blocks']:.0f}; alarms "
        f"{after['servoscope_alarms']:.0f}. Latency p50, p99, p99.9 and largest: {p50}, {p99}, {p999}, {largest} at "
        f"most. Load of the machine at the end: {load}."
    )
    per_sample = (f"{1e6 * cost / samples:.2f}" for cost in (used - receive, used))
    row = case.words, *per_sample, f"{used / samples / kernel:.0f}", p50, p99, load
    pairs = enumerate(zip(looks, [*looks[1:], after], strict=True))
    stretches = tuple(stretch_row(k * STRETCH / 60.0, *pair) for k, pair in pairs) if len(looks) > 1 else ()
    columns = "from minute", "p50", "p99", "p99.9", "largest"
    return Measurement(
        Table("A sample through the service", note, ("layer", "time", "over the kernel"), tuple(cells)),
        row,
        Table("Latency in the course of the run", case.words, columns, stretches),
    )


def main() -> None:
    """Measure and print."""
    command = parser(__doc__)
    command.add_argument("--assets", type=int, default=1000)
    command.add_argument("--rate", type=float, default=100.0, help="of samples [Hz]")
    command.add_argument("--blocks", "--seconds", type=int, default=60, help="of each asset, a second each")
    command.add_argument("--speed", type=float, default=0.0, help="over true time; 0: as fast as they are taken")
    command.add_argument("--workers", type=int, default=1)
    command.add_argument("--postgres", action="store_true", help="the store is a PostgreSQL server")
    command.add_argument("--format", choices=("json", "binary"), default="json", help="of the messages")
    command.add_argument("--overview", action="store_true", help="several cases")
    given = command.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # servers and service end with us
    cases = OVERVIEW
    if not given.overview:
        how = given.workers, given.postgres, given.format == "binary"
        cases = (Case(given.assets, given.rate, given.blocks, given.speed, *how),)
    measured = [measure(one) for one in cases]
    columns = ("assets", "without the client, us", "service, us", "over the kernel", "p50", "p99", "load")
    note = "Processor time of the service per sample; latency from the last sample of a block to its results stored."
    rows = tuple(one.row for one in measured)
    stretches = [one.stretches for one in measured if one.stretches.rows]
    show([measured[0].layers, *stretches, Table("The service end to end", note, columns, rows)], given.json, {})
