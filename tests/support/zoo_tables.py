"""The second half of the zoo of logs: long tables, records, databases, units, dates, and what other libraries write."""

from __future__ import annotations

import json
import sqlite3
import struct
import zipfile
from collections.abc import Sequence
from contextlib import closing
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from zoo import RATE, ZOO, N, clock, columns, exhibit, motion, table, text

__all__ = ["ZOO"]


def stamps(form: str = "%Y-%m-%dT%H:%M:%S.%fZ", begin: str = "2024-01-31T12:00:00") -> list[str]:
    """Return dates and times from noon on, each 10 ms after the one before."""
    start = datetime.fromisoformat(begin)
    return [(start + timedelta(seconds=round(t, 6))).strftime(form) for t in motion()["t"].tolist()]


def by_signal(names: Sequence[str], *units: float) -> list[tuple[int, str, float]]:
    """Return the rows of a table of one value per row: index of the time, name, value, signal by signal."""
    signals = zip(names, columns(1.0, *units)[1:], strict=True)
    return [(k, name, float(x)) for name, values in signals for k, x in enumerate(values)]


@exhibit("influx.csv", "InfluxData, 'Annotated CSV' of InfluxDB 2: a table per field, each with its annotations")
def _(path: Path) -> None:
    at, lines = stamps(), []
    for number, name in enumerate(("setpoint", "current", "position")):
        lines += [
            "#group,false,false,true,true,false,false,true,true",
            "#datatype,string,long,dateTime:RFC3339,dateTime:RFC3339,dateTime:RFC3339,double,string,string",
            "#default,_result,,,,,,,", ",result,table,_start,_stop,_time,_value,_field,_measurement",
            *(f",,{number},{at[0]},{at[-1]},{at[k]},{x:.9g},{name},axis" for k, n, x in by_signal(
                ("setpoint", "current", "position")) if n == name), "",
        ]  # fmt: skip
    text(path, lines, newline="\r\n")


@exhibit("historian.csv", "AVEVA Historian, 'Export of history data': TagName, DateTime, Value, QualityDetail by rows")
def _(path: Path) -> None:
    at = stamps("%Y-%m-%d %H:%M:%S.%f")
    names = ("Axis.SP", "Axis.Current", "Axis.ActPos")
    rows = sorted(by_signal(names), key=lambda row: row[0])
    text(path, ["TagName,DateTime,Value,Quality", *(f"{name},{at[k]},{x:.9g},192" for k, name, x in rows)])


@exhibit("wincc_log.csv", "Siemens, WinCC Comfort, 'Storing tags in data logs': VarName, TimeString, Time_ms in days")
def _(path: Path) -> None:
    rows = []
    for k, name, x in by_signal(("Soll", "Strom", "Ist")):
        days = f"{45322.5e6 + k / RATE / 0.0864:.6f}".replace(".", ",")
        second = f"31.01.2024 12:00:{k // 100:02d}"
        rows.append(f'"{name}";"{second}";{x:.9g};1;{days}'.replace(f"{x:.9g}", f"{x:.9g}".replace(".", ",")))
    text(path, ['"VarName";"TimeString";"VarValue";"Validity";"Time_ms"', *rows], newline="\r\n")


@exhibit("grafana.csv", "Grafana, 'Inspect a panel: formatted data': cells are numbers with their units")
def _(path: Path) -> None:
    units = ("", " mm", " A", " mm")
    cells = [[f"{x:.9g}{unit}" for x in column] for column, unit in zip(columns(1, 1e3, 1, 1e3), units, strict=True)]
    text(path, ['"Time","Setpoint","Current","Position"', *table([stamps("%Y-%m-%d %H:%M:%S.%f"), *cells[1:]])])


@exhibit("rockwell_semicolon.csv", "Rockwell Automation, FactoryTalk View data log: times of day as 8:00:00;123")
def _(path: Path) -> None:
    times = clock(lambda s, f: f"8:00:{s:02d};{round(1e3 * f):03d}")
    text(path, ["Date,Time,Axis.CommandPosition,Axis.Current,Axis.ActualPosition",
                *table([["1/31/2024"] * N, times, *columns()[1:]])])  # fmt: skip


@exhibit("records.jsonl", "jsonlines.org, written by msgspec: records within records, one per line")
def _(path: Path) -> None:
    import msgspec

    rows = [{"t": t, "axis": {"target": r, "current": u, "position": y}} for t, r, u, y in zip(
        *(x.tolist() for x in columns()), strict=True)]  # fmt: skip
    path.write_bytes(msgspec.json.Encoder().encode_lines(rows))


