"""An OPC UA server whose assets write blocks as a PLC would: a process of its own, to be killed.

    python benchmarks/reliability/plc.py PORT FOLDER ASSETS SPEED BEGAN

Which block is written depends on the clock alone, so that those of the time while it is dead are never written. What
was written is noted in `FOLDER/written`, line by line: asset and number.
"""

from __future__ import annotations

import asyncio
import subprocess
import sys
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

BENCHMARKS = Path(__file__).resolve().parent.parent
if __name__ == "__main__":
    sys.path[0] = str(BENCHMARKS)

from reliability.fleet import BLOCK_S, LOOP  # noqa: E402
from servoscope.models.loop import Loop  # noqa: E402
from servoscope.service.sources.block import Block  # noqa: E402
from servoscope.service.sources.replay import ReplayStream  # noqa: E402
from servoscope.signals.readers import read  # noqa: E402

__all__ = ["BEGAN", "Plc", "names", "node", "tape"]

BEGAN = 1767225600.0  # 2026-01-01T00:00:00Z
REMEMBERED = 60  # blocks of each asset in the server's history, which dies with it


def names(assets: int) -> list[str]:
    """Return the names of its assets."""
    return [f"plc-{i}" for i in range(assets)]


def node(name: str) -> str:
    """Return where an asset's blocks are written."""
    return f"ns=2;s={name}.block"


def tape(folder: Path) -> ReplayStream:
    """Return what is measured, over and over."""
    loop = Loop.load(LOOP)
    return ReplayStream((read(folder / "healthy-0.csv", loop),), round(BLOCK_S * loop.sample_rate), True)


class Plc:
    """The process, from outside.

    Parameters
    ----------
    port
        Where it listens.
    folder
        Of the recordings.
    assets, speed
        How many, and at how many times the true speed.
    """

    def __init__(self, port: int, folder: Path, assets: int, speed: float) -> None:
        self._words = [str(port), str(folder), str(assets), str(speed), str(time.time())]
        self.port, self.written = port, folder / "written"

    def start(self) -> None:
        """Start it, and wait until it is there."""
        command = [sys.executable, __file__, *self._words]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        assert self._process.stdout is not None and self._process.stdout.readline() == b"ready\n"
        self._process.stdout.close()

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


async def serve(port: int, folder: Path, assets: int, speed: float, began: float) -> None:
    """Write blocks until killed."""
    from asyncua import Server, ua

    def told(block: Block) -> ua.DataValue:
        cells = [float(block.sequence), *(x for signal in block.signals for x in signal.tolist())]
        stamp = datetime.fromtimestamp(float(block.t[-1]), UTC)
        return ua.DataValue(ua.Variant(cells, ua.VariantType.Double), SourceTimestamp=stamp)

    server, played = Server(), tape(folder)
    await server.init()
    server.set_endpoint(f"opc.tcp://127.0.0.1:{port}/plc")
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    await server.register_namespace("plc")
    with (folder / "written").open("a", encoding="utf-8") as notes:
        async with server:
            nodes = {}
            for name in names(assets):
                at = server.nodes.objects
                nodes[name] = await at.add_variable(node(name), f"2:{name}", [0.0], ua.VariantType.Double)
                await server.historize_node_data_change(nodes[name], timedelta(days=3650), REMEMBERED)
            print("ready", flush=True)
            number = int((time.time() - began) * speed / BLOCK_S)
            while True:
                number += 1
                await asyncio.sleep(max(0.0, began + number * BLOCK_S / speed - time.time()))
                block = played.block("plc", number, BEGAN)
                assert block is not None
                for name, variable in nodes.items():
                    print(name, number, file=notes, flush=True)
                    await variable.write_value(told(block))


if __name__ == "__main__":
    asyncio.run(serve(int(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), *map(float, sys.argv[4:])))
