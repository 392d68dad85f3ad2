"""Topics, rasters and tables with clocks of their own: their signals come out as if they had been sampled together."""

from __future__ import annotations

import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from logs import refusal

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import IrregularTimeError
from servoscope.learning.proposal import propose_columns, propose_loop
from servoscope.models.loop import Columns
from servoscope.signals.readers import list_channels, read

# name of the topic, its signal, and when its clock begins [s]
Topics = dict[str, tuple[str, float]]
PX4: Topics = {
    "vehicle_rates_setpoint": ("roll", 0.0002),
    "vehicle_torque_setpoint": ("x", 0.004),
    "vehicle_angular_velocity": ("x", 0.0081),
}


def signal(letter: str, t: FloatArray) -> FloatArray:
    shift = {"r": 0.0, "u": 0.0, "y": 0.03}[letter]
    y = np.sin(4.0 * (t - shift)) + 0.4 * np.sin(9.3 * (t - shift) + 1.0)
    return 0.2 * np.sin(4.0 * t) + 0.3 * np.cos(9.3 * t) if letter == "u" else y


def stamps(begin: float, rate: float, seconds: float = 20.0) -> FloatArray:
    return np.arange(begin, seconds, 1.0 / rate)


def write_ulog(path: Path, topics: Topics, rates: dict[str, float]) -> None:
    """Write a log of PX4 after "ULog File Format"."""

    def message(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<HB", len(body), kind[0]) + body

    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + message(b"B", bytes(40))
    rows: list[tuple[float, bytes]] = []
    for number, ((topic, (field, begin)), letter) in enumerate(zip(topics.items(), "ruy", strict=True)):
        data += message(b"F", f"{topic}:uint64_t timestamp;double {field};".encode())
        t = stamps(begin, rates[letter])
        for at, x in zip(t, signal(letter, t), strict=True):
            rows.append((at, message(b"D", struct.pack("<HQd", number, round(1e6 * at), x))))
    for number, topic in enumerate(topics):
        data += message(b"A", struct.pack("<BH", 0, number) + topic.encode())
    path.write_bytes(data + b"".join(row for _, row in sorted(rows)))


def write_sqlite(path: Path, topics: Topics, rates: dict[str, float]) -> None:
    with closing(sqlite3.connect(path)) as database:
        for (topic, (field, begin)), letter in zip(topics.items(), "ruy", strict=True):
            database.execute(f'CREATE TABLE "{topic}" (time REAL, {field} REAL)')
            t = stamps(begin, rates[letter])
            rows = zip(t.tolist(), signal(letter, t).tolist(), strict=True)
            database.executemany(f'INSERT INTO "{topic}" VALUES (?, ?)', rows)
        database.commit()


WRITERS = {"flight.ulg": write_ulog, "log.db": write_sqlite}
MIXED = ({"r": 50.0, "u": 50.0, "y": 50.0}, {"r": 25.0, "u": 100.0, "y": 50.0}, {"r": 100.0, "u": 50.0, "y": 200.0})


@pytest.mark.parametrize("file", WRITERS)
@pytest.mark.parametrize("rates", MIXED)
def test_signals_of_three_topics_are_put_on_the_clock_of_the_output(
    file: str, rates: dict[str, float], tmp_path: Path
) -> None:
    WRITERS[file](tmp_path / file, PX4, rates)
    columns = propose_columns(tmp_path / file, list_channels(tmp_path / file))
    assert columns.time == "vehicle_angular_velocity.time"
    assert columns.reference == "vehicle_rates_setpoint.roll"
    assert (columns.input, columns.output) == ("vehicle_torque_setpoint.x", "vehicle_angular_velocity.x")
    assert "--resample" in refusal(tmp_path / file, columns=columns)
    recording = read(tmp_path / file, columns=columns.model_copy(update={"resample": True}))
    assert recording.sample_rate == rates["y"] and recording.duration_s > 19.8
    inner = slice(20, -20)
    # u is held: what acts on the plant is half of a step late in its own raster, and in the joint one
    late = 0.5 / rates["u"] - 0.5 / rates["y"]
    for letter, shift in (("r", 0.0), ("u", late), ("y", 0.0)):
        expected = signal(letter, recording.t - shift)[inner]
        np.testing.assert_allclose(getattr(recording, letter)[inner], expected, atol=0.01)


def test_init_proposes_it(tmp_path: Path) -> None:
    write_ulog(tmp_path / "flight.ulg", PX4, MIXED[1])
    columns = propose_columns(tmp_path / "flight.ulg", list_channels(tmp_path / "flight.ulg"))
    proposal = propose_loop([tmp_path / "flight.ulg"], columns)
    assert proposal.loop.columns.resample and proposal.loop.sample_rate == 50.0


def test_a_hole_in_one_topic_is_a_gap_of_all(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "log.db")) as database:
        for table, letter, begin in (("a", "r", 0.0), ("b", "u", 0.003), ("c", "y", 0.007)):
            database.execute(f"CREATE TABLE {table} (time REAL, {letter} REAL)")
            t = stamps(begin, 100.0)
            t = t[(t < 5.0) | (t > 7.0)] if letter == "u" else t
            database.executemany(
                f"INSERT INTO {table} VALUES (?, ?)", zip(t.tolist(), signal(letter, t).tolist(), strict=True)
            )
        database.commit()
    columns = Columns(time="c.time", reference="a.r", input="b.u", output="c.y", resample=True)
    recording = read(tmp_path / "log.db", columns=columns)
    (gap,) = [defect for defect in recording.defects if defect.kind == "gap"]
    assert gap.from_s == pytest.approx(5.0, abs=0.05) and gap.to_s == pytest.approx(7.0, abs=0.05)


def test_topics_are_joined_where_they_overlap(tmp_path: Path) -> None:
    late = {**PX4, "vehicle_torque_setpoint": ("x", 19.0)}
    early = {"r": 50.0, "u": 50.0, "y": 50.0}
    write_ulog(tmp_path / "flight.ulg", late, early)
    columns = propose_columns(tmp_path / "flight.ulg", list_channels(tmp_path / "flight.ulg"))
    columns = columns.model_copy(update={"resample": True})
    assert read(tmp_path / "flight.ulg", columns=columns).duration_s == pytest.approx(1.0, abs=0.1)
    with pytest.raises(IrregularTimeError, match="not sampled together"):
        read(tmp_path / "flight.ulg", columns=columns.model_copy(update={"resample": False}))
