"""A zoo of logs, made after what the makers of tools document: each with its source, and options where it needs some.

All hold the same motion: r, u, y of `motion` at 100 Hz, in the units of the tool.
"""

from __future__ import annotations

import struct
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from servoscope.core.arrays import FloatArray

N, RATE = 300, 100.0
Writer = Callable[[Path], object]


def motion() -> dict[str, FloatArray]:
    """Return t [s], r [m], u [A], y [m]."""
    t = np.arange(N) / RATE
    r = 0.05 * np.sin(3.0 * t) + 0.01 * np.sin(11.0 * t)
    y = 0.05 * np.sin(3.0 * (t - 0.02)) + 0.01 * np.sin(11.0 * (t - 0.02))
    return {"t": t, "r": r, "u": 20.0 * (r - y) + 0.1 * np.cos(t), "y": y}


@dataclass(frozen=True)
class Exhibit:
    """One log: name of its file, who writes such, where that is documented, and options that it needs."""

    file: str
    source: str
    write: Writer
    options: dict[str, Any] = field(default_factory=dict)


ZOO: list[Exhibit] = []


def exhibit(file: str, source: str, **options: Any) -> Callable[[Writer], Writer]:
    def add(write: Writer) -> Writer:
        ZOO.append(Exhibit(file, source, write, options))
        return write

    return add


def table(
    columns: Sequence[FloatArray | Sequence[str]], delimiter: str = ",", decimal: str = ".", end: str = ""
) -> list[str]:
    """Return rows of cells as lines."""
    cells = [[str(c) if isinstance(c, str) else f"{c:.9g}".replace(".", decimal) for c in column] for column in columns]
    return [delimiter.join(row) + end for row in zip(*cells, strict=True)]


def text(path: Path, lines: Sequence[str], encoding: str = "utf-8", newline: str = "\n") -> None:
    path.write_bytes((newline.join(lines) + newline).encode(encoding))


def columns(*units: float) -> list[FloatArray]:
    """Return t, r, u, y, each times what makes them the tool's units."""
    return [x * unit for x, unit in zip(motion().values(), (*units, 1.0, 1.0, 1.0, 1.0), strict=False)]


def clock(form: Callable[[int, float], str]) -> list[str]:
    """Return times of day from 12:00:00 on, by hour-minute-second text and the second's fraction."""
    return [form(int(t), round(t % 1.0, 6)) for t in motion()["t"]]


@exhibit("plain.csv", "RFC 4180, section 2: header and commas")
def _(path: Path) -> None:
    text(path, ["time,setpoint,current,position", *table(columns())])


@exhibit(
    "excel_de.csv", "Microsoft Excel, German: 'Save as CSV' writes ; and decimal commas; 'sep=;' names the delimiter"
)
def _(path: Path) -> None:
    rows = table(columns(1.0, 1e3, 1.0, 1e3), ";", ",")
    text(path, ["sep=;", "Zeit;Sollposition[mm];Strom[A];Istposition[mm]", *rows], "cp1252", "\r\n")


@exhibit("twincat_scope.csv", "Beckhoff TE13xx TwinCAT 3 Scope View, 'Export in csv': timelines All, tab, full header")
def _(path: Path) -> None:
    t, *signals = columns(1e3, 1e3, 1.0, 1e3)
    names, units = ("Axis1.SetPos", "Axis1.Current", "Axis1.ActPos"), ("mm", "A", "mm")
    keyed = (
        ("Name", names), ("SymbolComment", ("",) * 3), ("Data-Type", ("REAL64",) * 3), ("SampleTime[ms]", ("10",) * 3),
        ("VariableSize", ("8",) * 3), ("SymbolBased", ("True",) * 3), ("SymbolName", names), ("Port", ("851",) * 3),
        ("Offset", ("0",) * 3), ("ScaleFactor", ("1",) * 3), ("Unit", units),
    )  # fmt: skip
    head = ["\t".join(f"{key}\t{value}" for value in values) for key, values in keyed]
    begun = ["Name\tScope Project", "File\tC:.svdx", "Starttime of export\t133500000000000000\tMontag\t12:00:00", ""]
    text(path, [*begun, *head, "", *table([t, signals[0], t, signals[1], t, signals[2]], "\t", ",")], newline="\r\n")


@exhibit("twincat_shared.csv", "Beckhoff TE13xx, 'Export in csv': timelines For each sampletime, comma, EOF tag")
def _(path: Path) -> None:
    head = ["Name,SetPosition,Torque,ActPosition", "SampleTime[ms],10,10,10", "Data-Type,REAL64,REAL64,REAL64"]
    text(path, ["Name,Project", "", *head, *table(columns(1e3)), "EOF"])