@exhibit("frame.json", "pandas, DataFrame.to_json(orient='split' and others); here 'list' as a dictionary of lists")
def _(path: Path) -> None:
    names = ("time", "setpoint", "i_q", "position")
    path.write_text(json.dumps({"log": {n: x.tolist() for n, x in zip(names, columns(), strict=True)}}))


@exhibit("frame_lines.json", "pandas, DataFrame.to_json(orient='records', lines=True), written by pandas")
def _(path: Path) -> None:
    frame(("time", "q_des", "tau", "q")).to_json(path, orient="records", lines=True, double_precision=12)


def frame(names: Sequence[str]) -> Any:
    """Return the motion as a frame of pandas."""
    import pandas as pd

    return pd.DataFrame(dict(zip(names, columns(), strict=True)))


@exhibit("arrays.npz", "NumPy, savez: one array per signal, and one of another length")
def _(path: Path) -> None:
    t, r, u, y = columns()
    np.savez(path, t=t, ref=r, cur=u, pos=y, gains=np.ones(4))


@exhibit("records.npy", "NumPy, save of a structured array")
def _(path: Path) -> None:
    np.save(path, np.rec.fromarrays(columns(), names="time,desired,current,measured"))


@exhibit("frame.feather", "Apache Arrow, 'Feather file format', version 2")
def _(path: Path) -> None:
    import pyarrow as pa
    import pyarrow.feather

    names = ("time", "sp", "cur", "pv")
    pa.feather.write_feather(pa.table(dict(zip(names, columns(), strict=True))), str(path))


@exhibit("thousands.csv", "Microsoft Excel, German: sep=;, signs between thousands")
def _(path: Path) -> None:
    def german(x: float) -> str:
        return f"{x:,.9f}".translate(str.maketrans(",.", ".,"))

    cells = [[german(float(x)) for x in column] for column in columns(1e3, 1e6, 1.0, 1e6)]
    text(path, ["sep=;", "Zeit [ms];Soll [µm];Strom [A];Ist [µm]", *table(cells, ";")], "cp1252", "\r\n")


@exhibit("thousands_en.csv", "Microsoft Excel, English: signs between thousands, in quotes")
def _(path: Path) -> None:
    cells = [[f'"{x:,.9f}"' for x in column] for column in columns(1e3, 1e6, 1.0, 1e6)]
    text(path, ["time [ms],target [um],current [A],actual [um]", *table(cells)])


@exhibit("with_readme.zip", "PKWARE APPNOTE: a log with a readme and a picture beside it")
def _(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("README.txt", "taken after service; columns: t r u y")
        archive.writestr("photo.png", b"\x89PNG")
        archive.writestr("log.csv", "\n".join(["t,r,u,y", *table(columns())]))


@exhibit("plant.db", "SQLite, 'Database file format', written by pandas and SQLAlchemy (DataFrame.to_sql)")
def _(path: Path) -> None:
    import sqlalchemy as sa

    engine = sa.create_engine(f"sqlite:///{path}")
    frame(("time", "target", "current", "actual")).to_sql("press", engine, index=False)
    engine.dispose()


@exhibit("rosbag.db3", "ROS 2, rosbag2_storage_sqlite3, schema 4: topics, messages, message_definitions")
def _(path: Path) -> None:
    kind = "float64 reference\nfloat64 effort\nfloat64 position\n"
    with closing(sqlite3.connect(path)) as bag, bag:
        bag.execute("CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT)")
        bag.execute("INSERT INTO schema VALUES (4, 'jazzy')")
        bag.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT,"
            " offered_qos_profiles TEXT, type_description_hash TEXT)"
        )
        bag.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        bag.execute(
            "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, encoding TEXT,"
            " encoded_message_definition TEXT, type_description_hash TEXT)"
        )
        bag.execute("INSERT INTO topics VALUES (1, '/axis', 'rig_msgs/msg/State', 'cdr', '', '')")
        bag.execute("INSERT INTO message_definitions VALUES (1, 'rig_msgs/msg/State', 'ros2msg', ?, '')", (kind,))
        for t, *values in zip(*columns(), strict=True):
            data = b"\0\1\0\0" + struct.pack("<3d", *values)
            stamp = round(1e9 * t) + 1_700_000_000_000_000_000
            bag.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (1, ?, ?)", (stamp, data))


@exhibit("offsets.csv", "RFC 3339: local times with their offsets, over the change to summer time")
def _(path: Path) -> None:
    at = [
        f"2024-03-31T{hour}:{minute}:{second:05.2f}{offset}"
        for k in range(N)
        for hour, minute, second, offset in [("01", "59", 59 + k / RATE, "+01:00") if k < 100 else
                                             ("03", "00", (k - 100) / RATE, "+02:00")]
    ]  # fmt: skip
    text(path, ["timestamp,setpoint,torque,position", *table([at, *columns()[1:]])])


