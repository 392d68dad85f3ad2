"""Recordings to files, CSV or Parquet, with the columns that a loop reads back."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.errors import OutputError
from servoscope.loop import Columns
from servoscope.output import atomic_write
from servoscope.recording import Recording

__all__ = ["SUFFIXES", "write", "write_table"]

SUFFIXES = (".csv", ".parquet", ".pq")
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}


def write(path: str | Path, recording: Recording, columns: Columns | None = None) -> Columns:
    """Write t, r, u and y of a recording.

    Parameters
    ----------
    path
        A file that ends in .csv, .parquet or .pq.
    recording
        What is written.
    columns
        Names for the columns. What is no plain name, such as ``"0.025 * counts"``, becomes t, r, u or y.

    Returns
    -------
    Columns
        The mapping under which the file reads back; it differs from `columns` where a name was no plain one.

    Raises
    ------
    OutputError
        If the suffix is another, or the file cannot be written.
    """
    used = _plain_names(columns or Columns())
    assigned: dict[str, npt.NDArray[Any]] = {
        used.time or "t": np.round(recording.t / UNITS[used.time_unit], 9),
        used.reference: recording.r,
        used.input: recording.u,
        used.output: recording.y,
        **{name: recording.run for name in used.segment},
    }
    write_table(path, assigned)
    return used


def write_table(path: str | Path, columns: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write columns of equal length; nothing half-written stays behind.

    Raises
    ------
    OutputError
        If the suffix is none of `SUFFIXES`, or the file cannot be written.
    """
    import pyarrow as pa

    table = pa.table(dict(columns))
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise OutputError(f"{path}: cannot write this kind of file, end the name in {' or '.join(SUFFIXES)}")
    sink = io.BytesIO()
    if suffix == ".csv":
        import pyarrow.csv as csv

        cells = [f'"{name}"' if re.search(r'[,"\s]', name) else name for name in table.column_names]
        sink.write((",".join(cells) + "\n").encode())
        csv.write_csv(table, sink, csv.WriteOptions(include_header=False))
    else:
        import pyarrow.parquet as pq

        pq.write_table(table, sink)
    atomic_write(path, sink.getvalue())


def _plain_names(columns: Columns) -> Columns:
    texts = {"time": columns.time or "t", "reference": columns.reference, "input": columns.input}
    texts["output"] = columns.output
    bare = {key: text.strip().strip("`").strip() for key, text in texts.items()}
    plain = {
        key: bare[key] if re.fullmatch(r"`[^`]+`|[^`*/+()\-\"]+", text.strip()) and not _is_number(text) else letter
        for (key, text), letter in zip(texts.items(), "truy", strict=True)
    }
    if len({*plain.values(), *columns.segment}) < len(plain) + len(columns.segment):
        plain = dict(zip(plain, "truy", strict=True))
    told = {key: name for key, name in plain.items() if name != bare[key]}
    return columns.model_copy(update=told)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
