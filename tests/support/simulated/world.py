"""The service from its first start to its end in a simulated world: one seed, one history."""

from __future__ import annotations

import functools
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import halls
import numpy as np

from servoscope.core.errors import StoreError
from servoscope.diagnosis.monitor import Monitor
from servoscope.machines.servo_loop import LoopMachine
from servoscope.service import build, log
from servoscope.service import service as service_module
from servoscope.service.actions import delivery
from servoscope.service.build import build_components
from servoscope.service.config import ServiceFile
from servoscope.service.mqtt import source as mqtt_source
from servoscope.service.service import Service
from servoscope.service.store import engine as engine_module
from servoscope.service.store.engine import WriterLock
from servoscope.service.store.store import Store
from servoscope.service.writer import StoreWriter
from servoscope.simulation import FaultEvent
from simulated.broker import Broker, Client, Sender, point
from simulated.clock import Clock, Killed, Process, clock_changes, in_place
from simulated.faults import Plan
from simulated.invariants import Invariants
from simulated.outside import ASYNCIO, Diagnoses, People, Receivers
from simulated.storage import Storage

ASSETS = {"press": True, "lift": True, "mill": True, "plain": False}  # and whether their senders keep blocks
IN_FLIGHT, BUFFER = 12, 60
SILENT_S = 3.0
SETTLED_S = 240.0  # within which all is quiet when nothing happens any more
TEXT = f"""
name = "hall"
[service]
listen = ""
commit_every_s = 0.3
buffer = {BUFFER}
log = "error"
[store]
url = "world.sqlite"
residual_every_s = 1.5
[diagnosis]
window_s = 4.0
every_s = 6.0
after_s = 1.0
keep_s = 100000.0
[quality]
window_s = 2.0
silent_s = {SILENT_S}
[alarms.fault]
on_delay_s = 0.5
off_delay_s = 1.0
[alarms.data_quality]
on_delay_s = 0.5
off_delay_s = 1.0
[alarms.reception]
on_delay_s = 1.0
off_delay_s = 1.0
[alarms.flood]
limit = 100000
[actions.retry]
first_s = 0.5
longest_s = 5.0
[actions.webhook.hook]
url = "http://hook.test/"
timeout_s = 2.0
[actions.email.post]
host = "mail.test"
encryption = "none"
sender = "hall@hall.test"
to = ["ann@hall.test"]
per_hour = 100000
timeout_s = 2.0
[sources.line]
kind = "mqtt"
host = "127.0.0.1"
in_flight = {IN_FLIGHT}
""" + "".join(f'[assets.{name}]\nbaseline = "baseline.json"\nsource = "line"\n' for name in ASSETS)


@dataclass
class Found:
    """What came of a seed."""

    seed: int
    steps: int = 0
    lives: int = 0
    broken: list[str] = field(default_factory=list)  # which invariants, in words
    trace: list[str] = field(default_factory=list)  # what happened
    reached: Counter[tuple[str, str]] = field(default_factory=Counter)
    counts: Counter[str] = field(default_factory=Counter)  # rows of each table, deliveries ...
    seconds: float = 0.0  # simulated
    digest: str = ""  # of all that happened


@functools.cache
def signals() -> np.ndarray:
    """Return r, u, y of a healthy loop and of one that leaks, shape (2, 3, N)."""
    kinds = (halls.recorded(1), halls.recorded(2, FaultEvent.parse("C_ie=3@0")))
    return np.stack([np.stack([x.r, x.u, x.y]) for x in kinds])


class Ground:
    """What all histories of a process share: a folder, an engine with its statements, compiled kernels."""

    def __init__(self) -> None:
        parent = "/dev/shm" if Path("/dev/shm").is_dir() else None
        self._keep = tempfile.TemporaryDirectory(prefix="servoscope-world-", dir=parent)
        self.folder = Path(self._keep.name)
        self.template = self.folder / "template.sqlite"
        Store.open(str(self.template), write=True).close()
        self.work = self.folder / "work"
        self.storage = Storage(self.work / "world.sqlite")
        self._files: dict[bytes, Any] = {}
        self._monitors: dict[str, Monitor] = {}  # by the hash of a baseline: its address may be another one's later
        self.clean()
        self.storage.engine.connect().close()  # the first connection of an engine asks its database what it can
        self.config = ServiceFile.load(self.work / "hall.toml")
        for baseline in (halls.baseline(),):
            build.compile_examination(baseline)

    def clean(self) -> None:
        """Leave only what a plant has before its first start."""
        self.storage.end()
        shutil.rmtree(self.work, ignore_errors=True)
        self.work.mkdir()
        shutil.copyfile(self.template, self.work / "world.sqlite")
        (self.work / "hall.toml").write_text(TEXT, encoding="utf-8")
        (self.work / "baseline.json").write_bytes(self._baseline)

    @functools.cached_property
    def _baseline(self) -> bytes:
        return halls.baseline().to_text().encode()

    def monitor(self, machine: LoopMachine) -> Monitor:
        """Return the monitor of a machine, which is made once."""
        if machine.hash not in self._monitors:
            self._monitors[machine.hash] = Monitor(machine.baseline)
        return self._monitors[machine.hash]

    def load_machine(self, path: Path) -> Any:
        """Return the machine of a file, which is parsed once."""
        content = path.read_bytes()
        if content not in self._files:
            self._files[content] = REAL_LOAD(path)
        return self._files[content]


