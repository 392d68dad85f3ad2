"""Messages of Sparkplug B: births that name metrics, data that may say their aliases only, deaths.

Source: Eclipse Sparkplug Working Group (2022), Sparkplug 3.0.0 Specification: 4 (topics), 6.4 (payloads). The messages
are Protocol Buffers; their field numbers stand in `FIELDS`, and protobuf reads them.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

from servoscope.core.errors import ConfigError, MessageError
from servoscope.service.mapping.paths import MAX_ROWS

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
REBIRTH_EVERY_S = 10.0  # how often a node is asked for its births
MAX_NODES, MAX_METRICS = 1000, 100_000  # that are remembered, whatever comes; the metrics are those of all nodes
Sender = tuple[str, ...]  # what a topic names beside the kind of message: group, node, device
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
        for key, number, kind in fields:
            field = made.field.add(name=key, number=number, label=kinds.LABEL_OPTIONAL)
            if kind in FIELDS:
                field.label, field.type, field.type_name = (
                    kinds.LABEL_REPEATED,
                    kinds.TYPE_MESSAGE,
                    f".servoscope.{kind}",
                )
            else:
                field.type = getattr(kinds, f"TYPE_{kind}")
    pool = descriptor_pool.DescriptorPool()  # of our own: other packages may know the same messages by other names
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("servoscope.Payload"))


@dataclass
class _Node:
    """What the births of a node and of its devices have said."""

    birth: int = -1  # number of the node's own birth
    metrics: dict[int | str, tuple[str, int]] = field(default_factory=dict)  # by alias and by name: name, data type
    senders: set[Sender] = field(default_factory=set)  # whose births have come

    @property
    def size(self) -> int:
        """How much is remembered of it."""
        return len(self.metrics) + len(self.senders)


class SparkplugDecoder:
    """Turns messages into rows of name, value and timestamp; remembers which metrics aliases are.

    `missing_births`: nodes, as (group, node), that have to send their births again before they can be understood.

    Parameters
    ----------
    is_mapped
        Whether a metric of this name may be a signal: the others of a birth are not remembered. Where too much is, the
        nodes go first that have been silent for longest: they are asked for their births again.
    """

    def __init__(self, is_mapped: Callable[[str], bool] = lambda _: True) -> None:
        self._payload, self._is_mapped = payload_class(), is_mapped
        self._nodes: dict[tuple[str, str], _Node] = {}  # the last one heard last
        self.missing_births = set[tuple[str, str]]()
        self._asked_at: dict[tuple[str, str], float] = {}  # by node, monotonic [s]

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
        if kind in DEATHS:
            return []
        sender = tuple(names[key] for key in sorted(names) if key != "message")
        about = self._nodes.pop(node, None) if kind != "NBIRTH" else None
        metrics = list(islice(payload.metrics, MAX_ROWS + 1))
        if kind in BIRTHS:
            about = self._take_birth(about or _Node(), metrics, sender)
            self.missing_births.discard(node)
            if kind == "NBIRTH":
                about.birth = _birth_number(payload)
        if about is not None:
            self._nodes[node] = about
            if kind in BIRTHS:
                self._forget()
        is_born = about is not None and sender in about.senders
        rows = []
        for metric in metrics:
            if not is_born and self._needs_birth(about, metric):
                if len(self.missing_births) < MAX_NODES:
                    self.missing_births.add(node)
                what = repr(metric.name[:40]) if metric.name else f"alias {metric.alias}"
                raise MessageError("no birth", f"{what}: its birth has not come, it was asked for")
            if (row := _row(metric, about, payload.timestamp)) is not None:
                rows.append(row)
        return rows

    def rebirth_requests(self) -> list[tuple[str, bytes]]:
        """Return the messages, with their topics, that ask nodes for missing births; each node now and then only."""
        missing, now = self.missing_births, time.monotonic()
        if not missing:
            return []
        self._asked_at = {node: at for node, at in self._asked_at.items() if now - at < REBIRTH_EVERY_S}
        asked = sorted(missing - self._asked_at.keys())[: MAX_NODES - len(self._asked_at)]
        self._asked_at |= dict.fromkeys(asked, now)
        missing.clear()
        return [(f"spBv1.0/{group}/NCMD/{node}", encode_rebirth(time.time())) for group, node in asked]

    def _take_birth(self, about: _Node, metrics: Iterable[Any], sender: Sender) -> _Node:
        about.senders.add(sender)
        for metric in metrics:
            if self._is_mapped(metric.name):
                about.metrics[metric.name] = metric.name, metric.datatype
                if metric.HasField("alias"):
                    about.metrics[metric.alias] = metric.name, metric.datatype
        return about

    def _forget(self) -> None:
        """Forget the nodes that have been silent for longest, where there are too many or their births too large."""
        size = sum(node.size for node in self._nodes.values())
        while len(self._nodes) > 1 and (size > MAX_METRICS or len(self._nodes) > MAX_NODES):
            size -= self._nodes.pop(next(iter(self._nodes))).size

    @staticmethod
    def _needs_birth(about: _Node | None, metric: Any) -> bool:
        """Return whether a metric cannot be understood without a birth that has not come."""
        is_whole = metric.HasField("int_value") or metric.HasField("long_value")
        is_known = about is not None and (metric.name or metric.alias) in about.metrics
        return not is_known and (not metric.name or (is_whole and not metric.datatype))

    def is_dead(self, names: Mapping[str, str], message: bytes) -> bool:
        """Return whether a message says that its device, or all of its node, is gone."""
        kind = names.get("message", "")
        if kind != "NDEATH":
            return kind == "DDEATH"
        payload = self._payload()
        payload.ParseFromString(message)
        about = self._nodes.get((names.get("group", ""), names.get("node", "")))
        # one of an earlier session, which the broker has sent late (6.4.22)
        return about is None or _birth_number(payload) in (about.birth, -1)


def _row(metric: Any, about: _Node | None, sent: int) -> dict[str, Any] | None:
    """Return a metric as a row; None where it is nothing that a loop has, or of a name that is not mapped."""
    known = about.metrics.get(metric.name or metric.alias) if about is not None else None
    name, datatype = known or (metric.name, metric.datatype)
    value: float | None = None
    number = next((kind for kind in NUMBERS if metric.HasField(kind)), None)
    if not name or (number is None and not metric.is_null):
        return None  # a text, a template; an alias that its birth has given to what is not mapped
    if number is not None and not metric.is_null:
        value = getattr(metric, number)
        bits = SIGNED_BITS.get(metric.datatype or datatype)
        if bits is not None:  # they come as what has the same bits without a sign (6.4.17)
            value = int(value) & (2**bits - 1)
            value -= 2**bits if value >= 2 ** (bits - 1) else 0
    return {"name": name, "value": value, "timestamp": metric.timestamp or sent}


def _birth_number(payload: Any) -> int:
    sequences = [metric for metric in payload.metrics if metric.name == SEQUENCE]
    return int(sequences[0].long_value or sequences[0].int_value) if sequences else -1


def encode_rebirth(now: float) -> bytes:
    """Return the message that asks a node for its births, at a time [UTC s]."""
    payload = payload_class()(timestamp=round(1000.0 * now))
    payload.metrics.add(name=REBIRTH, timestamp=payload.timestamp, datatype=11, boolean_value=True)
    return bytes(payload.SerializeToString())
