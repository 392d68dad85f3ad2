"""Senders of other libraries whose assets write blocks as a PLC would: processes of their own, to be killed.

    python tests/support/reliability/plc.py SETTINGS

Two are OPC UA servers, asyncua's (this file) and node-opcua's (`tests/support/opcua_server/blocks.js`), one sends over
MQTT by mqtt.js (`tests/support/mqtt_sender/sender.js`), all with the same settings, a JSON file. Which block is written
depends on the clock alone, so that those of the time while it is dead are never written.
What was written is noted in the file `written` of the settings, line by line: asset and number.
"""

from __future__ import annotations

import asyncio
import json
import shutil
import subprocess
import sys
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

SUPPORT = Path(__file__).resolve().parent.parent
if __name__ == "__main__":
    sys.path[0] = str(SUPPORT)

from reliability.fleet import LOOP, Fleet  # noqa: E402
from servoscope.models.loop import Loop  # noqa: E402
from servoscope.service.mqtt import topics  # noqa: E402
from servoscope.service.sources.replay import SEPARATION_SAMPLES, ReplayStream  # noqa: E402
from servoscope.signals.readers import read  # noqa: E402

__all__ = ["SENDER", "STACKS", "Plc", "tape"]

REMEMBERED = 60  # blocks of each asset in the server's history, which dies with it
STACKS = {"asyncua": 2, "node": 1}  # OPC UA servers, and the namespace of their nodes
SENDER = "mqttjs"
SCRIPTS = {"node": SUPPORT / "opcua_server" / "blocks.js", SENDER: SUPPORT / "mqtt_sender" / "sender.js"}


def tape(fleet: Fleet) -> ReplayStream:
    """Return what is measured, over and over."""
    loop = Loop.load(LOOP)
    return ReplayStream((read(fleet.folder / "healthy-0.csv", loop),), round(fleet.block_s * loop.sample_rate), True)


class Plc:
    """The process, from outside.

    Parameters
    ----------
    stack
        One of `STACKS`, or `SENDER`.
    port
        Where the server listens; of the sender, where it finds its broker.
    fleet
        Whose recordings it plays.
    assets
        How many it has.
    """

    def __init__(self, stack: str, port: int, fleet: Fleet, assets: int) -> None:
        self.port, self.written, self.names = port, fleet.folder / f"written-{stack}", names(stack, assets)
        self._settings, self._log = fleet.folder / f"{stack}.json", fleet.folder / f"{stack}.log"
        self._settings.write_text(json.dumps(self._told(stack, fleet)), encoding="utf-8")
        node = shutil.which("node")
        assert node or stack not in SCRIPTS, "Node.js is missing: scripts/install-test-servers installs it"
        program = [str(node), str(SCRIPTS[stack])] if stack in SCRIPTS else [sys.executable, __file__]
        self._command, self._stack = [*program, str(self._settings)], stack

    def _told(self, stack: str, fleet: Fleet) -> dict[str, Any]:
        """Return the settings; every block of one round is in them, its times from the start of the round."""
        recording, played = read(fleet.folder / "healthy-0.csv", Loop.load(LOOP)), tape(fleet)
        starts = range(0, recording.samples, played.block_samples)
        signals = (recording.t - recording.t[0], recording.r, recording.u, recording.y)
        return {
            "port": self.port,
            "nodes": {name: self.node(name, stack) for name in self.names},
            "written": str(self.written),
            "first": fleet.began,  # time of the first sample
            "began": time.time(),  # when it is played
            "every_s": fleet.block_s / fleet.speed,
            "remembered": REMEMBERED,
            "round_s": recording.t[-1] - recording.t[0] + SEPARATION_SAMPLES / recording.sample_rate,
            "blocks": [[x[k : k + played.block_samples].tolist() for x in signals] for k in starts],
        }

    def node(self, name: str, stack: str = "") -> str:
        """Return where an asset's blocks are written: a node, or a topic."""
        stack = stack or self._stack
        return topics.data_topic("servoscope", name) if stack == SENDER else f"ns={STACKS[stack]};s={name}.block"

    def start(self) -> None:
        """Start it, and wait until it is there."""
        with self._log.open("wb") as log:  # a pipe that nobody reads would end it
            self._process = subprocess.Popen(self._command, stdout=log, stderr=log)
        while b"ready\n" not in self._log.read_bytes():
            assert self._process.poll() is None, f"the server has ended, see {self._log}"
            time.sleep(0.05)

    def kill(self) -> None:
        """Kill it."""
        self._process.kill()
        self._process.wait()

    def blocks(self) -> dict[str, set[int]]:
        """Return the numbers of the blocks that were written, by asset."""
        found: dict[str, set[int]] = {}
        for line in self.written.read_text(encoding="utf-8").splitlines():
            name, number = line.split()
            found.setdefault(name, set()).add(int(number))
        return found


def names(stack: str, assets: int) -> list[str]:
    """Return the names of a server's assets."""
    return [f"{stack}-{i}" for i in range(assets)]


def cells(settings: dict[str, Any], number: int) -> list[float]:
    """Return what a block's node holds: its number, then t, r, u and y."""
    rounds, within = divmod(number, len(settings["blocks"]))
    t, *signals = settings["blocks"][within]
    start = settings["first"] + rounds * settings["round_s"]
    return [float(number), *(start + x for x in t), *(x for signal in signals for x in signal)]


async def serve(settings: dict[str, Any]) -> None:
    """Write blocks until killed."""
    from asyncua import Server, ua

    server, every, began = Server(), settings["every_s"], settings["began"]
    await server.init()
    server.set_endpoint(f"opc.tcp://127.0.0.1:{settings['port']}/plc")
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    await server.register_namespace("plc")
    with Path(settings["written"]).open("a", encoding="utf-8") as notes:
        async with server:
            nodes = {}
            for name, node in settings["nodes"].items():
                at = server.nodes.objects
                nodes[name] = await at.add_variable(node, f"2:{name}", [0.0], ua.VariantType.Double)
                await server.historize_node_data_change(nodes[name], timedelta(days=3650), settings["remembered"])
            print("ready", flush=True)
            number = int((time.time() - began) / every)
            while True:
                number += 1
                await asyncio.sleep(max(0.0, began + number * every - time.time()))
                block = cells(settings, number)
                stamp = datetime.fromtimestamp(block[len(block) // 4], UTC)  # of the last sample
                value = ua.DataValue(ua.Variant(block, ua.VariantType.Double), SourceTimestamp=stamp)
                for name, variable in nodes.items():
                    print(name, number, file=notes, flush=True)
                    await variable.write_value(value)


if __name__ == "__main__":
    asyncio.run(serve(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))))
