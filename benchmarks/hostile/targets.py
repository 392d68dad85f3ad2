"""What is fed: every reader and decoder of servoscope, with something whole to begin from."""

from __future__ import annotations

import gzip
import json
import random
import sqlite3
import struct
import zipfile
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from hostile.damage import refitted
from hostile.other_files import other_files
from servoscope.baseline.baseline import Baseline
from servoscope.core.errors import MessageError
from servoscope.diagnosis.monitor import Monitor
from servoscope.learning.learn import nominal_baseline
from servoscope.models.loop import Columns, Loop
from servoscope.service.alarms import AlarmSettings
from servoscope.service.assets.asset import Asset, AssetPolicy
from servoscope.service.assets.checkpoint import pack_state, unpack_state
from servoscope.service.config import DiagnosisSettings, ServiceFile
from servoscope.service.mapping.rows import MessageMapping
from servoscope.service.mapping.settings import PayloadSettings
from servoscope.service.mapping.sparkplug import payload_class
from servoscope.service.mqtt import payload, topics
from servoscope.service.mqtt.replay_client import ReplayClientSettings
from servoscope.service.opcua.subscriptions import parse_block, parse_value
from servoscope.service.sources.block import Block
from servoscope.signals import Recording, readers, writers
from servoscope.signals.quality import QualitySettings
from servoscope.signals.readers.formats import open_file
from servoscope.simulation import reference, simulate

__all__ = ["Target", "targets"]

LOOP = Path(__file__).parents[2] / "src/servoscope/simulation/reference-rig.toml"
BEGAN = 1767225600.0  # 2026-01-01T00:00:00Z
ROWS = 400
SERVICE = """
name = "hall"
[sources.line]
kind = "mqtt"
host = "127.0.0.1"
port = 1883
in_flight = 100
[assets.press]
baseline = "press.json"
source = "line"
[quality]
silent_s = 5.0
"""
PUBLISH = """
ahead = 10
[broker]
host = "127.0.0.1"
[replay]
speed = 2.0
start = 2026-01-01T00:00:00Z
[assets.press]
loop = "loop.toml"
files = ["press.csv"]
"""


@dataclass(frozen=True)
class Target:
    """Something that reads what others have written.

    Parameters
    ----------
    name
        What the table calls it.
    good
        What it reads without complaint; empty: `feed` makes its own.
    feed
        Takes bytes, and the chance for what is made of them; returns in one word what came of it.
    others, show
        Files that name another file, and what returns all that is read of one.
    """

    name: str
    good: Sequence[bytes]
    feed: Callable[[bytes, random.Random], str]
    others: Sequence[bytes] = ()
    show: Callable[[bytes], str] = lambda _: ""


def targets(folder: Path) -> list[Target]:
    """Return all of them; files are written to a folder."""
    loop = Loop.load(LOOP)
    recording = simulate(loop, reference("multisine", ROWS / loop.sample_rate, loop.sample_rate), seed=1)[0]
    return [*_files(folder, recording), *_settings(folder, loop), *_messages(recording), *_values(), _asset(loop)]


def _files(folder: Path, recording: Recording) -> list[Target]:
    columns = {name: np.asarray(getattr(recording, name)) for name in "truy"}
    made = {"CSV": "csv", "Parquet": "parquet", "MAT 5": "mat", "MAT 7.3": "mat", "MDF": "mf4", "TDMS": "tdms"}
    made |= {"HDF5": "h5", "Excel": "xlsx", "LVM": "lvm", "MCAP": "mcap", "ULog": "ulg", "gzip": "csv.gz", "ZIP": "zip"}
    made |= {"JSON": "jsonl", "Feather": "feather", "NumPy": "npz", "SQLite": "db", "trace": "trace", "ROS 1": "bag"}
    made |= {"halscope": "halscope"}
    writing: dict[str, Callable[[Path], object]] = {
        "MAT 5": lambda path: _mat(path, columns),
        "MAT 7.3": lambda path: _hdf5(path, columns),
        "MDF": lambda path: _mdf(path, columns),
        "TDMS": lambda path: _tdms(path, columns),
        "HDF5": lambda path: _hdf5(path, columns),
        "Excel": lambda path: _sheet(path, columns),
        "LVM": lambda path: path.write_text(_lvm(columns)),
        "MCAP": lambda path: _mcap(path, columns),
        "ULog": lambda path: path.write_bytes(_ulog(columns)),
        "ROS 1": lambda path: _bag(path, columns),
        "trace": lambda path: path.write_text(_trace(columns)),
        "halscope": lambda path: path.write_text(_halscope(columns)),
        "gzip": lambda path: path.write_bytes(gzip.compress(_text(columns).encode())),
        "ZIP": lambda path: _zip(path, columns),
        "JSON": lambda path: path.write_text(_records(columns)),
        "Feather": lambda path: _feather(path, columns),
        "NumPy": lambda path: np.savez(path, **columns),
        "SQLite": lambda path: _sqlite(path, columns),
    }
    found = []
    named = dict.fromkeys((".mf4", ".mcap", ".bag", ".ulg", ".lvm"), Columns(time="time"))  # by their readers
    named[".halscope"] = Columns(time="time")
    named[".trace"] = Columns(time="time [ms]", time_unit="ms")
    for kind, suffix in made.items():
        path = folder / f"{kind.replace(' ', '-')}.{suffix}"
        writing.get(kind, lambda path: writers.write_table(path, columns))(path)

        def feed(data: bytes, _: random.Random, path: Path = path) -> str:
            path.write_bytes(data)
            readers.list_channels(path)
            readers.read(path, columns=named.get(path.suffix))
            return "read"

        def show(data: bytes, path: Path = path) -> str:
            path.write_bytes(data)
            opened = open_file(path)
            tables = opened.iter_chunks(opened.columns)
            return str([opened, *({name: cells.to_pylist() for name, cells in one.columns.items()} for one in tables)])

        good = [path.read_bytes()]
        if kind == "CSV":
            text = good[0].decode()
            good += [
                text.replace(",", ";").replace(".", ",").encode(),
                text.replace(",", " ").encode(),
                text.encode("utf-16"),
            ]
        found.append(Target(f"{kind} file", good, feed, other_files(kind, folder), show))
    return found


