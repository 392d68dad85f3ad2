"""Publisher, broker and service, each killed at random, and the cables between them pulled: what is lost, what doubled.

    python benchmarks/reliability/chaos.py [--hours 10] [--assets 100] [--every 20] [--render]

One more asset, `plain`, has a sender that keeps nothing: what it loses has to be counted, block by block.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from http.client import HTTPException
from pathlib import Path
from typing import Any

BENCHMARKS = Path(__file__).resolve().parent.parent
sys.path[0] = str(BENCHMARKS)  # where `reliability` is a package, and `tables` lies
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from tables import machine  # noqa: E402

from reliability.checks import NUMBERED, numbers_of, opened  # noqa: E402
from reliability.fleet import BLOCK_S, LOOP, Fleet  # noqa: E402
from reliability.run import PAGE, RESULTS, free_port  # noqa: E402
from reliability.servers import Cable, Mosquitto, mosquitto  # noqa: E402
from reliability.trial import COUNTED  # noqa: E402
from servoscope.broker import BrokerSettings, reach  # noqa: E402
from servoscope.live.checkpoint import unpack  # noqa: E402
from servoscope.live.mqtt import payload, topics  # noqa: E402
from servoscope.live.replay import Tape  # noqa: E402
from servoscope.loop import Loop  # noqa: E402
from servoscope.output import atomic_write  # noqa: E402
from servoscope.readers import read  # noqa: E402

LONGEST_S = 900.0  # until results are stored again
AHEAD = 10  # blocks that the publisher keeps per asset
BEGAN = 1767225600.0  # 2026-01-01T00:00:00Z
START = "2026-01-01T00:00:00Z"
PULLED_S = 3.0


class Plain:
    """A sender that keeps nothing: what its broker forgets is gone."""

    def __init__(self, fleet: Fleet, port: int) -> None:
        loop = Loop.load(LOOP)
        recording = read(fleet.folder / "healthy-0.csv", loop)
        self._tape = Tape((recording,), round(BLOCK_S * loop.sample_rate), True)
        self._client = reach(BrokerSettings(host="127.0.0.1", port=port), Path(), "plain")
        self._client.connect_async("127.0.0.1", port, keepalive=5)
        self._client.loop_start()
        self._over, self._every = threading.Event(), BLOCK_S / fleet.speed
        self.sent = 0
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._over.wait(self._every):
            block = self._tape.block("plain", self.sent, BEGAN)
            assert block is not None
            self._client.publish(topics.data("servoscope", "plain"), payload.encode(block), qos=1)
            self.sent += 1

    def close(self) -> None:
        """Stop, and give the last one time to arrive."""
        self._over.set()
        self._thread.join()
        time.sleep(2.0)
        self._client.disconnect()
        self._client.loop_stop()


class Chaos:
    """Three processes and two cables.

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
        self._cables = {"publisher": Cable(self._broker.port), "service": Cable(self._broker.port)}
        self._port, self._log = free_port(), (fleet.folder / "chaos.log").open("ab")
        self.config, self._publish = self._files()
        self.happened: dict[str, list[float]] = {}

    def _files(self) -> tuple[Path, Path]:
        names = [*self._fleet.names, "plain"]
        service = [
            f'name = "fleet"\n[service]\nlisten = "127.0.0.1:{self._port}"\nlog = "warning"',
            '[store]\nurl = "chaos.sqlite"\n[diagnosis]\nevery_s = 3600.0',
            f'[sources.line]\nkind = "mqtt"\nhost = "127.0.0.1"\nport = {self._cables["service"].port}',
            *(f'[assets.{name}]\nbaseline = "baseline.json"\nsource = "line"' for name in names),
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
        service, publisher = self._start("run", self.config), self._start("publish", self._publish)
        self._until_more(0.0, publisher)  # the service has subscribed by then
        plain = Plain(self._fleet, self._cables["publisher"].port)
        due = time.monotonic() + self._wait()
        while publisher.poll() is None:
            time.sleep(0.2)
            assert service.poll() is None, f"the service has ended, see {self._log.name}"
            if time.monotonic() < due:
                continue
            what = self._chance.choice(["service", "broker", "publisher", "cable"])
            before = self._counted()
            if what == "broker":
                self._broker.stop(signal.SIGKILL)
                self._broker.start()
            elif what == "cable":
                cable = self._cables[self._chance.choice(["publisher", "service"])]
                cable.pulled.set()
                time.sleep(PULLED_S)
                cable.pulled.clear()
            else:
                victim = service if what == "service" else publisher
                victim.kill()
                victim.wait()
                if what == "service":
                    service, before = self._start("run", self.config), 0.0
                else:
                    publisher = self._start("publish", self._publish)
            ended = time.monotonic()
            self._until_more(before, publisher)
            self.happened.setdefault(what, []).append(round(time.monotonic() - ended, 2))
            due = time.monotonic() + self._wait()
        assert publisher.returncode == 0, f"the publisher has ended with {publisher.returncode}, see {self._log.name}"
        plain.close()
        time.sleep(2.0)
        service.send_signal(signal.SIGTERM)
        assert service.wait(120) == 0
        self._broker.stop()
        for cable in self._cables.values():
            cable.close()
        self._log.close()
        return plain.sent

    def _wait(self) -> float:
        return self._chance.uniform(0.5, 1.5) * self._every

    def _start(self, *words: object) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "servoscope", *map(str, words)]
        return subprocess.Popen(command, stderr=self._log, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})

    def _counted(self) -> float:
        """Return how many blocks are stored, 0 where nobody answers."""
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self._port}/metrics", timeout=5.0) as answer:
                return sum(float(count) for count in COUNTED.findall(answer.read().decode()))
        except (OSError, HTTPException):
            return 0.0

    def _until_more(self, before: float, publisher: subprocess.Popen[bytes]) -> None:
        deadline = time.monotonic() + LONGEST_S
        while self._counted() <= before and publisher.poll() is None:
            assert time.monotonic() < deadline, f"nothing is stored any more, see {self._log.name}"
            time.sleep(0.05)


