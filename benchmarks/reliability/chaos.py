"""Publisher, broker, OPC UA server and service, killed at random, and cables pulled: what is lost, what doubled.

    python benchmarks/reliability/chaos.py [--hours 10] [--assets 100] [--every 20] [--render]

The assets are sent by `servoscope publish`. One more, `plain`, has a sender that keeps nothing, and some are nodes of
an OPC UA server whose history dies with it: what these lose has to be named, block by block.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from http.client import HTTPException
from pathlib import Path
from typing import Any

BENCHMARKS = Path(__file__).resolve().parent.parent
sys.path[0] = str(BENCHMARKS)  # where `reliability` is a package, and `tables` lies
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from tables import machine  # noqa: E402

from reliability.aftermath import looked_at  # noqa: E402
from reliability.fleet import BLOCK_S, LOOP, Fleet  # noqa: E402
from reliability.plain import Plain  # noqa: E402
from reliability.plc import Plc, names, node  # noqa: E402
from reliability.run import PAGE, RESULTS, free_port  # noqa: E402
from reliability.servers import Cable, Mosquitto, mosquitto  # noqa: E402
from servoscope.core.files import atomic_write  # noqa: E402

LONGEST_S = 900.0  # until results are stored again
AHEAD = 4  # blocks that the publisher keeps per asset
START = "2026-01-01T00:00:00Z"
PULLED_S = 3.0
CABLES = ("cable of the publisher", "cable of the service", "cable of the server")
EVENTS = ("service", "broker", "server", "publisher", *CABLES)  # they come in turn, in an order that chance makes
PLC = 4  # assets of the OPC UA server
COUNTED = re.compile(r'servoscope_blocks_total\{asset="(\w+)[^"]*"\} (\S+)')


class Chaos:
    """Four processes and three cables.

    Parameters
    ----------
    fleet
        What is published.
    every_s
        Mean time between two disturbances.
    seed
        Of the chance.
    """

    def __init__(self, fleet: Fleet, every_s: float, seed: int = 1) -> None:
        program = mosquitto()
        assert program is not None, "mosquitto is missing: scripts/install-test-servers installs it"
        self._fleet, self._every, self._chance = fleet, every_s, random.Random(seed)
        self._broker = Mosquitto(fleet.folder, program)
        self.plc = Plc(free_port(), fleet.folder, PLC, fleet.speed)
        ports = {"publisher": self._broker.port, "service": self._broker.port, "server": self.plc.port}
        self._cables = {name: Cable(port) for name, port in ports.items()}
        self._port, self._log = free_port(), (fleet.folder / "chaos.log").open("ab")
        self.config, self._publish = self._files()
        self.happened: dict[str, list[float]] = {}

    def _files(self) -> tuple[Path, Path]:
        service = [
            f'name = "fleet"\n[service]\nlisten = "127.0.0.1:{self._port}"\nlog = "warning"',
            '[store]\nurl = "chaos.sqlite"\n[diagnosis]\nevery_s = 3600.0',
            f'[sources.line]\nkind = "mqtt"\nhost = "127.0.0.1"\nport = {self._cables["service"].port}',
            f'[sources.plc]\nkind = "opcua"\nurl = "opc.tcp://127.0.0.1:{self._cables["server"].port}/plc"',
            *(
                f'[assets.{name}]\nbaseline = "baseline.json"\nsource = "line"'
                for name in [*self._fleet.names, "plain"]
            ),
            *(
                f'[assets.{name}]\nbaseline = "baseline.json"\nsource = "plc"\nnodes = {{ block = "{node(name)}" }}'
                for name in names(PLC)
            ),
        ]
        publish = [
            f"ahead = {AHEAD}\nagain_s = 2.0\n[replay]\nspeed = {self._fleet.speed}",
            f"block = {BLOCK_S}\nstart = {START}",
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

    def run(self) -> int:
        """Run until all that was published is safe; return how many blocks the plain sender has sent."""
        self._broker.start()
        self.plc.start()
        self._service, self._publisher = self._start("run", self.config), self._start("publish", self._publish)
        try:
            return self._run()
        finally:
            for process in (self._service, self._publisher):
                process.kill()
                process.wait()
            self._broker.stop()
            self.plc.kill()
            for cable in self._cables.values():
                cable.close()
            self._log.close()

    def _run(self) -> int:
        self._until_more({"press": 0.0, "plc": 0.0})  # the service has subscribed by then
        plain = Plain(self._fleet, self._cables["publisher"].port)
        due, deck = time.monotonic() + self._wait(), list[str]()
        while self._publisher.poll() is None:
            time.sleep(0.2)
            assert self._service.poll() is None, f"the service has ended, see {self._log.name}"
            if time.monotonic() < due:
                continue
            deck = deck or self._chance.sample(EVENTS, len(EVENTS))
            what, before = deck.pop(), self._counted()
            touched = self._disturb(what)
            ended = time.monotonic()
            if what != "service":
                before = self._counted()  # what was under way has arrived
            self._until_more({name: before.get(name, 0.0) for name in touched})
            self.happened.setdefault(what.split()[0], []).append(round(time.monotonic() - ended, 2))
            due = time.monotonic() + self._wait()
        code = self._publisher.returncode
        assert code == 0, f"the publisher has ended with {code}, see {self._log.name}"
        plain.close()
        time.sleep(2.0)
        self._service.send_signal(signal.SIGTERM)
        assert self._service.wait(120) == 0
        return plain.sent

    def _disturb(self, what: str) -> tuple[str, ...]:
        """Let something happen, and end; return whose results then have to come again."""
        if what == "broker":
            self._broker.stop(signal.SIGKILL)
            self._broker.start()
        elif what == "server":
            self.plc.kill()
            self.plc.start()
            return ("plc",)
        elif what in CABLES:
            cable = self._cables[what.split()[-1]]
            cable.pulled.set()
            time.sleep(PULLED_S)
            cable.pulled.clear()
            return ("plc",) if what == "cable of the server" else ("press",)
        elif what == "service":
            self._service.kill()
            self._service.wait()
            self._service = self._start("run", self.config)
            return ("press", "plc")
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

    def _counted(self) -> dict[str, float]:
        """Return how many blocks are counted, of the assets of each kind; nothing where nobody answers."""
        found: dict[str, float] = {}
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self._port}/metrics", timeout=5.0) as answer:
                for kind, count in COUNTED.findall(answer.read().decode()):
                    found[kind] = found.get(kind, 0.0) + float(count)
        except (OSError, HTTPException):
            pass
        return found

    def _until_more(self, before: dict[str, float]) -> None:
        deadline = time.monotonic() + LONGEST_S
        while self._publisher.poll() is None:
            now = self._counted()
            if all(now.get(name, 0.0) > count for name, count in before.items()):
                return
            assert time.monotonic() < deadline, f"nothing is stored any more, see {self._log.name}"
            time.sleep(0.05)


def trial(hours: float, assets: int, speed: float, every_s: float, seed: int = 1) -> dict[str, Any]:
    """Run one trial and return what was found, ready for JSON."""
    with tempfile.TemporaryDirectory(prefix="servoscope-chaos-") as folder:
        fleet = Fleet(Path(folder), assets, hours, speed)
        fleet.make()
        chaos = Chaos(fleet, every_s, seed)
        begun, load = time.monotonic(), round(os.getloadavg()[0], 1)
        sent = chaos.run()
        seconds = round(time.monotonic() - begun, 1)
        found = looked_at(fleet, chaos.config, sent, chaos.plc.blocks())
    settings = {"hours": hours, "assets": assets, "speed": speed, "block_s": BLOCK_S, "every_s": every_s, "seed": seed}
    happened = {name: times for name, times in sorted(chaos.happened.items())}
    told = {"machine": machine(), "load": load, "settings": settings, "seconds": seconds, "happened": happened}
    return {**told, **found}


def markdown(one: dict[str, Any]) -> str:
    """Return the table."""
    settings, plain, plc = one["settings"], one["plain"], one["plc"]
    size = f"{settings['hours']:g} h, {settings['assets']} assets at 100 Hz, {settings['speed']:g} times true speed"
    names = {
        "service": "kill -9 of the service",
        "broker": "kill -9 of the broker",
        "publisher": "kill -9 of the publisher",
        "server": "kill -9 of the OPC UA server",
        "cable": f"cable pulled for {PULLED_S:g} s",
    }
    happened = [
        (f"{words}: times, longest recovery", f"{len(times)}, {max(times):.1f} s" if times else "0")
        for what, words in names.items()
        for times in [one["happened"].get(what, [])]
    ]
    wrong = f"{one['lost']}, {one['doubled']}, {one['other']}"
    rows = [
        ("simulated", f"{size}, in {one['seconds']:.0f} s"),
        *happened,
        ("blocks sent by `servoscope publish`", f"{one['blocks']}"),
        ("of them lost, counted twice; assets with other samples", wrong),
        ("assets whose rows are not numbered through", f"{one['misnumbered']}"),
        ("sent once more and left out", f"{one['left out as repeated']}"),
    ]
    for words, found in (
        ("sent by who keeps nothing; stored, named as lost", plain),
        ("written by the OPC UA server; stored, named as lost or never written", plc),
    ):
        rows += [
            (f"blocks {words}", f"{found['sent']}; {found['stored']}, {found['named']}"),
            ("lost and not named; assets with other samples", f"{found['unnamed']}, {found['other']}"),
        ]
    full = settings["hours"] * settings["assets"] >= 1000.0
    words = "" if full else " **Reduced: not ten hours of 100 assets yet.**"
    words += f" Load of the machine by other work, before: {one['load']:g}."
    lines = ["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)]
    return "\n".join(lines) + f"\n\n{one['machine']}.{words}"


def render() -> None:
    """Write the table between its markers on the page."""
    page, (before, after) = PAGE.read_text(encoding="utf-8"), ("<!-- chaos -->", "<!-- end of chaos -->")
    found = json.loads((RESULTS / "chaos.json").read_text(encoding="utf-8"))
    head, tail = page.split(before)[0], page.split(after)[1]
    atomic_write(PAGE, f"{head}{before}\n\n{markdown(found)}\n\n{after}{tail}".encode())


def main() -> None:
    """Run the command line of this process."""
    command = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    command.add_argument("--hours", type=float, default=10.0, help="simulated hours")
    command.add_argument("--assets", type=int, default=100, help="assets")
    command.add_argument("--speed", type=float, default=60.0, help="times true speed")
    command.add_argument("--every", type=float, default=20.0, help="mean time between disturbances, in s")
    command.add_argument("--render", action="store_true", help="write the table into docs/reliability.md, and no more")
    given = command.parse_args()
    if given.render:
        render()
        return
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # whatever has been started is ended then
    found = trial(given.hours, given.assets, given.speed, given.every)
    RESULTS.mkdir(exist_ok=True)
    atomic_write(RESULTS / "chaos.json", (json.dumps(found, indent=1) + "\n").encode())
    print(markdown(found))


if __name__ == "__main__":
    main()
