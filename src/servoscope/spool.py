"""Arrays that would not fit into memory, kept in a temporary file of which only the pages in use stay in memory."""

from __future__ import annotations

import math
import mmap
import os
import tempfile
from collections.abc import Callable, Iterator
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from servoscope.errors import OutputError

__all__ = ["ROWS", "Growing", "copied", "empty", "pieces", "release", "some", "where", "without"]

ROWS = 1 << 16  # rows that are worked on at a time: a handful of columns of them fit into a core's cache
MANY = 1 << 20  # rows that tell a scale
LARGE = 1 << 24  # bytes from which an array is kept in a file


def empty(shape: tuple[int, ...], dtype: npt.DTypeLike = np.float64) -> npt.NDArray[Any]:
    """Return an array to be filled, as `numpy.empty` does; a large one lies in a temporary file.

    Raises
    ------
    OutputError
        If the file cannot be made.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size < LARGE:
        return np.empty(shape, dtype)
    try:
        with tempfile.TemporaryFile(prefix="servoscope-") as file:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)  # a full disk is told here, and not by a crash
            file.truncate(size)
            return _mapped(file.fileno(), size, dtype).reshape(shape)
    except OSError as error:
        raise _no_room(error) from None


def release(*arrays: npt.NDArray[Any]) -> None:
    """Give back the memory of arrays that lie in a file; they stay as they are."""
    for array in arrays:
        base: Any = array
        while isinstance(base, np.ndarray | memoryview):
            base = base.obj if isinstance(base, memoryview) else base.base
        if isinstance(base, mmap.mmap) and hasattr(base, "madvise"):
            base.madvise(mmap.MADV_DONTNEED)


def pieces(first: int, end: int, *columns: npt.NDArray[Any], at_once: int | None = None) -> Iterator[slice]:
    """Yield the pieces in which rows `first` to `end` are worked on; the columns are released after each of them."""
    rows = at_once or ROWS
    for begin in range(first, end, rows):
        yield slice(begin, min(begin + rows, end))
        release(*columns)


def copied(column: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a copy of a column."""
    copy = empty(column.shape, column.dtype)
    for rows in pieces(0, column.size, column, copy):
        copy[rows] = column[rows]
    return copy


def some(rows: int) -> list[slice]:
    """Return stretches, evenly spread, of about a million of so many rows: they tell scales as well as all do."""
    every = -(-rows // MANY)
    return list(pieces(0, rows))[::every] if every > 1 else [slice(0, rows)]


def where(
    test: Callable[[slice], npt.NDArray[np.bool_]], *columns: npt.NDArray[Any], first: int = 0
) -> npt.NDArray[np.intp]:
    """Return which rows of columns, from the `first` on, pass a test of pieces."""
    found = [rows.start + np.flatnonzero(test(rows)) for rows in pieces(first, columns[0].size, *columns)]
    return np.concatenate([np.empty(0, dtype=np.intp), *found])


def without(column: npt.NDArray[Any], dropped: npt.NDArray[np.intp]) -> npt.NDArray[Any]:
    """Return a column without some of its rows, which are in order; the column itself where there are none."""
    if not dropped.size:
        return column
    rest = empty((column.size - dropped.size,), column.dtype)
    for rows in pieces(0, column.size, column, rest):
        begin, end = np.searchsorted(dropped, [rows.start, rows.stop])
        kept = np.delete(column[rows], dropped[begin:end] - rows.start)
        rest[rows.start - begin : rows.start - begin + kept.size] = kept
    return rest


class Growing:
    """A column that grows piece by piece; a large one lies in a temporary file."""

    def __init__(self) -> None:
        self._parts: list[npt.NDArray[Any]] = []
        self._held = 0
        self._file: IO[bytes] | None = None

    def append(self, part: npt.NDArray[Any]) -> None:
        """Add a piece, shape (N,); all are of one type.

        Raises
        ------
        OutputError
            If the temporary file cannot be written.
        """
        self._parts.append(part)
        self._held += part.nbytes
        if self._held >= (LARGE if self._file is None else LARGE // 8):
            self._spill()

    def whole(self, dtype: npt.DTypeLike = np.float64) -> npt.NDArray[Any]:
        """Return the column; nothing can be added any more. `dtype` is that of an empty one.

        Raises
        ------
        OutputError
            If the temporary file cannot be written.
        """
        if self._file is None:
            return self._parts[0] if len(self._parts) == 1 else np.concatenate(self._parts or [np.empty(0, dtype)])
        dtype = self._parts[0].dtype if self._parts else self._dtype
        self._spill()
        with self._file as file:
            return _mapped(file.fileno(), file.tell(), dtype)

    def _spill(self) -> None:
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(prefix="servoscope-")  # noqa: SIM115 - it outlives this
            for part in self._parts:
                part.tofile(self._file)
                self._dtype = part.dtype
            self._file.flush()
        except OSError as error:
            raise _no_room(error) from None
        self._parts, self._held = [], 0


def _mapped(file: int, size: int, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    return np.frombuffer(mmap.mmap(file, size), dtype)


def _no_room(error: OSError) -> OutputError:
    return OutputError(
        f"{tempfile.gettempdir()}: cannot keep a large recording there ({error.strerror}); make room, or name another "
        "folder in the environment variable TMPDIR"
    )
