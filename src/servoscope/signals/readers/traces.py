"""Traces of controllers that are text but no table: those of CODESYS and ctrlX, and of halscope of LinuxCNC."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import RecordingError
from servoscope.signals.readers.layout import check_names
from servoscope.signals.readers.table import TableFile, one_line_errors

KEY = re.compile(r"\s*(\d+)\.(\w+)\s*;\s*(.*?)\s*;?\s*")
ROW = re.compile(r"\s*;\s*([^;]+?)\s*;\s*([^;]+?)\s*;?\s*")
PERIOD = re.compile(r"#? ?Sampling period is (\d+) n")
WORDS = {"true": 1.0, "false": 0.0}


def open_trace(path: Path) -> TableFile:
    """Open a trace that was saved as text, ``[key]; [value]``: variables by name, stamps in ms.

    Variables that were sampled together share one time column; those of another task have one of their own.
    """
    names: dict[int, str] = {}
    rows: dict[int, list[tuple[float, float]]] = {}
    block: int | None = None
    with one_line_errors(path, "is a damaged trace", "save it again", (ValueError,)):
        for line in path.read_text("utf-8-sig", errors="replace").splitlines():
            if (row := ROW.fullmatch(line)) is not None and block is not None:
                rows[block].append((_number(row[1]), _number(row[2])))
            elif (key := KEY.fullmatch(line)) is not None:
                block = int(key[1])
                rows.setdefault(block, [])
                if key[2] == "Variable":
                    names[block] = key[3]
    blocks = {names.get(number, f"c{number}"): np.array(cells) for number, cells in rows.items() if cells}
    check_names([names.get(number, f"c{number}") for number, cells in rows.items() if cells], str(path))
    if not blocks:
        raise RecordingError(f"{path}: is a trace without samples, save it after it has recorded")
    groups: list[dict[str, FloatArray]] = []
    for name, cells in blocks.items():
        t, values = cells[:, 0], cells[:, 1]
        mine = next((group for group in groups if np.array_equal(next(iter(group.values())), t)), None)
        if mine is None:
            groups.append({f"time{f' {len(groups) + 1}' if groups else ''} [ms]": t, name: values})
        else:
            mine[name] = values
    columns = {name: x for group in groups for name, x in group.items()}
    return TableFile.from_columns(path, columns, channel_groups=tuple(map(tuple, groups)))


def _number(cell: str) -> float:
    word = WORDS.get(cell.lower())
    return float(cell.replace(",", ".")) if word is None else word


def open_halscope(path: Path) -> TableFile:
    """Open a log of halscope of LinuxCNC; its first line has the sampling period, of which the time is made.

    Its rows are values under a line of names, or, of earlier versions, name and value by turns.
    """
    lines = path.read_text("utf-8-sig", errors="replace").splitlines()
    begun = PERIOD.match(lines[0]) if lines else None
    body = [line for line in lines[1:] if line.strip() and not line.startswith("#")]
    if begun is None or not body:
        raise RecordingError(f"{path}: is a log of halscope without samples, write it again")
    with one_line_errors(path, "is a damaged log of halscope", "write it again", (ValueError, IndexError)):
        if ";" in body[0]:
            names, cells = body[0].split(";"), [line.split(";") for line in body[1:]]
        else:
            names, cells = body[0].split()[0::2], [line.split()[1::2] for line in body]
        values = np.array([[float(cell) for cell in row] for row in cells]).reshape(-1, len(names))
    check_names(names, str(path))
    time = 1e-9 * int(begun[1]) * np.arange(len(values))
    return TableFile.from_columns(path, {"time": time, **{name: values[:, k] for k, name in enumerate(names)}})
