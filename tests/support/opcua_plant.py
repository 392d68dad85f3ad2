"""An OPC UA server with a plant in it, as a process of its own.

    python tests/support/opcua_plant.py PORT BEGAN RATE history|nothing

Sample k, at BEGAN + k / RATE, holds r = 5, which is written once, u = k // 3, written when it changes, y = k; and every
ten samples there is a block with the same, whose number is k // 10. The temperature is k // 20, written when
it changes; blocks of `warm` carry it behind y.
"""

from __future__ import annotations

import asyncio
import sys
import time
from datetime import UTC, datetime

from asyncua import Server, ua

NODES = {name: f"ns=2;s=press.{name}" for name in ("r", "u", "y", "block", "temperature", "warm")}


def stamped(value: object, t: float) -> ua.DataValue:
    kind = ua.VariantType.Double
    return ua.DataValue(ua.Variant(value, kind), SourceTimestamp=datetime.fromtimestamp(t, UTC))


async def main(port: int, began: float, rate: float, history: bool) -> None:
    server = Server()
    await server.init()
    server.set_endpoint(f"opc.tcp://127.0.0.1:{port}/plant")
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    await server.register_namespace("plant")
    made = {}
    async with server:
        k = round((time.time() - began) * rate)
        for name, first in (
            ("r", 5.0),
            ("u", k // 3),
            ("y", k),
            ("temperature", k // 20),
            ("block", [0.0]),
            ("warm", [0.0]),
        ):
            value = stamped(first if isinstance(first, list) else float(first), began + k / rate)
            made[name] = await server.nodes.objects.add_variable(NODES[name], f"2:{name}", 0.0, ua.VariantType.Double)
            await made[name].write_value(value)
        if history:
            for name in ("u", "y", "block"):
                await server.historize_node_data_change(made[name], count=100_000)
        print("ready", flush=True)
        while True:
            k += 1
            await asyncio.sleep(max(0.0, began + k / rate - time.time()))
            t = began + k / rate
            if k % 20 == 0:
                await made["temperature"].write_value(stamped(float(k // 20), t))
            if k % 3 == 0:
                await made["u"].write_value(stamped(float(k // 3), t))
            await made["y"].write_value(stamped(float(k), t))
            if k % 10 == 9:
                of = [float(i) for i in range(k - 9, k + 1)]
                cells = [k // 10, *(began + i / rate for i in of), *[5.0] * 10, *(i // 3 for i in of), *of]
                await made["block"].write_value(stamped([float(x) for x in cells], t))
                await made["warm"].write_value(stamped([float(x) for x in (*cells, *(i // 20 for i in of))], t))


if __name__ == "__main__":
    asyncio.run(main(int(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3]), sys.argv[4] == "history"))