def _mat(path: Path, columns: dict[str, Any]) -> None:
    import scipy.io

    scipy.io.savemat(path, columns)


def _hdf5(path: Path, columns: dict[str, Any]) -> None:
    import h5py

    with h5py.File(path, "w", userblock_size=512) as file:
        for name, x in columns.items():
            file[name] = x[None, :]
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(128))


def _mdf(path: Path, columns: dict[str, Any]) -> None:
    from asammdf import MDF, Signal

    with MDF(version="4.10") as file:
        file.append([Signal(columns[name], columns["t"], name=name) for name in "ruy"])
        file.save(path, overwrite=True)


def _text(columns: dict[str, Any]) -> str:
    rows = zip(*(columns[name] for name in "truy"), strict=True)
    return "\n".join(["t,r,u,y", *(",".join(f"{cell:.9g}" for cell in row) for row in rows)]) + "\n"


def _records(columns: dict[str, Any]) -> str:
    rows = zip(*(columns[name].tolist() for name in "truy"), strict=True)
    return "".join(json.dumps(dict(zip("truy", row, strict=True))) + "\n" for row in rows)


def _feather(path: Path, columns: dict[str, Any]) -> None:
    import pyarrow as pa
    import pyarrow.feather

    pa.feather.write_feather(pa.table(columns), str(path))


def _sqlite(path: Path, columns: dict[str, Any]) -> None:
    path.unlink(missing_ok=True)
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE axis(t REAL, r REAL, u REAL, y REAL)")
        rows = zip(*(columns[name].tolist() for name in "truy"), strict=True)
        database.executemany("INSERT INTO axis VALUES (?, ?, ?, ?)", rows)


def _zip(path: Path, columns: dict[str, Any]) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("log.csv", _text(columns))


def _sheet(path: Path, columns: dict[str, Any]) -> None:
    import xlsxwriter

    with xlsxwriter.Workbook(str(path)) as book:
        sheet = book.add_worksheet()
        for k, name in enumerate("truy"):
            sheet.write(0, k, name)
            sheet.write_column(1, k, columns[name])


def _bag(path: Path, columns: dict[str, Any]) -> None:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    kind = "rig_msgs/msg/State"
    store.register(get_types_from_msg("float64 r\nfloat64 u\nfloat64 y\n", kind))
    with Writer(path) as writer:
        topic = writer.add_connection("/axis", kind, typestore=store)
        for t, r, u, y in zip(*(columns[name] for name in "truy"), strict=True):
            data = store.serialize_ros1(store.types[kind](r=r, u=u, y=y), kind)
            writer.write(topic, round(1e9 * (BEGAN + t)), data)


def _trace(columns: dict[str, Any]) -> str:
    lines = ["[key]; [value]"]
    for number, name in enumerate("ruy"):
        lines += [f"{number}.Variable; {name}", f"{number}.Data; "]
        lines += [f"; {1e3 * t:g}; {x:g}" for t, x in zip(columns["t"], columns[name], strict=True)]
    return "\n".join(lines)


def _halscope(columns: dict[str, Any]) -> str:
    rows = zip(*(columns[name] for name in "ruy"), strict=True)
    head = "# Sampling period is 10000000 ns\nr;u;y\n"
    return head + "".join(";".join(f"{x:.14f}" for x in row) + "\n" for row in rows)