@exhibit(
    "tia_trace.csv", "Siemens, S7-1500 'Using the trace and logic analyzer function', export of a measurement as CSV"
)
def _(path: Path) -> None:
    head = ['"Sample";"Time stamp [ms]";"Axis_1.Setpoint [mm]";"Axis_1.Torque";"Axis_1.ActualPosition [mm]"']
    number = np.arange(N, dtype=float)
    text(path, [*head, *table([number, *columns(1e3, 1e3, 1.0, 1e3)], ";", ",")], "utf-8-sig", "\r\n")


@exhibit(
    "rockwell_trend.csv", "Rockwell Automation, Studio 5000 trends, 'Save trend log as CSV': Header: and Data: rows"
)
def _(path: Path) -> None:
    parts = ["Data:"] * N, ["1/31/2024"] * N, clock(lambda s, _: f"12:00:{s:02d}"), clock(lambda _, f: f"{1e3 * f:.0f}")
    head = ["Controller Name:,PLC_1", "Trend Name:,Axis", "Trend Tags:,3", "Sample Period:,10,ms", "Description:", ""]
    names = '"Header:","Date","Time","Millitm","Axis.CommandPosition","Axis.TorqueReference","Axis.ActualPosition"'
    rows = table([*parts, *columns()[1:]])
    text(path, [*head, names, *rows], newline="\r\n")


@exhibit(
    "dspace_recorder.csv", "dSPACE ControlDesk, 'Exporting measurement data' as CSV: descriptions, then names and units"
)
def _(path: Path) -> None:
    head = ["Recording;rec1_001", "Author;operator", "Comment;after service", ""]
    names = ["time;reference;control;position", "s;mm;V;mm"]
    text(path, [*head, *names, *table(columns(1.0, 1e3, 1.0, 1e3), ";")])


@exhibit("dspace.mat", "dSPACE ControlDesk, measurement as MAT: struct with X and Y of Name and Data")
def _(path: Path) -> None:
    import scipy.io

    t, r, u, y = columns()
    kind = [("Name", object), ("Data", object)]
    axes = np.array([[("time", t[None, :])]], dtype=kind)
    names = ("Inputs/Setpoint", "Current", "Plant/Position")
    each = [(f"Model Root/{name}", x[None, :]) for name, x in zip(names, (r, u, y), strict=True)]
    signals = np.array([each], dtype=kind)
    scipy.io.savemat(path, {"rec1_001": {"X": axes, "Y": signals, "Capture": "10 ms"}})


@exhibit("labview.lvm", "National Instruments, 'Specification for the LabVIEW Measurement File (.lvm)', X_Columns One")
def _(path: Path) -> None:
    text(path, [*_lvm_head("One"), *table([*columns(), [""] * N], "\t", ".")], newline="\r\n")


@exhibit("labview_no_x.lvm", "the same, X_Columns No, decimal comma: time is X0 and Delta_X")
def _(path: Path) -> None:
    rows = table([[""] * N, *columns()[1:], [""] * N], "\t", ",")
    text(path, [*_lvm_head("No"), *rows], newline="\r\n")


def _lvm_head(x_columns: str) -> list[str]:
    decimal = "," if x_columns == "No" else "."
    step = f"0{decimal}01"
    return [
        "LabVIEW Measurement\t", "Writer_Version\t2", "Reader_Version\t2", "Separator\tTab",
        f"Decimal_Separator\t{decimal}", "Multi_Headings\tNo", f"X_Columns\t{x_columns}", "Time_Pref\tRelative",
        "Date\t2024/01/31", "Time\t12:00:00", "***End_of_Header***\t", "\t", "Channels\t3\t\t\t",
        f"Samples\t{N}\t{N}\t{N}\t", "Y_Unit_Label\tm\tA\tm\t", "X_Dimension\tTime\tTime\tTime\t", "X0\t0\t0\t0\t",
        f"Delta_X\t{step}\t{step}\t{step}\t", "***End_of_Header***\t\t\t\t",
        "X_Value\tSetpoint\tCurrent\tPosition\tComment",
    ]  # fmt: skip


@exhibit("labview_text.txt", "National Instruments, Write To Spreadsheet File VI: tabs, no header", names=True)
def _(path: Path) -> None:
    text(path, table(columns(), "\t"))


@exhibit("matlab_timetable.csv", "MathWorks, writetimetable: durations as '0.01 sec', names of the variables")
def _(path: Path) -> None:
    t, *signals = columns()
    text(path, ["Time,Reference,Input,Output", *table([[f"{x:.9g} sec" for x in t], *signals])])


@exhibit("timetable.mat", "MathWorks, save of a timetable, version 7.3: objects in #subsystem#")
def _(path: Path) -> None:
    import warnings

    import pandas as pd
    from matio import save_to_mat

    t, r, u, y = columns()
    index = pd.to_timedelta(t, unit="s").rename("Time")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it stores durations in s, which is what is wanted
        save_to_mat(str(path), {"log": pd.DataFrame({"Reference": r, "Current": u, "Position": y}, index=index)})


