"""Files of records and arrays: JSON, JSON lines, Feather, arrays of NumPy, tables of SQLite."""

from __future__ import annotations

import json
import math
import sqlite3
import zipfile
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pyarrow as pa
import pyarrow.feather as pf
import pyarrow.json as pj
from pyarrow.dataset import dataset

from servoscope.core.errors import RecordingError
from servoscope.signals.readers.matrices import MAX_ARRAY_LENGTH, flatten_table, split_matrices
from servoscope.signals.readers.table import (
    CHUNK_ROWS,
    NUMBER_BYTES,
    TableFile,
    check_bytes,
    check_size,
    check_width,
    one_line_errors,
)
from servoscope.signals.readers.topics import open_bag


def open_json(path: Path) -> TableFile:
    """Open records, one per line or in a list, or a mapping of names to lists; records within records are flattened."""
    kinds = pa.ArrowException, ValueError, TypeError, AttributeError, RecursionError
    with one_line_errors(path, "is no table in JSON", "write one record per line", kinds):
        with path.open("rb") as file:
            lines = file.readline().strip().endswith(b"}") and bool(file.readline().strip())
        if lines:
            return _open_frame(path, pj.read_json(path))
        content = json.loads(path.read_bytes())
        while isinstance(content, dict) and len(content) == 1:  # a name around the table
            content = next(iter(content.values()))
        if isinstance(content, dict):
            content = {name: values for name, values in content.items() if isinstance(values, list)}
            return _open_frame(path, pa.table(content))
        return open_records(path, content)


def open_records(path: Path, records: Sequence[Mapping[str, Any]]) -> TableFile:
    """Open a list of records."""
    return _open_frame(path, pa.Table.from_pylist(records))


def open_feather(path: Path) -> TableFile:
    """Open a Feather file, which is Arrow's own format."""
    kinds = pa.ArrowException, OSError, ValueError
    with one_line_errors(path, "is a damaged Feather file", "write it again", kinds):
        with suppress(pa.ArrowInvalid, pa.ArrowNotImplementedError):  # version 1 is not packed
            packed = dataset(path, format="feather")
            check_size(path, packed.count_rows(), len(packed.schema))
        return _open_frame(path, pf.read_table(path, memory_map=False))


def open_numpy(path: Path) -> TableFile:
    """Open arrays of NumPy, ``.npz`` or ``.npy``: columns by name, fields of records, or columns of a matrix."""
    with one_line_errors(path, "holds no plain arrays", "save columns of numbers"), path.open("rb") as file:
        _check_arrays(path)
        loaded = np.load(file, allow_pickle=False)
        arrays = {"": loaded} if isinstance(loaded, np.ndarray) else {name: loaded[name] for name in loaded.files}
    columns = split_matrices(dict(pair for name, array in arrays.items() for pair in _plain_arrays(name, array)))
    length = max(
        Counter(x.size for x in columns.values()).items(), key=lambda pair: (pair[1], pair[0]), default=(0, 0)
    )[0]
    others = {name: f"has {x.size} values, not {length}" for name, x in columns.items() if x.size != length}
    return _open_frame(path, pa.table({name: x for name, x in columns.items() if name not in others}), others)


def _check_arrays(path: Path) -> None:
    """Refuse arrays whose headers claim improbably many values; raises RecordingError."""

    def claimed_bytes(file: Any) -> int:
        version = np.lib.format.read_magic(file)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(file)
        return math.prod(shape) * max(NUMBER_BYTES, dtype.itemsize)

    if not zipfile.is_zipfile(path):
        with path.open("rb") as file:
            return check_bytes(path, claimed_bytes(file), "values")
    total = 0
    with zipfile.ZipFile(path) as archive:
        for name in archive.namelist():
            with archive.open(name) as member:
                total += claimed_bytes(member)
    return check_bytes(path, total, "values")


def _plain_arrays(name: str, array: Any) -> Iterator[tuple[str, Any]]:
    """Yield the vectors and matrices of an array, those of records by the names of their fields."""
    if array.dtype.names:
        for field in array.dtype.names:
            yield from _plain_arrays(f"{name}.{field}".lstrip("."), array[field])
    elif array.size == max(array.shape, default=0):
        if array.dtype.kind in "fiubMm":
            yield name, array.ravel()
    elif array.ndim == 2 and array.dtype.kind in "fiub" and 1 < min(array.shape) <= MAX_ARRAY_LENGTH:
        yield name, array


def open_sqlite(path: Path) -> TableFile:
    """Open a database of SQLite; of several tables columns are ``table.column``. A bag of ROS 2 is one too."""
    damaged = path, "is a damaged SQLite file", "export it again", (sqlite3.Error,)
    with one_line_errors(*damaged), closing(_connect(path)) as database:
        names = [str(row[0]) for row in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        if {"topics", "messages"} <= set(names):
            return _open_bag(path)
        tables = {name: _column_names(database, name) for name in names if not name.startswith("sqlite_")}
    tables = {name: columns for name, columns in tables.items() if len(columns) > 1}
    places = {
        f"{name}.{column}" if len(tables) > 1 else column: (name, column)
        for name, columns in tables.items()
        for column in columns
    }
    check_width(path, len(places))

    def read_chunks(wanted: Sequence[str], _: Collection[str]) -> Iterator[Mapping[str, Any]]:
        table = places[wanted[0]][0]  # that of all of them
        query = f"SELECT {', '.join(_quote(places[name][1]) for name in wanted)} FROM {_quote(table)}"
        with one_line_errors(*damaged), closing(_connect(path)) as database:
            rows = database.execute(query)
            while piece := rows.fetchmany(CHUNK_ROWS):
                cells = zip(wanted, zip(*piece, strict=True), strict=True)
                yield {name: _cell_column(column) for name, column in cells}

    groups = tuple(tuple(name for name, (table, _) in places.items() if table == label) for label in tables)
    return TableFile(path, tuple(places), read_chunks, channel_groups=groups)


def _open_bag(path: Path) -> TableFile:
    if find_spec("rosbags") is None:
        raise RecordingError(f"{path}: bags of ROS need rosbags, pip install 'servoscope[formats]'")
    if path.suffix.lower() != ".db3":
        raise RecordingError(f"{path}: is a bag of ROS 2, rename it to {path.stem}.db3")
    return open_bag(path)


def _connect(path: Path) -> sqlite3.Connection:
    # immutable: no journal beside the file is looked for
    return sqlite3.connect(f"file:{quote(str(path))}?mode=ro&immutable=1", uri=True)


def _quote(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


def _column_names(database: sqlite3.Connection, table: str) -> list[str]:
    return [str(row[1]) for row in database.execute(f"PRAGMA table_info({_quote(table)})")]


def _cell_column(cells: Sequence[Any]) -> Any:
    """Return cells as Arrow takes them: numbers where there is nothing else, else text."""
    if all(cell is None or isinstance(cell, int | float) for cell in cells):
        whole = all(cell is None or isinstance(cell, int) for cell in cells)
        return pa.array(cells, pa.int64() if whole else pa.float64())
    return pa.array([None if cell is None else str(cell) for cell in cells], pa.string())


def _open_frame(path: Path, table: Any, others: Mapping[str, str] | None = None) -> TableFile:
    """Return a table of Arrow, records and lists in its cells flattened."""
    columns = flatten_table(table)
    check_width(path, len(columns))
    return TableFile.from_columns(path, columns, non_channels=dict(others or {}))
