"""Messages of Sparkplug B: births that name metrics, data that may say their aliases only, deaths.

Source: Eclipse Sparkplug Working Group (2022), Sparkplug 3.0.0 Specification: 4 (topics), 6.4 (payloads). The messages
are Protocol Buffers; their field numbers stand in `FIELDS`, and protobuf reads them.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

from servoscope.core.errors import ConfigError, MessageError

UINT32, UINT64, FLOAT, DOUBLE, BOOL, TEXT = "UINT32", "UINT64", "FLOAT", "DOUBLE", "BOOL", "STRING"
FIELDS = {  # by message: name, number and type of the fields that are read (6.4.1); protobuf skips others
    "Metric": (
        ("name", 1, TEXT), ("alias", 2, UINT64), ("timestamp", 3, UINT64), ("datatype", 4, UINT32),
        ("is_null", 7, BOOL), ("int_value", 10, UINT32), ("long_value", 11, UINT64), ("float_value", 12, FLOAT),
        ("double_value", 13, DOUBLE), ("boolean_value", 14, BOOL),
    ),
    "Payload": (("timestamp", 1, UINT64), ("metrics", 2, "Metric"), ("seq", 3, UINT64)),
}  # fmt: skip
SIGNED_BITS = {1: 8, 2: 16, 3: 32, 4: 64}  # by number of the data type: Int8 to Int64 (6.4.16)
NUMBERS = ("int_value", "long_value", "float_value", "double_value")
SEQUENCE = "bdSeq"  # metric that tells which birth a death belongs to (6.4.22)
REBIRTH = "Node Control/Rebirth"  # metric that asks a node for its births (6.4.23)
MAX_NODES, MAX_ALIASES = 1000, 100_000  # that are remembered, whatever comes
BIRTHS, DEATHS, DATA = ("NBIRTH", "DBIRTH"), ("NDEATH", "DDEATH"), ("NDATA", "DDATA")


@functools.cache
def payload_class() -> Any:
    """Return the class of messages; raises ConfigError if protobuf is missing."""
    try:
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    except ModuleNotFoundError:
        raise ConfigError("protobuf is missing, pip install 'servoscope[mqtt]'") from None
    plain: Any = descriptor_pb2
    file = plain.FileDescriptorProto(name="servoscope_sparkplug.proto", package="servoscope", syntax="proto2")
    kinds = plain.FieldDescriptorProto
    for name, fields in FIELDS.items():
        made = file.message_type.add(name=name)
        for field, number, kind in fields:
            one = made.field.add(name=field, number=number, label=kinds.LABEL_OPTIONAL)
            if kind in FIELDS:
                one.label, one.type, one.type_name = kinds.LABEL_REPEATED, kinds.TYPE_MESSAGE, f".servoscope.{kind}"
            else:
                one.type = getattr(kinds, f"TYPE_{kind}")
    pool = descriptor_pool.DescriptorPool()  # of our own: other packages may know the same messages by other names
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("servoscope.Payload"))


class SparkplugDecoder:
    """Turns messages into rows of name, value and timestamp; remembers which metrics aliases are.

    `missing_births`: nodes, as (group, node), that have to send their births again before they can be understood.
    """

    def __init__(self) -> None:
        self._payload = payload_class()
        self._metrics: dict[tuple[str, str], dict[int | str, tuple[str, int]]] = {}  # by alias or name: name, data type
        self._births: dict[tuple[str, str], int] = {}
        self.missing_births = set[tuple[str, str]]()

    def decode(self, names: Mapping[str, str], message: bytes) -> list[dict[str, Any]]:
        """Return the metrics of a message as rows; a death has none. Raises MessageError if it is no message."""
        kind, node = names.get("message", ""), (names.get("group", ""), names.get("node", ""))
        if kind not in (*BIRTHS, *DEATHS, *DATA):
            return []
        payload = self._payload()
        try:
            payload.ParseFromString(message)
        except Exception as error:  # what the library raises depends on its version
            raise MessageError("not a block", f"no Sparkplug B: {' '.join(str(error).split())[:100]}") from None
        if kind == "NBIRTH":
            self._births[node] = _birth_number(payload)
        if kind == "NBIRTH" or (kind == "DBIRTH" and node not in self._metrics):
            if len(self._metrics) >= MAX_NODES and node not in self._metrics:
                raise MessageError("overflow", f"more than {MAX_NODES} nodes")
            self._metrics[node] = {}
            self.missing_births.discard(node)
        if kind in DEATHS:
            return []
        return [row for one in payload.metrics if (row := self._row(one, node, kind, payload.timestamp))]

    def is_dead(self, names: Mapping[str, str], message: bytes) -> bool:
        """Return whether a message says that its device, or all of its node, is gone."""
        kind = names.get("message", "")
        if kind != "NDEATH":
            return kind == "DDEATH"
        payload = self._payload()
        payload.ParseFromString(message)
        born = self._births.get((names.get("group", ""), names.get("node", "")))
        # one of an earlier session, which the broker has sent late (6.4.22)
        return born is None or _birth_number(payload) in (born, -1)

    def _row(self, metric: Any, node: tuple[str, str], kind: str, sent: int) -> dict[str, Any] | None:
        known = self._metrics.get(node, {})
        if kind in BIRTHS:
            if len(known) >= MAX_ALIASES:
                raise MessageError("overflow", f"more than {MAX_ALIASES} metrics of one node")
            about = metric.name, metric.datatype
            known[metric.name] = about
            if metric.HasField("alias"):
                known[metric.alias] = about
        key = metric.name or metric.alias
        whole = metric.HasField("int_value") or metric.HasField("long_value")
        if key not in known and (not metric.name or (whole and not metric.datatype)):
            self.missing_births.add(node)
            what = repr(metric.name[:40]) if metric.name else f"alias {metric.alias}"
            raise MessageError("no birth", f"{what}: its birth has not come, it was asked for")
        name, datatype = known.get(key, (metric.name, metric.datatype))
        value: float | None = None
        field = next((one for one in NUMBERS if metric.HasField(one)), None)
        if field is None and not metric.is_null:
            return None  # a text, a template: nothing that a loop has
        if field is not None and not metric.is_null:
            value = getattr(metric, field)
            bits = SIGNED_BITS.get(metric.datatype or datatype)
            if bits is not None:  # they come as what has the same bits without a sign (6.4.17)
                value = int(value) & (2**bits - 1)
                value -= 2**bits if value >= 2 ** (bits - 1) else 0
        return {"name": name, "value": value, "timestamp": metric.timestamp or sent}


def _birth_number(payload: Any) -> int:
    found = [one for one in payload.metrics if one.name == SEQUENCE]
    return int(found[0].long_value or found[0].int_value) if found else -1


def encode_rebirth(now: float) -> bytes:
    """Return the message that asks a node for its births, at a time [UTC s]."""
    payload = payload_class()(timestamp=round(1000.0 * now))
    payload.metrics.add(name=REBIRTH, timestamp=payload.timestamp, datatype=11, boolean_value=True)
    return bytes(payload.SerializeToString())