def trial(hours: float, assets: int, speed: float, every_s: float, seed: int = 1) -> dict[str, Any]:
    """Run one trial and return what was found, ready for JSON."""
    with tempfile.TemporaryDirectory(prefix="servoscope-chaos-") as folder:
        fleet = Fleet(Path(folder), assets, hours, speed)
        fleet.make()
        chaos = Chaos(fleet, every_s, seed)
        begun = time.monotonic()
        sent = chaos.run()
        found = looked_at(fleet, chaos.config, sent)
    settings = {"hours": hours, "assets": assets, "speed": speed, "block_s": BLOCK_S, "every_s": every_s, "seed": seed}
    seconds = round(time.monotonic() - begun, 1)
    return {"machine": machine(), "settings": settings, "seconds": seconds, "happened": chaos.happened, **found}


def looked_at(fleet: Fleet, config: Path, sent: int) -> dict[str, Any]:
    """Hold the store against what was sent."""
    store = opened(config)
    rows = store.checkpoints([*fleet.names, "plain"])
    status = {name: row["status"]["counted"] for name, row in rows.items()}
    lost = doubled = other = misnumbered = repeated = blocks = 0
    for name, (expected, _, digest) in fleet.expected().items():
        counted = status[name]
        blocks += expected
        lost += max(0, expected - counted["blocks"]) + counted["lost"]
        doubled += max(0, counted["blocks"] - expected)
        other += counted["digest"] != digest
        repeated += counted["repeated"]
        numbers = [row["number"] for table in NUMBERED for row in store.rows(numbers_of(table, name))]
        numbers += [window.number for window in unpack(rows[name]["state"], name).windows]  # still to be diagnosed
        misnumbered += sorted(numbers) != list(range(1, counted["rows"] + 1))
    plain = status["plain"]
    store.close()
    return {
        "blocks": blocks,
        "lost": lost,
        "doubled": doubled,
        "other": other,
        "misnumbered": misnumbered,
        "left out as repeated": repeated,
        "plain": {
            "sent": sent,
            "stored": plain["blocks"],
            "named as lost": plain["lost"],
            "unnamed": sent - plain["blocks"] - plain["lost"] - (sent - 1 - plain["sequence"]),
            "behind the last one stored": sent - 1 - plain["sequence"],
        },
    }


def markdown(one: dict[str, Any]) -> str:
    """Return the table."""
    settings, plain = one["settings"], one["plain"]
    size = f"{settings['hours']:g} h, {settings['assets']} assets, {settings['speed']:g} times true speed"
    happened = [
        (f"{what}: times, longest recovery", f"{len(x)}, {max(x):.1f} s") for what, x in one["happened"].items()
    ]
    wrong, named = f"{one['lost']}, {one['doubled']}, {one['other']}", f"{plain['stored']}, {plain['named as lost']}"
    rows = [
        ("simulated", f"{size}, in {one['seconds']:.0f} s"),
        *happened,
        ("blocks published and kept; lost, doubled, other samples", f"{one['blocks']}; {wrong}"),
        ("assets whose rows are not numbered through", f"{one['misnumbered']}"),
        ("sent once more and left out", f"{one['left out as repeated']}"),
        ("by a sender that keeps nothing: sent; stored, named as lost", f"{plain['sent']}; {named}"),
        ("not named; sent after the last one stored", f"{plain['unnamed']}; {plain['behind the last one stored']}"),
    ]
    words = "" if settings["hours"] * settings["assets"] >= 1000.0 else " **Reduced: not ten hours of 100 assets yet.**"
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
    found = trial(given.hours, given.assets, given.speed, given.every)
    RESULTS.mkdir(exist_ok=True)
    atomic_write(RESULTS / "chaos.json", (json.dumps(found, indent=1) + "\n").encode())
    print(markdown(found))


if __name__ == "__main__":
    main()
