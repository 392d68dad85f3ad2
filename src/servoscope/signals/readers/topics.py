"""Logs of robots and vehicles, bags of ROS 2 and ULog of PX4: each topic is a raster with its own time."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.core.errors import RecordingError
from servoscope.signals.readers.matrices import MAX_ARRAY_LENGTH
from servoscope.signals.readers.table import TableFile, check_width, one_line_errors

MAX_VALUES = 200_000_000  # of all topics together, which are held in memory

Topics = Mapping[str, Mapping[str, npt.NDArray[Any]]]


def open_mcap(path: Path) -> TableFile:
    """Open an MCAP file with messages of ROS 2; ``/joint_states.position[0]`` is a field of a topic.

    Arrays of a message with as many names have fields by name, too: ``/joint_states.position[elbow]``.

    The time of a message is its header's stamp where it has one, else when it was logged.
    """
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with one_line_errors(path, "is a damaged MCAP file", "record it again"), path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        decoded = ((channel.topic, m.log_time, message) for _, channel, m, message in reader.iter_decoded_messages())
        return _open_messages(path, decoded)


def open_bag(path: Path, database: sqlite3.Connection) -> TableFile:
    """Open a bag of ROS 2 in SQLite (``.db3``) that holds the definitions of its messages, as those of Iron on do."""
    if find_spec("mcap_ros2") is None:
        raise RecordingError(f"{path}: bags of ROS 2 need mcap_ros2, pip install 'servoscope[formats]'")
    from mcap.records import Schema
    from mcap_ros2.decoder import DecoderFactory

    convert = "convert it to MCAP: ros2 bag convert -i FILE -o OPTIONS.yaml, with storage_id: mcap"
    if not database.execute("SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'").fetchone():
        raise RecordingError(f"{path}: a bag without the definitions of its messages (ROS 2 before Iron), {convert}")
    with one_line_errors(path, "is a damaged bag", convert):
        texts = dict(database.execute("SELECT topic_type, encoded_message_definition FROM message_definitions"))
        topics = database.execute("SELECT id, name, type FROM topics").fetchall()
        factory: Any = DecoderFactory()
        decoders: dict[int, tuple[str, Any]] = {}
        for number, topic, kind in topics:
            schema = Schema(id=number, name=kind, encoding="ros2msg", data=texts[kind].encode())
            decoders[number] = topic, factory.decoder_for("cdr", schema)
        rows = database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp")
        return _open_messages(path, ((decoders[n][0], at, decoders[n][1](data)) for n, at, data in rows))


def _open_messages(path: Path, messages: Iterable[tuple[str, int, Any]]) -> TableFile:
    """Return the numbers in messages of ROS 2: topic, time of the log [ns], and the message."""
    rows: dict[str, list[dict[str, float]]] = {}
    count = 0
    for topic, logged, decoded in messages:
        fields = dict(_message_fields(decoded))
        stamp = [fields.pop(f"header.stamp.{part}", 0.0) for part in ("sec", "nanosec")]
        seconds = stamp[0] + 1e-9 * stamp[1] if any(stamp) else 1e-9 * logged
        rows.setdefault(topic, []).append({"time": seconds, **fields})
        count += len(fields)
        if count > MAX_VALUES:
            raise RecordingError(f"{path}: holds more than {MAX_VALUES} values, leave topics out")
    topics = {}
    for topic, row in rows.items():
        names = list(dict.fromkeys(name for fields in row for name in fields))
        topics[topic] = {name: np.array([fields.get(name, np.nan) for fields in row]) for name in names}
    return _open_topics(path, topics)


def _message_fields(message: Any, prefix: str = "", depth: int = 0) -> Iterator[tuple[str, float]]:
    """Walk the numbers of a message."""
    labels = getattr(message, "name", None)  # of joints: their order may differ between messages
    for name in getattr(message, "__slots__", ()):
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
                elif depth < 4:
                    yield from _message_fields(item, f"{prefix}{name}[{index}].", depth + 1)
        elif depth < 4 and not isinstance(value, str | bytes):
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
