"""Messages of plants as their makers document them; docs/how-to/plant-messages.md says how they are read."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from servoscope.core.arrays import FloatArray

Message = tuple[str, bytes]  # topic, payload
Rows = FloatArray  # t, r, u, y as rows, shape (4, N)


PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "plant-messages.md"  # says where each form is documented


def iso(t: float) -> str:
    return datetime.fromtimestamp(t, UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")


def encode(plain: Any) -> bytes:
    return json.dumps(plain).encode()


def each(rows: Rows) -> Iterator[tuple[float, dict[str, float]]]:
    for t, r, u, y in rows.T.tolist():
        yield t, {"r": r, "u": u, "y": y}


def chunks(rows: Rows, n: int = 50) -> Iterator[Rows]:
    for k in range(0, rows.shape[1], n):
        yield rows[:, k : k + n]


def thingsboard(asset: str, rows: Rows) -> Iterator[Message]:
    for part in chunks(rows):
        yield (
            "v1/gateway/telemetry",
            encode({f"Device {asset}": [{"ts": 1e3 * t, "values": one} for t, one in each(part)]}),
        )


def telegraf(asset: str, rows: Rows) -> Iterator[Message]:
    for t, one in each(rows):
        fields = {"setpoint": one["r"], "valve": one["u"], "position": one["y"]}
        metric = {"fields": fields, "name": "axis", "tags": {"host": "ipc", "machine": asset}}
        yield "telegraf/ipc/axis", encode({**metric, "timestamp": round(1e6 * t)})


def influx(asset: str, rows: Rows) -> Iterator[Message]:
    for part in chunks(rows, 20):
        lines = (
            f"axis,asset={asset} r={one['r']!r},u={one['u']!r},y={one['y']!r},n=4i {round(1e9 * t)}"
            for t, one in each(part)
        )
        yield "ctrlx/core1", "\n".join(lines).encode()


def neuron(asset: str, rows: Rows) -> Iterator[Message]:
    for t, one in each(rows):
        plain = {"timestamp": 1e3 * t, "node": asset, "group": "axis", "values": one, "errors": {}, "metas": {}}
        yield f"/neuron/{asset}", encode(plain)


def simatic(asset: str, rows: Rows) -> Iterator[Message]:
    for k, part in enumerate(chunks(rows, 10)):
        vals = [
            {"id": str(number), "qc": 3, "ts": iso(t), "val": value}
            for t, one in each(part)
            for number, value in zip((101, 102, 103), one.values(), strict=True)
        ]
        yield f"ie/d/j/simatic/v1/s7c1/dp/r/{asset}/default", encode({"seq": k, "vals": vals})


def cloudconnect(asset: str, rows: Rows) -> Iterator[Message]:
    for t, one in each(rows):
        items = [
            {"Variable": f"{asset}.{name}", "Type": "Real", "Value": repr(value), "QualityCode": "192"}
            for name, value in one.items()
        ]
        yield "cc7/data", encode({"Timestamp": iso(t), "DataItems": items})


def twincat(asset: str, rows: Rows) -> Iterator[Message]:
    for t, one in each(rows):
        plain = {"Timestamp": iso(t).rstrip("Z"), "GroupName": asset, "Values": {"stAxis": one}, "MetaData": {}}
        yield f"machines/{asset}/TcIotCommunicator/Json/Tx/Data", encode(plain)


def sitewise(asset: str, rows: Rows) -> Iterator[Message]:
    for part in chunks(rows, 10):  # at most ten values in one message
        for name, values in zip("ruy", part[1:].tolist(), strict=True):
            stamps = [divmod(round(1e9 * t), 10**9) for t in part[0]]
            found = [
                {"value": {"doubleValue": v}, "timestamp": {"timeInSeconds": s, "offsetInNanos": ns}, "quality": "GOOD"}
                for v, (s, ns) in zip(values, stamps, strict=True)
            ]
            yield (
                f"site1/{asset}/{name}",
                encode({"propertyAlias": f"/site1/{asset}/{name}", "propertyValues": found}),
            )


def kepware(asset: str, rows: Rows) -> Iterator[Message]:
    for part in chunks(rows, 10):
        values = [
            {"id": f"Channel1.{asset}.{name}", "v": value, "q": True, "t": 1e3 * t}
            for t, one in each(part)
            for name, value in one.items()
        ]
        yield "iotgateway", encode({"timestamp": 1e3 * part[0, -1] + 5.0, "values": values})


def pubsub(asset: str, rows: Rows) -> Iterator[Message]:
    for k, part in enumerate(chunks(rows)):  # arrays of samples: of the first one is the time stamp
        payload = dict(zip("ruy", part[1:].tolist(), strict=True))
        found = {"DataSetWriterId": 101, "SequenceNumber": k, "Timestamp": iso(part[0, 0]), "Payload": payload}
        plain = {"MessageId": str(k), "MessageType": "ua-data", "PublisherId": asset, "Messages": [found]}
        yield f"opcua/json/data/{asset}/axis", encode(plain)


def publisher(asset: str, rows: Rows) -> Iterator[Message]:
    for part in chunks(rows, 10):
        yield (
            "devices/opcpublisher/messages",
            encode(
                [
                    {
                        "NodeId": f"nsu=urn:plc;s={asset}.{name}",
                        "Value": {"Value": v, "SourceTimestamp": iso(t)},
                    }
                    for t, one in each(part)
                    for name, v in one.items()
                ]
            ),
        )


def insights(asset: str, rows: Rows) -> Iterator[Message]:
    for part in chunks(rows):
        yield f"insights/{asset}/axis", encode([{"_time": iso(t), **one} for t, one in each(part)])


def single(asset: str, rows: Rows) -> Iterator[Message]:
    for t, one in each(rows):
        for name, value in one.items():
            yield f"plant/hall3/{asset}/{name}", encode({"ts": iso(t), "value": value})


def sparkplug(asset: str, rows: Rows) -> Iterator[Message]:
    from servoscope.service.mapping.sparkplug import payload_class

    def message(t: float, *metrics: dict[str, Any]) -> bytes:
        one = payload_class()(timestamp=round(1e3 * t))
        for metric in metrics:
            one.metrics.add(**metric)
        return bytes(one.SerializeToString())

    offset = {"press": 0, "lift": 10}[asset]  # aliases are unique in a node
    start = rows[0, 0]
    if asset == "press":
        yield "spBv1.0/hall/NBIRTH/plc1", message(start, {"name": "bdSeq", "datatype": 8, "long_value": 0})
    births = [
        {"name": name, "alias": offset + k, "datatype": 10, "double_value": float(rows[k, 0])}
        for k, name in enumerate("ruy", 1)
    ]
    yield f"spBv1.0/hall/DBIRTH/plc1/{asset}", message(start, *births, {"name": "model", "datatype": 12})
    for t, *values in rows[:, 1:].T.tolist():
        found = ({"alias": offset + k, "timestamp": round(1e3 * t), "double_value": v} for k, v in enumerate(values, 1))
        yield f"spBv1.0/hall/DDATA/plc1/{asset}", message(t, *found)


WRITERS: dict[str, Callable[[str, Rows], Iterator[Message]]] = {
    "ThingsBoard": thingsboard,
    "Telegraf": telegraf,
    "Influx lines": influx,
    "Neuron": neuron,
    "SIMATIC S7 Connector": simatic,
    "SIMATIC CloudConnect": cloudconnect,
    "TwinCAT JSON": twincat,
    "SiteWise Edge": sitewise,
    "Kepware": kepware,
    "OPC UA PubSub": pubsub,
    "OPC Publisher": publisher,
    "Insights Hub": insights,
    "One value per topic": single,
    "Sparkplug B": sparkplug,
}


def form(name: str) -> tuple[str, str]:
    """Return the table and the message, if there is one, that the page shows under a heading."""
    section = PAGE.read_text(encoding="utf-8").split(f"\n### {name}\n")[1].split("\n#")[0]
    blocks = dict(re.findall(r"^```(\w+)\n(.*?)^```$", section, re.MULTILINE | re.DOTALL))
    return blocks["toml"].removeprefix("[sources.plant.payload]\n"), blocks.get("json", "")


def signals(asset: str, seconds: float, rate: float, start: float) -> Rows:
    """Return what an asset does: numbers that no two samples share."""
    n = round(seconds * rate)
    noise = np.random.default_rng(len(asset)).normal(size=(3, n))
    return np.vstack([start + np.arange(n) / rate, noise])
