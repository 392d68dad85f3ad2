"""Publisher, broker, OPC UA servers, database and service, killed at random, cables pulled, a clock that jumps.

    python benchmarks/chaos.py [sqlite|postgresql] [--hours 1] [--assets 200] [--speed 1] [--block 1]
    python benchmarks/chaos.py simulated [--seed 1] [--steps 500] [--minutes 4]
    python benchmarks/chaos.py --render

The assets are sent by `servoscope publish`. One more, `plain`, has a sender that keeps nothing and whose clock jumps,
some are sent as JSON by mqtt.js, and some are nodes of OPC UA servers, one of asyncua's and one of node-opcua's, whose
history dies with them: what these lose has to be named, block by block.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPException
from pathlib import Path
from typing import Any

BENCHMARKS = Path(__file__).resolve().parent
sys.path.insert(1, str(BENCHMARKS.parent / "tests" / "support"))  # where `reliability` is a package
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from reliability.aftermath import looked_at  # noqa: E402
from reliability.fleet import BEGAN, LOOP, Fleet  # noqa: E402
from reliability.people import ASSET, SETTINGS, People  # noqa: E402
from reliability.plain import Plain  # noqa: E402
from reliability.plc import SENDER, STACKS, Plc  # noqa: E402
from reliability.servers import Cable, Mosquitto, Postgres, mosquitto, programs  # noqa: E402
from reliability.trial import CALM_S, Latencies, quantile  # noqa: E402
from reliability.workplace import free_port  # noqa: E402
from simulated.command import main as simulated  # noqa: E402
from soak import PAGE, RESULTS, TRIALS  # noqa: E402
from tables import machine  # noqa: E402

from servoscope.core.files import atomic_write  # noqa: E402

LONGEST_S = 900.0  # until results are stored again
AHEAD = 4  # blocks that the publisher keeps per asset
PULLED_S = 3.0
OUT_S = 2.0  # for which the database is gone
JUMPED = 5  # blocks by a clock that is ahead
OTHERS = (*STACKS, SENDER)
CABLES = ("cable of the publisher", "cable of the service", *(f"cable of {other}" for other in OTHERS))
PLC = 4  # assets of each sender of another library
LOOK_S = 1.0  # how often the metrics are looked at
COUNTED = re.compile(r'servoscope_blocks_total\{asset="(\w+)[^"]*"\} (\S+)')
SENDERS = {
    "plain": "sent by who keeps nothing",
    "asyncua": "written by asyncua's OPC UA server",
    "node": "written by node-opcua's",
    SENDER: "sent by mqtt.js",
}
EVENTS = {  # and the words of their rows
    "service": "kill -9 of the service",
    "broker": "kill -9 of the broker",
    "publisher": "kill -9 of the publisher",
    "asyncua": "kill -9 of asyncua's OPC UA server",
    "node": "kill -9 of node-opcua's",
    SENDER: "kill -9 of mqtt.js",
    "database": "crash of the database",
    "clock": f"clock of a sender two hours ahead for {JUMPED} blocks",
    "cable": f"cable pulled for {PULLED_S:g} s",
    "files": "files of hostile names and clocks",
    "commands": "commands of operators",
    "relearning": "baseline put in force",
}


class Chaos:
    """The processes and the cables between them.

    Parameters
    ----------
    fleet
        What is published.
    every_s
        Mean time between two disturbances.
    database
        Where the service stores; None: an SQLite file.
    seed
        Of the chance.
    """

    def __init__(self, fleet: Fleet, every_s: float, database: Postgres | None = None, seed: int = 1) -> None:
        program = mosquitto()
        assert program is not None, "mosquitto is missing: scripts/install-test-servers installs it"
        self._fleet, self._every, self._chance = fleet, every_s, random.Random(seed)
        self._broker, self._database = Mosquitto(fleet.folder, program), database
        listen = {stack: free_port() for stack in STACKS}
        ports = {"publisher": self._broker.port, "service": self._broker.port, SENDER: self._broker.port, **listen}
        self._cables = {name: Cable(port) for name, port in ports.items()}
        listen[SENDER] = self._cables[SENDER].port  # where it finds the broker
        self._plcs = {other: Plc(other, port, fleet, PLC) for other, port in listen.items()}
        self._port, self._log = free_port(), (fleet.folder / "chaos.log").open("ab")
        self.config, self._publish = self._files()
        self.people = People(self.config, fleet.names, self._chance)
        self.happened: dict[str, list[float]] = {}
        self.latencies, self.largest_mb = Latencies(), 0.0

    @property
    def written(self) -> dict[str, dict[str, set[int]]]:
        """Numbers of the blocks that each sender of another library has written, by asset."""
        return {stack: plc.blocks() for stack, plc in self._plcs.items()}

    def _files(self) -> tuple[Path, Path]:
        service = [
            f'name = "fleet"\n[service]\nlisten = "127.0.0.1:{self._port}"\nlog = "warning"',
            f'[store]\nurl = "{self._database.url if self._database else "chaos.sqlite"}"',
            "[diagnosis]\nevery_s = 3600.0",
            f'[sources.line]\nkind = "mqtt"\nhost = "127.0.0.1"\nport = {self._cables["service"].port}',
            *(
                f'[assets.{name}]\nbaseline = "baseline.json"\nsource = "line"'
                for name in [*self._fleet.names, "plain", *self._plcs[SENDER].names]
            ),
        ]
        for stack in STACKS:
            plc = self._plcs[stack]
            at = f"opc.tcp://127.0.0.1:{self._cables[stack].port}/plc"
            service += [f'[sources.{stack}]\nkind = "opcua"\nurl = "{at}"']
            service += [
                f'[assets.{name}]\nbaseline = "baseline.json"\nsource = "{stack}"\n'
                f'nodes = {{ block = "{plc.node(name)}" }}'
                for name in plc.names
            ]
        service.append(SETTINGS)
        publish = [
            f"ahead = {AHEAD}\nagain_s = 2.0\n[replay]\nspeed = {self._fleet.speed}",
            f"block = {self._fleet.block_s}\nstart = {self._fleet.start}",
            f'[broker]\nhost = "127.0.0.1"\nport = {self._cables["publisher"].port}',
            *(
                f'[assets.{name}]\nloop = "{LOOP}"\nfiles = {json.dumps(self._fleet.files(name))}'
                for name in self._fleet.names
            ),
        ]
        paths = self._fleet.folder / "chaos.toml", self._fleet.folder / "publish.toml"
        for path, lines in zip(paths, (service, publish), strict=True):
            path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return paths

    def run(self) -> tuple[set[int], set[int]]:
        """Run until all that was published is safe; return what the plain sender has sent, and what misdated."""
        self._broker.start()
        for plc in self._plcs.values():
            plc.start()
        self._service, self._publisher = self._start("run", self.config), self._start("publish", self._publish)
        try:
            return self._run()
        finally:
            for process in (self._service, self._publisher):
                process.kill()
                process.wait()
            self._broker.stop()
            for plc in self._plcs.values():
                plc.kill()
            for cable in self._cables.values():
                cable.close()
            self._log.close()

    def _run(self) -> tuple[set[int], set[int]]:
        self._until_more(dict.fromkeys(("press", *OTHERS), 0.0))  # the service has subscribed by then
        self._plain = Plain(self._fleet, self._cables["publisher"].port)
        left_out = set() if self._database else {"database"}
        events = [event for event in (*EVENTS, *CABLES) if event not in {"cable", *left_out}]
        due, deck, calm_from = time.monotonic() + self._wait(), list[str](), time.monotonic() + CALM_S
        while self._publisher.poll() is None:
            time.sleep(LOOK_S)
            assert self._service.poll() is None, f"the service has ended, see {self._log.name}"
            self._counted(calm=time.monotonic() > calm_from)
            if time.monotonic() < due:
                continue
            deck = deck or self._chance.sample(events, len(events))
            what, before = deck.pop(), self._counted(calm=time.monotonic() > calm_from)
            print(what, file=sys.stderr, flush=True)
            touched = self._disturb(what)
            ended = time.monotonic()
            if what != "service":
                before = self._counted()  # what was under way has arrived
            self._until_more({name: before.get(name, 0.0) for name in touched})
            lasted = round(time.monotonic() - ended, 2)
            self.happened.setdefault(what.split()[0], []).append(lasted)
            print(f"{what}: {lasted:g} s, {sum(before.values()):.0f} blocks before", file=sys.stderr, flush=True)
            due, calm_from = time.monotonic() + self._wait(), time.monotonic() + CALM_S
        code = self._publisher.returncode
        assert code == 0, f"the publisher has ended with {code}, see {self._log.name}"
        self._plain.close()
        self.people.wait(LONGEST_S)
        self._service.send_signal(signal.SIGTERM)
        assert self._service.wait(120) == 0
        return set(range(self._plain.sent)), self._plain.misdated

    def _disturb(self, what: str) -> tuple[str, ...]:
        """Let something happen, and end; return whose results then have to come again."""
        if what == "broker":
            self._broker.stop(signal.SIGKILL)
            self._broker.start()
        elif what in OTHERS:
            self._plcs[what].kill()
            self._plcs[what].start()
            return (what,)
        elif what in CABLES:
            name = what.split()[-1]
            self._cables[name].pulled.set()
            time.sleep(PULLED_S)
            self._cables[name].pulled.clear()
            return (name,) if name in OTHERS else ("press",)
        elif what == "files":
            self.people.drop_files()
            return (ASSET,)
        elif what == "commands":
            self.people.give_commands()
        elif what == "relearning":
            self.people.relearn()
        elif what == "clock":
            self._plain.jump(JUMPED)
            return ("plain",)
        elif what == "database":
            assert self._database is not None
            self._database.stop("immediate")
            time.sleep(OUT_S)
            self._database.start()
            return ("press", *OTHERS)
        elif what == "service":
            self._service.kill()
            self._service.wait()
            self._service = self._start("run", self.config)
            self.latencies.restart()
            return ("press", *OTHERS)
        else:
            self._publisher.kill()
            self._publisher.wait()
            self._publisher = self._start("publish", self._publish)
        return ("press",)

    def _wait(self) -> float:
        return self._chance.uniform(0.5, 1.5) * self._every

    def _start(self, *words: object) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "servoscope", *map(str, words)]
        return subprocess.Popen(command, stderr=self._log, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})

    def _counted(self, *, calm: bool = False) -> dict[str, float]:
        """Return how many blocks are counted, of the assets of each kind; nothing where nobody answers."""
        found: dict[str, float] = {}
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self._port}/metrics", timeout=5.0) as answer:
                text = answer.read().decode()
            pages = Path(f"/proc/{self._service.pid}/statm").read_text().split()[1]
        except (OSError, HTTPException):
            return found
        for kind, count in COUNTED.findall(text):
            found[kind] = found.get(kind, 0.0) + float(count)
        self.latencies.look(text, calm=calm)
        self.largest_mb = max(self.largest_mb, int(pages) * resource.getpagesize() / 2**20)
        return found

    def _until_more(self, before: dict[str, float]) -> None:
        deadline = time.monotonic() + LONGEST_S
        while self._publisher.poll() is None:
            now = self._counted()
            if all(now.get(name, 0.0) > count for name, count in before.items()):
                return
            assert time.monotonic() < deadline, f"nothing is stored any more, see {self._log.name}"
            time.sleep(0.05)


@contextmanager
def database(store: str) -> Iterator[Postgres | None]:
    """Make the server of a store, if it has one."""
    if store == "sqlite":
        yield None
        return
    found = programs()
    assert found is not None, "PostgreSQL is missing: scripts/install-test-servers installs it"
    server = Postgres.temporary(found)
    server.start()
    try:
        yield server
    finally:
        server.remove()


def trial(store: str, size: tuple[int, float, float], block_s: float, every_s: float, seed: int = 1) -> dict[str, Any]:
    """Run one trial, of so many assets, hours and times the true speed; return what was found, ready for JSON."""
    assets, hours, speed = size
    began = BEGAN if speed > 1.0 else float(round(time.time()))  # no sample may be in the future
    with tempfile.TemporaryDirectory(prefix="servoscope-chaos-") as folder, database(store) as server:
        fleet = Fleet(Path(folder), assets, hours, speed, block_s, began)
        fleet.make()
        chaos = Chaos(fleet, every_s, server, seed)
        begun, load = time.monotonic(), round(os.getloadavg()[0], 1)
        plain = chaos.run()
        seconds = round(time.monotonic() - begun, 1)
        found = looked_at(fleet, chaos.config, plain, chaos.written) | {"people": chaos.people.left()}
    settings = {"store": store, "hours": hours, "assets": assets, "speed": speed, "block_s": block_s}
    happened = {name: times for name, times in sorted(chaos.happened.items())}
    latency = {f"p{share:g}": quantile(chaos.latencies.calm, share / 100.0) for share in (50.0, 99.0)}
    return {
        "machine": machine(),
        "load": load,
        "settings": settings | {"every_s": every_s, "seed": seed},
        "seconds": seconds,
        "happened": happened,
        "latency_s": latency,
        "largest_mb": round(chaos.largest_mb, 1),
        **found,
    }


def column(one: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of one trial."""
    settings, latency = one["settings"], one["latency_s"]
    size = f"{settings['hours']:g} h, {settings['assets']} assets at 100 Hz, blocks of {settings['block_s']:g} s"
    happened = [
        (f"{words}: times, longest recovery", f"{len(times)}, {max(times):.1f} s" if times else "0")
        for what, words in EVENTS.items()
        for times in [one["happened"].get(what, [])]
    ]
    rows = [
        ("simulated", f"{size}, {settings['speed']:g} times true speed, in {one['seconds']:.0f} s"),
        *happened,
        ("latency undisturbed, p50 and p99", f"{latency['p50']:.2g} s, {latency['p99']:.2g} s"),
        ("memory of the service, at most", f"{one['largest_mb']:.0f} MB"),
        ("blocks sent by `servoscope publish`", f"{one['blocks']}"),
        ("of them lost, counted twice; assets with other samples", f"{one['lost']}, {one['doubled']}, {one['other']}"),
        ("assets whose rows are not numbered through", f"{one['misnumbered']}"),
        ("sent once more and left out", f"{one['left out as repeated']}"),
        *((f"people: {name}", f"{count}") for name, count in one.get("people", {}).items()),
    ]
    for name, words in SENDERS.items():
        found = one[name]
        rows += [
            (f"blocks {words}; stored, named as lost", f"{found['sent']}; {found['stored']}, {found['named']}"),
            ("lost and not named; assets with other samples", f"{found['unnamed']}, {found['other']}"),
        ]
        if found["future"]:
            rows += [("dated by a clock that was wrong, and left out", f"{found['future']}")]
    return rows


