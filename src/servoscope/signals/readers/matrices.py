"""Columns out of matrices and out of cells that hold several values: which side of a matrix are the samples."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.signals.readers.guess_columns import guess_columns

MAX_ARRAY_LENGTH = 64  # values of one sample, such as the joints of a robot; images and scans have more
MAX_DEPTH = 6  # of records within records
RECORD = "record"  # column with the number of the record that an element of a list comes from

Array = npt.NDArray[Any]


def split_matrices(arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Return vectors as they are and matrices as their signals, ``x[0]``, ``x[1]``, in columns or in rows.

    The length of the time says which side the samples are, or that of most vectors; without vectors it is the longer
    side. A first row that rises steadily, as To File of Simulink writes it, is the time.
    """
    vectors = {name: x.size for name, x in arrays.items() if x.ndim == 1 and x.size > 1}
    clock = guess_columns(list(vectors)).get("t")
    common = max(Counter(vectors.values()).items(), key=lambda pair: (pair[1], pair[0]), default=(0, 0))[0]
    rows = vectors[clock] if clock is not None else common
    columns: dict[str, Array] = {}
    for name, x in arrays.items():
        if x.ndim == 1:
            columns[name or "c0"] = x
            continue
        turned = rows == x.shape[1] if rows in x.shape and x.shape[0] != x.shape[1] else x.shape[0] < x.shape[1]
        if turned and rows not in x.shape and x.shape[0] > MAX_ARRAY_LENGTH:
            turned = False
        signals = [np.ascontiguousarray(signal) for signal in (x if turned else x.T)]
        names = [f"{name}[{k}]" if name else f"c{k}" for k in range(len(signals))]
        if turned and not vectors and len(signals) > 1 and _is_clock(signals[0]) and "time" not in arrays:
            names[0] = "time"
        columns |= dict(zip(names, signals, strict=True))
    return columns


def _is_clock(x: Array) -> bool:
    steps = np.diff(x.astype(np.float64))
    return bool(steps.size and steps.min() > 0.0 and steps.max() < 10.0 * np.median(steps))


def flatten_table(table: Any) -> dict[str, Any]:
    """Return the columns of a table of Arrow: records within records as ``axis.position``, short lists as ``x[0]``.

    Where the cells of some columns are long lists of one length, as of one experiment per record, each element is a
    row, and the number of its record is in a column of its own.
    """
    for _ in range(MAX_DEPTH):
        table = table.flatten()
    columns = {name: table.column(name) for name in table.column_names}
    lists = {name: _lengths(column) for name, column in columns.items() if _is_list(column)}
    long = {name: lengths for name, lengths in lists.items() if lengths.size and np.median(lengths) > MAX_ARRAY_LENGTH}
    if long:
        return _explode(columns, lists, next(iter(long.values())))
    return dict(pair for name, column in columns.items() for pair in _elements(name, column, lists.get(name)))


def _is_list(column: Any) -> bool:
    import pyarrow as pa

    kinds = pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list
    return any(is_kind(column.type) for is_kind in kinds)


def _lengths(column: Any) -> npt.NDArray[np.int64]:
    import pyarrow.compute as pc

    return np.asarray(pc.list_value_length(column).fill_null(0).to_numpy(), dtype=np.int64)


def _elements(name: str, column: Any, lengths: npt.NDArray[np.int64] | None) -> Iterator[tuple[str, Any]]:
    """Yield a column, or the elements of its lists, where they are few; a list of another length has none."""
    import pyarrow as pa
    import pyarrow.compute as pc  # takes a while to import

    if lengths is None:
        yield name, column
        return
    width = int(lengths[lengths > 0][0]) if lengths.any() else 0
    if not 0 < width <= MAX_ARRAY_LENGTH:
        return
    if not (lengths == width).all():
        cells = (cell if cell is not None and len(cell) == width else None for cell in column.to_pylist())
        column = pa.chunked_array([pa.array(cells, pa.list_(column.type.value_type))])
    for k in range(width):
        element = pc.list_element(column, k)
        if not pa.types.is_nested(element.type):
            yield f"{name}[{k}]", element


def _explode(
    columns: Mapping[str, Any], lists: Mapping[str, npt.NDArray[np.int64]], lengths: npt.NDArray[np.int64]
) -> dict[str, Any]:
    """Return the elements of the lists of the given lengths as rows, each with what its record says besides."""
    import pyarrow as pa
    import pyarrow.compute as pc

    parent = pa.array(np.repeat(np.arange(lengths.size), lengths))
    rows = {RECORD: parent}
    for name, column in columns.items():
        if name in lists and np.array_equal(lists[name], lengths):
            rows[name] = pc.list_flatten(column)
        elif name not in lists:
            rows[name] = column.take(parent)
    return rows