@exhibit("simulink.mat", "MathWorks, To Workspace, 'Structure with time', version 5")
def _(path: Path) -> None:
    import scipy.io

    t, r, u, y = columns()
    scipy.io.savemat(path, {"out": {"time": t, "setpoint": r, "control": u, "position": y}})


@exhibit("matlab_ascii.txt", "MathWorks, save -ascii and matrices pasted as text: comment with names, rows end in ;")
def _(path: Path) -> None:
    text(path, ["% time reference torque angle", *table(columns(), "  ", end=";")])


@exhibit("numpy.txt", "NumPy, savetxt with header: names in a comment")
def _(path: Path) -> None:
    np.savetxt(path, np.column_stack(columns()), header="t r u y")


@exhibit("pandas.csv.gz", "pandas, DataFrame.to_csv with compression='gzip', written by pandas")
def _(path: Path) -> None:
    import pandas as pd

    pd.DataFrame(dict(zip("truy", columns(), strict=True))).to_csv(path, index=False, compression="gzip")


@exhibit("archive.zip", "PKWARE APPNOTE: one CSV in a ZIP archive")
def _(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("day 1/log.csv", "\n".join(["t;r;u;y", *table(columns(), ";", ",")]))


@exhibit("workbook.xlsx", "ECMA-376: a sheet with a title, a row of names and a row of units, written by XlsxWriter")
def _(path: Path) -> None:
    import xlsxwriter

    with xlsxwriter.Workbook(str(path)) as book:
        book.add_worksheet("Notes").write(0, 0, "measured after service")
        sheet = book.add_worksheet("Data")
        for row, cells in enumerate(
            (["Axis 7"], [], ["Time", "Target", "Current", "Position"], ["s", "mm", "A", "mm"])
        ):
            sheet.write_row(row, 0, cells)
        for k, x in enumerate(columns(1.0, 1e3, 1.0, 1e3)):
            sheet.write_column(4, k, x)


@exhibit("table.hdf5", "PyTables and h5py: one dataset of records with named fields")
def _(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        file["log"] = np.rec.fromarrays(columns(), names="time,reference,torque,angle")


@exhibit("frame.h5", "pandas, DataFrame.to_hdf, format='fixed': blocks with the names of their columns")
def _(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        group = file.create_group("log")
        group["axis1"] = np.arange(N)
        group["block0_items"] = np.array([b"time", b"reference", b"current", b"position"])
        group["block0_values"] = np.column_stack(columns())


@exhibit("joint.mcap", "ROS 2, control_msgs/JointTrajectoryControllerState in an MCAP bag (mcap.dev, appendix ROS 2)")
def _(path: Path) -> None:
    from mcap_ros2.writer import Writer as Ros2Writer

    kind = "std_msgs/Header header\nfloat64 reference\nfloat64 effort\nfloat64 position\n" + "=" * 80
    kind += "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n" + "=" * 80
    kind += "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    with path.open("wb") as file:
        writer = Ros2Writer(file)
        schema = writer.register_msgdef("control_msgs/msg/State", kind)
        for t, r, u, y in zip(*columns(), strict=True):
            ns = round(1e9 * t) + 1_700_000_000_000_000_000
            stamp = {"sec": ns // 10**9, "nanosec": ns % 10**9}
            message = {"header": {"stamp": stamp, "frame_id": ""}, "reference": r, "effort": u, "position": y}
            writer.write_message("/axis", schema, message, log_time=ns, publish_time=ns)
        writer.finish()


@exhibit("flight.ulg", "PX4, 'ULog File Format': header, flag bits, format, subscription, data")
def _(path: Path) -> None:
    def message(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<HB", len(body), kind[0]) + body

    form = b"servo:uint64_t timestamp;double setpoint;double control;double position;"
    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + message(b"B", bytes(40)) + message(b"F", form)
    data += message(b"A", struct.pack("<BH", 0, 1) + b"servo")
    for t, *signals in zip(*columns(), strict=True):
        data += message(b"D", struct.pack("<HQ3d", 1, round(1e6 * t) + 5_000_000, *signals))
    path.write_bytes(data)


@exhibit("unicode.txt", "Microsoft Excel, 'Unicode text': UTF-16 with mark, tabs, decimal commas of the locale")
def _(path: Path) -> None:
    text(path, ["Zeit (ms)\tSollwert\tStellgröße\tIstwert", *table(columns(1e3), "\t", ",")], "utf-16", "\r\n")


@exhibit("hmi_utf16.csv", "Siemens, WinCC data log exports: UTF-16 without mark")
def _(path: Path) -> None:
    text(path, ["Time;Setpoint;Output_Current;Position", *table(columns(), ";", ",")], "utf-16-le", "\r\n")


@exhibit("date_de.csv", "DIN 5008: date and time of day in one column, 31.01.2024 12:00:00,01")
def _(path: Path) -> None:
    stamps = clock(lambda s, f: f"31.01.2024 12:00:{s:02d},{round(100 * f):02d}")
    text(path, ["Uhrzeit;Soll;Stell;Ist", *table([stamps, *columns()[1:]], ";", ",")], "cp1252")


@exhibit("midnight.csv", "a time of day without a date, over midnight (RFC 3339, partial-time)")
def _(path: Path) -> None:
    times = [(t - 2.0) % 86400.0 for t in motion()["t"].round(6)]
    stamps = [f"{int(t) // 3600:02d}:{int(t) // 60 % 60:02d}:{round(t % 60.0, 2):05.2f}" for t in times]
    text(path, ["heure,consigne,couple,position", *table([stamps, *columns()[1:]])])


@exhibit("francais.csv", "French: Excel with ; and decimal commas")
def _(path: Path) -> None:
    text(
        path,
        ["Temps (s);Consigne (mm);Courant (mA);Mesure (mm)", *table(columns(1, 1e3, 1e3, 1e3), ";", ",")],
        "cp1252",
    )


@exhibit("italiano.csv", "Italian: Excel with ; and decimal commas")
def _(path: Path) -> None:
    text(path, ["Tempo;Riferimento;Corrente;Posizione", *table(columns(), ";", ",")])


@exhibit("espanol.csv", "Spanish: Excel with ; and decimal commas")
def _(path: Path) -> None:
    text(path, ["Tiempo [ms];Consigna [mm];Corriente [A];Posición [mm]", *table(columns(1e3, 1e3, 1, 1e3), ";", ",")])


@exhibit("chinese.csv", "GB 18030: names of columns as Chinese Windows writes them")
def _(path: Path) -> None:
    text(path, ["时间,设定位置,电流,实际位置", *table(columns())], "gb18030")


@exhibit("codesys_trace.csv", "CODESYS, 'Trace: export of the data as text': comment lines, time in microseconds")
def _(path: Path) -> None:
    head = ["// CODESYS trace", "// Task: MainTask", "Time [us];SetPosition [deg];Torque [Nm];ActPosition [deg]"]
    degrees = 180.0 / np.pi
    text(path, [*head, *table(columns(1e6, degrees, 1.0, degrees), ";")])


@exhibit("oscilloscope.csv", "Tektronix, 'Saving waveforms to CSV': preamble of keys and values of another width")
def _(path: Path) -> None:
    head = ["Model,MSO44", "Firmware Version,1.38", "Waveform Type,ANALOG", "Sample Interval,0.01", "Record Length,300"]
    text(path, [*head, "", "TIME,REFERENCE,CURRENT,POSITION", *table(columns())])


@exhibit("quoted.csv", "RFC 4180, section 2.5, with decimal commas: every cell in quotes, commas between them")
def _(path: Path) -> None:
    rows = [f'"{row}"' for row in table(columns(), '","', ",")]
    text(path, ['"t","r","u","y"', *rows])


@exhibit("percent_end.txt", "rows that end in %, as some drives print their scope to a terminal")
def _(path: Path) -> None:
    text(path, ["time ref torque pos %", *table(columns(), " ", end=" %")])


@exhibit("measurement.mf4", "ASAM MDF 4.1: a channel group with a master channel")
def _(path: Path) -> None:
    from asammdf import MDF, Signal

    t, *signals = columns()
    with MDF(version="4.10") as file:
        file.append([Signal(x, t, name=n) for x, n in zip(signals, ("SetPoint", "Current", "Position"), strict=True)])
        file.save(path, overwrite=True)


@exhibit("measurement.tdms", "National Instruments, 'TDMS File Format Internal Structure': wf_increment")
def _(path: Path) -> None:
    from nptdms import ChannelObject, TdmsWriter

    names = ("SetPoint", "Current", "Position")
    clock = {"wf_increment": 1.0 / RATE, "wf_start_offset": 0.0}
    with TdmsWriter(path) as file:
        file.write_segment([ChannelObject("rig", n, x, clock) for n, x in zip(names, columns()[1:], strict=True)])


@exhibit("marks.csv", "marks of an operator between the rows, with as many commas as a row has", comment="!")
def _(path: Path) -> None:
    rows = table(columns())
    text(path, ["t,r,u,y", *rows[:100], "! pause, by, hand, 1", *rows[100:]])


@exhibit("far_header.csv", "names first, then lines of prose, then rows", header_row=1)
def _(path: Path) -> None:
    text(path, ["t;r;u;y", "taken after service, by the night shift", "cylinder 7", *table(columns(), ";")])