def markdown(found: list[dict[str, Any]]) -> str:
    """Return one table, a column per trial."""
    stores = {"sqlite": "SQLite", "postgresql": "PostgreSQL"}
    lines = [("", *(stores[one["settings"]["store"]] for one in found)), ("---",) * (1 + len(found))]
    lines += [(rows[0][0], *(value for _, value in rows)) for rows in zip(*(column(one) for one in found), strict=True)]
    reduced = [one for one in found if one["seconds"] < 3600.0]
    words = " **Reduced: not an hour yet.**" if reduced else ""
    words += f" Load of the machine by other work, before: {', '.join(format(one['load'], 'g') for one in found)}."
    machines = "; ".join(sorted({one["machine"] for one in found}))
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + f"\n\n{machines}.{words}"


def render() -> None:
    """Write the table between its markers on the page."""
    page, (before, after) = PAGE.read_text(encoding="utf-8"), ("<!-- chaos -->", "<!-- end of chaos -->")
    paths = [RESULTS / f"chaos-{store}.json" for store in TRIALS]
    found = [json.loads(path.read_text(encoding="utf-8")) for path in paths if path.is_file()]
    head, tail = page.split(before)[0], page.split(after)[1]
    atomic_write(PAGE, f"{head}{before}\n\n{markdown(found)}\n\n{after}{tail}".encode())


def main() -> None:
    """Run the command line of this process."""
    if sys.argv[1:2] == ["simulated"]:
        sys.exit(simulated(sys.argv[2:]) > 0)
    command = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    command.add_argument("store", nargs="?", choices=TRIALS, default="sqlite", help="where the service stores")
    command.add_argument("--hours", type=float, default=1.0, help="simulated hours")
    command.add_argument("--assets", type=int, default=200, help="assets")
    command.add_argument("--speed", type=float, default=1.0, help="times true speed")
    command.add_argument("--block", type=float, default=1.0, help="length of a block, in s")
    command.add_argument("--every", type=float, default=20.0, help="mean time between disturbances, in s")
    command.add_argument("--render", action="store_true", help="write the table into reliability/RESULTS.md only")
    given = command.parse_args()
    if given.render:
        render()
        return
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # whatever has been started is ended then
    found = trial(given.store, (given.assets, given.hours, given.speed), given.block, given.every)
    RESULTS.mkdir(exist_ok=True)
    atomic_write(RESULTS / f"chaos-{given.store}.json", (json.dumps(found, indent=1) + "\n").encode())
    print(markdown([found]))


if __name__ == "__main__":
    main()