def _lvm(columns: dict[str, Any]) -> str:
    head = "LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t.\nX_Columns\tOne\n***End_of_Header***\t\n\t\n"
    head += "Channels\t3\nSamples\t400\t400\t400\nX0\t0\t0\t0\nDelta_X\t0.01\t0.01\t0.01\n***End_of_Header***\t\n"
    return head + "X_Value\tr\tu\ty\n" + _text(columns).replace(",", "\t").partition("\n")[2]


def _mcap(path: Path, columns: dict[str, Any]) -> None:
    from mcap_ros2.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        schema = writer.register_msgdef("rig/msg/State", "float64 r\nfloat64 u\nfloat64 y\n")
        for t, *signals in zip(*(columns[name] for name in "truy"), strict=True):
            ns = round(1e9 * t)
            writer.write_message("/axis", schema, dict(zip("ruy", signals, strict=True)), log_time=ns, publish_time=ns)
        writer.finish()


def _ulog(columns: dict[str, Any]) -> bytes:
    def message(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<HB", len(body), kind[0]) + body

    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + message(b"B", bytes(40))
    data += message(b"F", b"servo:uint64_t timestamp;double r;double u;double y;")
    data += message(b"A", struct.pack("<BH", 0, 1) + b"servo")
    for t, *signals in zip(*(columns[name] for name in "truy"), strict=True):
        data += message(b"D", struct.pack("<HQ3d", 1, round(1e6 * t), *signals))
    return data


def _tdms(path: Path, columns: dict[str, Any]) -> None:
    from nptdms import ChannelObject, TdmsWriter

    with TdmsWriter(path) as file:
        for rows in (slice(0, ROWS // 2), slice(ROWS // 2, ROWS)):
            file.write_segment([ChannelObject("rig", name, columns[name][rows]) for name in "truy"])


def _settings(folder: Path, loop: Loop) -> list[Target]:
    nominal_baseline(loop).save(folder / "good.json")
    files: tuple[tuple[str, bytes, str, Callable[[Path], object]], ...] = (
        ("loop file", LOOP.read_bytes(), "loop.toml", Loop.load),
        ("service file", SERVICE.encode(), "service.toml", ServiceFile.load),
        ("file for publish", PUBLISH.encode(), "publish.toml", ReplayClientSettings.load),
        ("baseline", (folder / "good.json").read_bytes(), "baseline.json", Baseline.load),
    )
    found = []
    for name, good, file, load in files:

        def feed(
            data: bytes, _: random.Random, path: Path = folder / file, load: Callable[[Path], object] = load
        ) -> str:
            path.write_bytes(data)
            load(path)
            return "read"

        found.append(Target(name, [good], feed))
    return found


def _messages(recording: Recording) -> list[Target]:
    rows = slice(0, 50)
    t = BEGAN + np.asarray(recording.t[rows])
    blocks = [
        Block("press", 7, t, recording.r[rows], recording.u[rows], recording.y[rows], stream=5),
        Block("press", 8, np.sort(t + 1e-4 * np.sin(t)), recording.r[rows], recording.u[rows], recording.y[rows]),
    ]

    def binary(data: bytes, chance: random.Random) -> str:
        payload.decode_block("press", refitted(data, chance))
        return "read"

    def text(data: bytes, _: random.Random) -> str:
        payload.decode_block("press", data)
        return "read"

    def ack(data: bytes, _: random.Random) -> str:
        topics.decode_ack(data)
        return "read"

    def plant(form: str) -> Callable[[bytes, random.Random], str]:
        settings = PayloadSettings.model_validate({"form": form, "topics": ["a/{message}/{asset}"]})
        mapping = MessageMapping(settings, {"press": 100.0}, lambda *_: None)

        def feed(data: bytes, _: random.Random) -> str:
            mapping.read("a/DBIRTH/press", data, BEGAN)
            return "read"

        return feed

    row = {"fields": {"r": 0.1, "u": 2.3, "y": 0.099}, "name": "axis", "tags": {"asset": "press"}}
    plain = [json.dumps([{**row, "timestamp": BEGAN + k} for k in range(20)]).encode()]
    lines = [b'axis,asset=press r=0.1,u=2.3,y=0.099,on=t,text="a b" 1767225600000000000\n' * 20]
    birth = payload_class()(timestamp=round(1e3 * BEGAN))
    for k, name in enumerate("ruy"):
        birth.metrics.add(name=name, alias=k, datatype=10, double_value=0.5 * k)
    return [
        Target("plant's message, JSON", plain, plant("telegraf")),
        Target("plant's message, line protocol", lines, plant("influx")),
        Target("plant's message, Sparkplug B", [birth.SerializeToString()], plant("sparkplug")),
        Target("MQTT block, binary", [payload.encode_binary(block, 3) for block in blocks], binary),
        Target("MQTT block, JSON", [payload.encode_json(block, 3) for block in blocks], text),
        Target("MQTT acknowledgement", [topics.encode_ack(5, 7)], ack),
    ]


CELLS: tuple[Any, ...] = (
    0.0, -1.0, 1e308, 5e-324, float("nan"), float("inf"), 10**400, -(10**30), 2**63, True, None, "1", b"\xff", [],
    [1.0], BEGAN, 253402300800.0, datetime(2026, 1, 1, tzinfo=UTC),
)  # fmt: skip
STAMPS = (None, datetime(1601, 1, 1), datetime(2026, 1, 1), datetime(9999, 12, 31), datetime(2026, 1, 1, tzinfo=UTC))


def _values() -> list[Target]:
    """OPC UA values as the client hands them on: decoded, but of any type and any content."""

    def told(value: object, chance: random.Random) -> Any:
        bad = chance.random() < 0.1
        status = SimpleNamespace(is_bad=lambda: bad, name="Bad", value=0)
        return SimpleNamespace(
            Value=SimpleNamespace(Value=value) if chance.random() < 0.95 else None,
            SourceTimestamp=chance.choice(STAMPS),
            ServerTimestamp=chance.choice(STAMPS),
            StatusCode=status if chance.random() < 0.9 else None,
        )

    def scalar(_: bytes, chance: random.Random) -> str:
        parse_value(told(chance.choice(CELLS), chance))
        return "read"

    def array(_: bytes, chance: random.Random) -> str:
        n = chance.choice((1, 2, 50))
        cells: list[Any] = [float(chance.randrange(100)), *(BEGAN + 0.01 * k for k in range(n)), *[0.5] * (3 * n)]
        for _ in range(chance.choice((0, 1, 1, 3))):
            cells[chance.randrange(len(cells))] = chance.choice(CELLS)
        cells = cells[: chance.choice((len(cells), len(cells), chance.randrange(len(cells))))]
        parse_block("press", told(cells if chance.random() < 0.95 else chance.choice(CELLS), chance))
        return "read"

    return [Target("OPC UA value", [], scalar), Target("OPC UA array", [], array)]


def _asset(loop: Loop) -> Target:
    """Return an asset, fed with blocks that decoders let through; it must be able to store what it knows after each."""
    baseline = nominal_baseline(loop)
    how = AssetPolicy(
        DiagnosisSettings(window_s=10.0, every_s=60.0), QualitySettings(), AlarmSettings.model_validate({}), 2.0
    )
    asset = Asset("press", baseline, Monitor(baseline), how)
    sound = simulate(loop, reference("multisine", 60.0, loop.sample_rate), seed=2)[0]
    n, state = 50, {"number": 0, "t": BEGAN}

    def feed(_: bytes, chance: random.Random) -> str:
        k = int(state["number"]) % (sound.samples // n)
        t = state["t"] + 0.01 * np.arange(n)
        signals = np.stack([x[n * k : n * (k + 1)] for x in (sound.r, sound.u, sound.y)])
        number, what = int(state["number"]), chance.choice(BLOCKS)
        if what in ("late", "repeated"):
            back = chance.choice((1, 2, 50))
            number, t = max(0, number - back), t - (0.01 * n * back if what == "repeated" else 0.0)
        elif what == "lost":
            number += chance.choice((1, 5, 10**6, 2**62))
        elif what == "clock":
            t = np.clip(t + chance.choice((-1e9, -3600.0, -1.0, 1.0, 3600.0, 1e9, 2e11)), 0.0, payload.MAX_TIME_S - 1.0)
        elif what == "order":
            t = np.array(chance.sample(t.tolist(), n))
        elif what == "moment":
            t = np.full(n, t[0])
        elif what != "sound":
            signals[:, chance.randrange(n) :] = chance.choice(NUMBERS)
        block = Block("press", min(number, payload.MAX_COUNT), t, *signals)
        before = None if asset.state is None else asset.state.position
        asset.process(block)
        assert asset.state is not None
        unpack_state(pack_state(asset.state), "press")
        after = asset.state.position
        if before is not None and after.blocks == before.blocks:
            counted = [
                name for name in ("repeated", "late", "future") if getattr(after, name) == getattr(before, name) + 1
            ]
            if len(counted) != 1:
                raise AssertionError("a block was left out, and not counted as repeated, late or future")
            raise MessageError(counted[0], "it was counted before, or its time stamps do not fit")
        state["number"], state["t"] = number + 1 if number < 2**61 else 0, float(t.max()) + 0.01
        if state["t"] > BEGAN + 1e9:
            state["t"] = BEGAN
        return what

    return Target("blocks of an asset", [], feed)


BLOCKS = ("sound", "sound", "late", "repeated", "lost", "clock", "order", "moment", "numbers")
NUMBERS = (float("nan"), float("inf"), 1e300, -1.7e308, 5e-324, 0.0)