REAL_LOAD, REAL_SEAL = build.load_machine, StoreWriter._seal


@functools.cache
def ground() -> Ground:
    """Return the ground of this process."""
    return Ground()


class World:
    """One history."""

    def __init__(self, seed: int, steps: int) -> None:
        self.found, self.steps, self.ground = Found(seed), steps, ground()
        self.ground.clean()
        self.clock, self.plan = Clock(), Plan(seed, steps)
        self.config = self.ground.config
        self.broker = Broker(self.clock, self.plan, IN_FLIGHT)
        self.service: Service | None = None
        self.over = False
        self._process: Process | None = None
        self._clients: list[Client] = []
        self._locks: list[WriterLock] = []  # which the operating system releases when a process ends
        shift = int(self.plan.chance.randrange(1000))
        rows = np.roll(signals(), shift, axis=-1)
        self.senders = {
            name: Sender(self.broker, name, np.roll(rows, 700 * i, axis=-1), keeps=keeps)
            for i, (name, keeps) in enumerate(ASSETS.items())
        }
        self.receivers = Receivers(self.clock, self.plan, self.broken)
        self.people = People(self.clock, self.plan, self.config, list(ASSETS))
        self.invariants = Invariants(self)
        self.broker.watch = self.invariants.confirmed
        self.ground.storage.begin(self.clock, self.plan, self.invariants.durable)

    def broken(self, why: str) -> None:
        """Note that an invariant is broken."""
        if len(self.found.broken) < 20:
            self.found.broken.append(f"step {self.clock.steps}, {self.clock.now - 1000.0:.2f} s: {why}")

    def run(self) -> Found:
        """Run it, and return what was found."""
        with in_place(*self._changes()):
            try:
                self._run()
            finally:
                self.plan.calm = True
                if self._process is not None:
                    self._process.dead = True
                self.clock.close()
                self.ground.storage.clock = None
        found = self.found
        found.reached, found.trace = self.plan.reached, self.plan.trace
        found.digest = self.plan.digest
        found.seconds = self.clock.now - 1000.0
        return found

    def _run(self) -> None:
        for sender in self.senders.values():
            self.clock.spawn(sender.run, after=self.plan.chance.uniform(0.0, 0.3))
        self._start(0.0)
        todo = list(self.plan.outside)
        while self.clock.steps < self.steps and not self.found.broken:
            while todo and todo[0][0] <= self.clock.steps:
                self._happen(todo.pop(0)[1])
            self.clock.step()
            self.plan.note(self.clock.steps, self.clock.now)
            self.invariants.step()
        self.found.steps = min(self.clock.steps, self.steps)
        if not self.found.broken:
            self._settle()

    def _settle(self) -> None:
        """Let nothing happen any more until all is quiet, stop the service, and look at what is left."""
        self.plan.calm, self.ground.storage.away = True, False
        self.broker.reorder = False
        for sender in self.senders.values():
            sender.over = True
        deadline = self.clock.now + SETTLED_S
        while not self.invariants.settled() and not self.found.broken:
            if self.clock.now > deadline:
                self.broken(f"it does not settle: {self.invariants.unsettled()}")
                return
            for _ in range(10):
                self.clock.step()
            self.plan.note(self.clock.steps, self.clock.now)
        self.over = True
        if self.service is not None:
            self.service.stop()
        while self.service is not None and self.clock.now < deadline + 60.0:
            self.clock.step()
        if not self.found.broken:
            self.invariants.finish()

    # The process of the service, life after life

    def _start(self, after: float) -> None:
        self._process = Process("service")
        self.clock.spawn(self._live, self._process, process=self._process, after=after)

    def _live(self, process: Process) -> None:
        self.found.lives += 1
        try:
            components = build_components(self.config)
            self.invariants.resumed(components)
            self.service = Service(self.config, components, monotonic=self.clock.monotonic)
            self.invariants.begun()
            self.service.run()
        except StoreError as error:
            self.plan.trace.append(f"service ended: {error}")
        except Killed:
            raise
        except Exception as error:
            import traceback

            where = " < ".join(f"{at.name}:{at.lineno}" for at in reversed(traceback.extract_tb(error.__traceback__)))
            self.broken(f"the service has ended: {type(error).__name__}: {error} ({where})")
        finally:
            process.dead = True
            self.service = None
            for client in self._clients:
                client.disconnect()
            for lock in self._locks:
                lock.release()
            self._clients.clear()
            self._locks.clear()
            self.ground.storage.end()
            if not self.over:
                self._start(self.plan.chance.uniform(0.2, 2.0))

    # What happens outside

    def _happen(self, what: str) -> None:
        chance, clock = self.plan.chance, self.clock
        self.plan.reached["outside", what] += 1
        sender = self.senders[chance.choice(list(ASSETS))]
        self.plan.trace.append(f"step {clock.steps}: {what} ({sender.asset})")
        if what in ("broker restart", "broker forgets"):
            self.broker.restart(chance.uniform(0.1, 5.0), what == "broker forgets")
        elif what == "cable of service":
            self.broker.pull("service", chance.uniform(0.1, 8.0))
        elif what == "cable of sender":
            self.broker.pull(sender.asset, chance.uniform(0.1, 8.0))
        elif what == "sender restart":
            sender.again()
        elif what in ("sender ahead", "sender behind"):
            by_s = 7200.0 if what == "sender ahead" else -chance.uniform(1.0, 100.0)
            # numbers of a sender that keeps nothing and names no stream say nothing where its clock goes back: a block
            # that the broker sends again looks like the first one after a restart
            if sender.keeps or what == "sender ahead":
                sender.misdate(chance.randrange(1, 6), by_s)
        elif what in ("clock ahead", "clock back"):
            clock.wall += chance.uniform(0.0, 20.0) * (1.0 if what == "clock ahead" else -1.0)
        elif what == "store away":
            self.ground.storage.away = True
            clock.spawn(setattr, self.ground.storage, "away", False, after=chance.uniform(0.1, 10.0))
        elif what == "silence":
            sender.quiet_until = clock.now + chance.uniform(1.0, 20.0)
        elif what == "gap":
            sender.skip = chance.randrange(1, 2000)
        elif what == "leak":
            sender.leaks = not sender.leaks
        elif what in ("command", "relearn"):
            clock.spawn(self.people.act, what, process=Process("person"))
        elif what == "repeat":
            self.broker.repeat()
        elif what == "reorder":
            self.broker.reorder = not self.broker.reorder

    # What takes the place of what

    def _client(self, _settings: Any, _folder: Path, name: str, receive: Any = None) -> Client:
        client = Client(self.broker, name, receive, self.clock.process)
        client.acknowledged = self.invariants.acknowledged
        client.received = self.invariants.received
        self._clients.append(client)
        return client

    def _sleep(self, seconds: float) -> None:
        point(self.clock, self.plan, "sleep before")
        self.clock.sleep(seconds)
        point(self.clock, self.plan, "sleep after")

    def _lock(self, *arguments: Any) -> WriterLock:
        self._locks.append(WriterLock(*arguments))
        return self._locks[-1]

    def _seal(self, writer: StoreWriter) -> Any:
        pending = REAL_SEAL(writer)
        self.invariants.sealed()
        return pending

    def _changes(self) -> Iterator[tuple[Any, str, Any]]:
        yield from clock_changes(self.clock, self._sleep)
        yield mqtt_source, "create_mqtt_client", self._client
        yield engine_module, "create_store_engine", self.ground.storage.create
        yield engine_module, "WriterLock", self._lock
        yield service_module, "DiagnosisWorker", lambda: Diagnoses(self.clock, self.plan)
        yield delivery, "asyncio", ASYNCIO
        yield delivery, "_request", self.receivers.post
        yield delivery, "send_mail", self.receivers.mail
        yield StoreWriter, "_seal", lambda writer: self._seal(writer)
        # what is the same for all histories is read and compiled once
        yield build, "load_machine", self.ground.load_machine
        yield LoopMachine, "follower", lambda machine: self.ground.monitor(machine)
        yield build, "compile_examination", lambda _: None
        yield ServiceFile, "load_again", lambda config, _: config
        yield log.LOGGER, "disabled", True
