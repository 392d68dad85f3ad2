"""Logs of robots and vehicles, bags of ROS 1 and 2 and ULog of PX4: each topic is a raster with its own time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.core.errors import RecordingError
from servoscope.signals.readers.matrices import MAX_ARRAY_LENGTH
from servoscope.signals.readers.table import (
    NUMBER_BYTES,
    TableFile,
    check_size,
    check_width,
    one_line_errors,
    unpacked_limit,
)

CONVERT = "convert it to MCAP: ros2 bag convert -i FILE -o OPTIONS.yaml, with storage_id: mcap"

Topics = Mapping[str, Mapping[str, npt.NDArray[Any]]]


def open_bag(path: Path) -> TableFile:
    """Open a bag of ROS 1 (``.bag``) or ROS 2 (``.mcap``, ``.db3``); ``/joint_states.position[0]`` is a field.

    Arrays of a message with as many names have fields by name, too: ``/joint_states.position[elbow]``. The time of a
    message is its header's stamp where it has one, else when it was logged. Bags of ROS 2 before Iron hold no
    definitions of their messages: those of Humble are taken, which know the kinds of ROS itself only.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    damaged = one_line_errors(path, "is a damaged bag, or one with messages that it does not define", CONVERT)
    with damaged, AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
        unknown = {connection.msgtype for connection in bag.connections} - {*bag.typestore.types}
        if unknown:
            raise RecordingError(f"{path}: does not define its messages {', '.join(sorted(unknown))}, {CONVERT}")
        decoded = (
            (connection.topic, logged, bag.deserialize(data, connection.msgtype))
            for connection, logged, data in bag.messages()
        )
        return _open_messages(path, decoded)


def _open_messages(path: Path, messages: Iterable[tuple[str, int, Any]]) -> TableFile:
    """Return the numbers in messages of ROS: topic, time of the log [ns], and the message."""
    rows: dict[str, list[dict[str, float]]] = {}
    count, most = 0, unpacked_limit(path)
    for topic, logged, decoded in messages:
        numbers = dict(_message_fields(decoded))
        stamp = [numbers.pop(f"header.stamp.{part}", 0.0) for part in ("sec", "nanosec")]
        seconds = stamp[0] + 1e-9 * stamp[1] if any(stamp) else 1e-9 * logged
        rows.setdefault(topic, []).append({"time": seconds, **numbers})
        count += len(numbers)
        if NUMBER_BYTES * count > most:
            check_size(path, count, 1)
    topics = {}
    for topic, row in rows.items():
        names = list(dict.fromkeys(name for fields in row for name in fields))
        topics[topic] = {name: np.array([fields.get(name, np.nan) for fields in row]) for name in names}
    return _open_topics(path, topics)


def _message_fields(message: Any, prefix: str = "", depth: int = 0) -> Iterator[tuple[str, float]]:
    """Walk the numbers of a message."""
    labels = getattr(message, "name", None)  # of joints: their order may differ between messages
    for name in (field.name for field in fields(message)):
        value = getattr(message, name)
        if isinstance(value, bool | int | float):
            yield f"{prefix}{name}", float(value)
        elif isinstance(value, list | tuple | np.ndarray) and len(value) <= MAX_ARRAY_LENGTH:
            own = labels if isinstance(labels, list) and len(labels) == len(value) else ()
            for index, item in enumerate(value):
                if isinstance(item, bool | int | float | np.number):
                    if own:
                        yield f"{prefix}{name}[{own[index]}]", float(item)
                    yield f"{prefix}{name}[{index}]", float(item)
                elif depth < 4 and is_dataclass(item):
                    yield from _message_fields(item, f"{prefix}{name}[{index}].", depth + 1)
        elif depth < 4 and is_dataclass(value):
            yield from _message_fields(value, f"{prefix}{name}.", depth + 1)


def open_ulog(path: Path) -> TableFile:
    """Open a ULog file of PX4; ``vehicle_attitude.q[0]`` is a field of a topic, ``topic/1.x`` of a second one."""
    from pyulog import ULog

    with one_line_errors(path, "is a damaged ULog file", "download it again"):
        log = ULog(str(path))
        topics = {}
        for dataset in log.data_list:
            name = dataset.name + (f"/{dataset.multi_id}" if dataset.multi_id else "")
            data = {field: np.asarray(x) for field, x in dataset.data.items() if np.asarray(x).dtype.kind in "fiub"}
            topics[name] = {"time": 1e-6 * data.pop("timestamp"), **data}
    return _open_topics(path, topics)


def _open_topics(path: Path, topics: Topics) -> TableFile:
    """Return topics as rasters; where there is one only, its fields need no prefix."""
    full = {topic: fields for topic, fields in topics.items() if len(fields) > 1 and len(fields["time"])}
    rasters = [
        {f"{topic}.{name}" if len(full) > 1 else name: x for name, x in fields.items()}
        for topic, fields in full.items()
    ]
    columns = {label: x for raster in rasters for label, x in raster.items()}
    check_width(path, len(columns))
    return TableFile.from_columns(path, columns, channel_groups=tuple(map(tuple, rasters)))
