"""Files of programs for measuring and calculating that hold one table: workbooks, LabVIEW measurement files."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from datetime import date, datetime, time, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import RecordingError
from servoscope.signals.readers.clock import is_clock
from servoscope.signals.readers.layout import HEAD_ROWS, check_names, find_table, table_shape
from servoscope.signals.readers.table import (
    TableFile,
    check_bytes,
    check_width,
    is_number,
    one_line_errors,
    shorten_error,
)


def open_sheet(path: Path) -> TableFile:
    """Open a workbook of Excel or LibreOffice; the first sheet that holds a table of numbers is read."""
    from python_calamine import CalamineWorkbook

    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            check_bytes(path, sum(member.file_size for member in archive.infolist()), "sheets")
    try:
        with CalamineWorkbook.from_path(str(path)) as book:
            sheets = [book.get_sheet_by_name(name).to_python() for name in book.sheet_names]
    # it raises errors of its own, and of the archive and the XML in it
    except Exception as error:
        if "EncryptedPackage".encode("utf-16-le") in path.read_bytes():
            raise RecordingError(f"{path}: is protected by a password, save it without one") from None
        raise RecordingError(f"{path}: is a damaged workbook ({shorten_error(error)}), save it again") from None
    for rows in sheets:
        if (sheet_table := _find_sheet_table(path, rows)) is not None:
            return sheet_table
    raise RecordingError(f"{path}: holds no sheet with a table of numbers")


def _find_sheet_table(path: Path, rows: Sequence[Sequence[Any]]) -> TableFile | None:
    """Return the table of a sheet, None if it has none."""
    head = [[_cell_text(cell) for cell in row] for row in rows[:HEAD_ROWS]]
    cells = [row if any(row) else [] for row in head]
    table = find_table(cells, table_shape(cells), str(path))
    if table is None:
        return None
    check_width(path, len(table.names))
    body = rows[table.first :]
    columns = {
        name: _sheet_column([row[index] if index < len(row) else "" for row in body])
        for index, name in enumerate(table.names)
        if name
    }
    return TableFile.from_columns(path, columns)


def _cell_text(cell: Any) -> str:
    if isinstance(cell, datetime):
        return cell.isoformat(" ")
    if isinstance(cell, timedelta):
        return f"{cell.total_seconds():.9g} s"
    return "" if cell is None else str(cell).strip()


def _sheet_column(cells: Sequence[Any]) -> Any:
    """Return cells as Arrow takes them: numbers where there is nothing else, else text."""
    import pyarrow as pa

    if all(isinstance(cell, int | float) or cell in ("", None) for cell in cells):
        return pa.array([None if cell in ("", None) else float(cell) for cell in cells], pa.float64())
    texts = [_cell_text(cell) for cell in cells]
    if not any(isinstance(cell, date | time | timedelta) for cell in cells) and not any(map(is_clock, texts[:20])):
        plain = [text.replace(",", ".", 1) for text in texts]  # numbers that a program wrote as text
        if all(is_number(text) or not text for text in plain):
            return pa.array([float(text) if text else None for text in plain], pa.float64())
    return pa.array(texts, pa.string())


def open_lvm(path: Path) -> TableFile:
    """Open a LabVIEW measurement file: its first segment; time is made of X0 and Delta_X where it is not written.

    Source: National Instruments, "Specification for the LabVIEW Measurement File (.lvm)".
    """
    import lvm_read

    with one_line_errors(path, "is a damaged LVM file", "write it again, or save it as text"):
        read = lvm_read.read(str(path), read_from_pickle=False, dump_file=False)
        segment = read[0]
        names = [str(name) for name in segment["Channel names"]]
        data = np.asarray(segment["data"], dtype=np.float64)
        units = segment.get("Y_Unit_Label", [])
        channels: dict[str, FloatArray] = {
            name: data[:, index] for index, name in enumerate(names) if name and name != "Comment"
        }
        if read.get("X_Columns") == "No":
            step, begin = float(segment["Delta_X"][0]), float(segment["X0"][0])
            clock: FloatArray = begin + step * np.arange(len(data), dtype=np.float64)
            channels = {"X_Value": clock, **channels}
    values = [name for name in channels if name != "X_Value"]
    named = {"X_Value": "time", **{n: f"{n} [{u}]" for n, u in zip(values, units, strict=False) if str(u).strip()}}
    check_names([named.get(name, name) for name in channels], str(path))
    return TableFile.from_columns(path, {named.get(name, name): x for name, x in channels.items()})