@exhibit("two_headings.csv", "Dewesoft X, export as text: names of groups over those of channels, then units")
def _(path: Path) -> None:
    text(path, [";Axis;;;Motor", "Time;Setpoint;Current;Actual;Current", "s;mm;A;mm;A",
                *table([*columns(1, 1e3, 1, 1e3), columns()[2]], ";")])  # fmt: skip


@exhibit("unknown_unit.csv", "a row of units with one that no table of units has, and degC (UCUM: Cel)")
def _(path: Path) -> None:
    rows = table([*columns(1e3, 1e3, 1.0, 1e3), 20.0 + motion()["t"], motion()["t"]])
    text(path, ["time,desired,current,position,oil,wear", "ms,mm,A,mm,degC,frob", *rows])


@exhibit(
    "siemens_pair.csv", "Siemens, S7-1500 'TO_PositioningAxis': Position is the setpoint, ActualPosition follows it"
)
def _(path: Path) -> None:
    names = "Time [ms];Axis_1.Position;Axis_1.ActualPosition;Axis_1.Torque"
    t, r, u, y = columns(1e3)
    text(path, [names, *table([t, r, y, u], ";", ",")], "utf-8-sig", "\r\n")


@exhibit("pandas_dates.csv", "pandas, DataFrame.to_csv with a DatetimeIndex, written by pandas")
def _(path: Path) -> None:
    import pandas as pd

    index = pd.date_range("2024-01-31 12:00", periods=N, freq="10ms", tz="Europe/Berlin", name="timestamp")
    frame(("t", "cmd", "current", "feedback")).drop(columns="t").set_index(index).to_csv(path)


@exhibit("fmpy.csv", "FMPy, write_csv: results of a simulated unit, written by FMPy")
def _(path: Path) -> None:
    from fmpy.util import write_csv

    write_csv(str(path), np.rec.fromarrays(columns(), names="time,reference,force,position"))


@exhibit("asammdf.csv", "asammdf, MDF.export('csv'), written by asammdf")
def _(path: Path) -> None:
    from asammdf import MDF, Signal

    t, *signals = columns()
    with MDF(version="4.10") as file:
        file.append([Signal(x, t, name=n) for x, n in zip(signals, ("SetPoint", "Current", "Position"), strict=True)])
        file.export("csv", filename=path, single_time_base=True, overwrite=True)
    if (written := path.with_suffix(".ChannelGroup_0.csv")).exists():
        written.rename(path)


@exhibit("tdms_units.tdms", "National Instruments, TDMS: unit_string, and times of the rows as a channel")
def _(path: Path) -> None:
    from nptdms import ChannelObject, TdmsWriter

    names, units = ("Time", "Demand", "Current", "Position"), ("ms", "mm", "A", "mm")
    with TdmsWriter(path) as file:
        file.write_segment(
            [
                ChannelObject("rig", name, x, {"unit_string": unit})
                for name, unit, x in zip(names, units, columns(1e3, 1e3, 1.0, 1e3), strict=True)
            ]
        )


@exhibit("mdf_units.mf4", "ASAM MDF 4.1: units of the channels (cn_md_unit)")
def _(path: Path) -> None:
    from asammdf import MDF, Signal

    t, *signals = columns(1.0, 1e3, 1.0, 1e3)
    named = zip(signals, ("Soll", "Strom", "Ist"), ("mm", "A", "mm"), strict=True)
    with MDF(version="4.10") as file:
        file.append([Signal(x, t, name=name, unit=unit) for x, name, unit in named])
        file.save(path, overwrite=True)


@exhibit("delta.parquet", "delta-rs, write_deltalake: a part of a table of Delta Lake, written by delta-rs")
def _(path: Path) -> None:
    import tempfile

    import pyarrow as pa
    from deltalake import write_deltalake

    with tempfile.TemporaryDirectory() as folder:
        rows = pa.table(dict(zip(("time", "setpoint", "torque", "angle"), columns(), strict=True)))
        write_deltalake(folder, rows)
        next(Path(folder).glob("*.parquet")).replace(path)


@exhibit("pyulog.csv", "PX4, pyulog's ulog2csv: a topic with timestamps in microseconds, written by pyulog", unit="us")
def _(path: Path) -> None:
    import tempfile

    from pyulog.ulog2csv import convert_ulog2csv

    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "flight.ulg"
        next(one for one in ZOO if one.file == "flight.ulg").write(log)
        convert_ulog2csv(str(log), "servo", folder, ",", None, None)
        next(Path(folder).glob("*.csv")).replace(path)
