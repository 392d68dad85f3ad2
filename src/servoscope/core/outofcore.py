"""Arrays larger than memory, in a temporary file of which only the pages in use stay in memory."""

from __future__ import annotations

import math
import mmap
import os
import tempfile
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from servoscope.core.errors import OutputError

CHUNK_ROWS = 1 << 16  # rows that are worked on at a time: a handful of columns of them fit into a core's cache
RELEASE_CHUNKS = 8  # after which their memory is freed: after each, it takes 0.1 s of a command with ten million rows
SAMPLE_ROWS = 1 << 20  # rows that are enough to estimate a scale
SPILL_BYTES = 1 << 24  # bytes from which an array is kept in a file


class _SameThread(Executor):
    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future = Future[Any]()
        future.set_result(fn(*args, **kwargs))
        return future


def second_thread(rows: int) -> Executor:
    """Return what works beside this thread, task by task; for one chunk this thread itself: starting another costs."""
    return ThreadPoolExecutor(1) if rows > CHUNK_ROWS else _SameThread()


def empty(shape: tuple[int, ...], dtype: npt.DTypeLike = np.float64) -> npt.NDArray[Any]:
    """Return an array that is not filled; a large one lies in a temporary file. Raises OutputError if that fails."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size < SPILL_BYTES:
        return np.empty(shape, dtype)
    try:
        with tempfile.TemporaryFile(prefix="servoscope-") as file:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)  # a full disk is an error here, not a crash later
            file.truncate(size)
            return _map_file(file.fileno(), size, dtype).reshape(shape)
    except OSError as error:
        raise _disk_full_error(error) from None


def release(*arrays: npt.NDArray[Any]) -> None:
    """Free the memory of arrays that lie in a file; their content stays."""
    for array in arrays:
        base: Any = array.base
        while isinstance(base, (np.ndarray, memoryview)):  # a tuple: several times as fast as a union
            base = base.obj if isinstance(base, memoryview) else base.base
        if isinstance(base, mmap.mmap) and hasattr(base, "madvise"):
            base.madvise(mmap.MADV_DONTNEED)


def iter_chunks(first: int, end: int, *columns: npt.NDArray[Any], at_once: int | None = None) -> Iterator[slice]:
    """Yield rows `first` to `end` as slices of `CHUNK_ROWS`; release the columns after some of them."""
    rows = at_once or CHUNK_ROWS
    every = RELEASE_CHUNKS if at_once is None else 1
    for number, begin in enumerate(range(first, end, rows), 1):
        yield slice(begin, min(begin + rows, end))
        if number % every == 0 or begin + rows >= end:
            release(*columns)


def copy_column(column: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a copy of a column."""
    copy = empty(column.shape, column.dtype)
    for rows in iter_chunks(0, column.size, column, copy):
        copy[rows] = column[rows]
    return copy


def extremes(column: npt.NDArray[Any]) -> tuple[float, float]:
    """Return the smallest and the largest value of a column of at least one row."""
    bounds = [(column[rows].min(), column[rows].max()) for rows in iter_chunks(0, column.size, column)]
    return float(min(low for low, _ in bounds)), float(max(high for _, high in bounds))


def sample_chunks(rows: int) -> list[slice]:
    """Return slices, evenly spread, of about a million rows: enough to estimate a scale."""
    every = -(-rows // SAMPLE_ROWS)
    return list(iter_chunks(0, rows))[::every] if every > 1 else [slice(0, rows)]


def find_rows(
    test: Callable[[slice], npt.NDArray[np.bool_]], *columns: npt.NDArray[Any], first: int = 0
) -> npt.NDArray[np.intp]:
    """Return the rows of columns, from the `first` on, that pass a test of slices."""
    places = [rows.start + np.flatnonzero(test(rows)) for rows in iter_chunks(first, columns[0].size, *columns)]
    return np.concatenate([np.empty(0, dtype=np.intp), *places])


def drop_rows(column: npt.NDArray[Any], dropped: npt.NDArray[np.intp]) -> npt.NDArray[Any]:
    """Return a column without some of its rows, given in order; the column itself where there are none."""
    if not dropped.size:
        return column
    remaining = empty((column.size - dropped.size,), column.dtype)
    for rows in iter_chunks(0, column.size, column, remaining):
        begin, end = np.searchsorted(dropped, [rows.start, rows.stop])
        kept = np.delete(column[rows], dropped[begin:end] - rows.start)
        remaining[rows.start - begin : rows.start - begin + kept.size] = kept
    return remaining


class GrowableArray:
    """An array to which rows are appended; a large one lies in a temporary file, whose errors are OutputErrors."""

    def __init__(self) -> None:
        self._parts: list[npt.NDArray[Any]] = []
        self._pending_bytes = 0
        self._file: IO[bytes] | None = None

    def append(self, part: npt.NDArray[Any]) -> None:
        """Add rows (N, ...)."""
        self._parts.append(np.ascontiguousarray(part))  # a view of some columns would keep them all
        self._pending_bytes += part.nbytes
        if self._pending_bytes >= (SPILL_BYTES if self._file is None else SPILL_BYTES // 8):
            self._spill()

    def to_array(self, dtype: npt.DTypeLike = np.float64) -> npt.NDArray[Any]:
        """Return the array, after which nothing can be appended; `dtype` is that of an empty one."""
        if self._file is None:
            return self._parts[0] if len(self._parts) == 1 else np.concatenate(self._parts or [np.empty(0, dtype)])
        self._spill()
        with self._file as file:
            return _map_file(file.fileno(), file.tell(), self._last.dtype).reshape(-1, *self._last.shape[1:])

    def _spill(self) -> None:
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(prefix="servoscope-")  # noqa: SIM115 - it outlives this
                weakref.finalize(self, self._file.close)
            for part in self._parts:
                part.tofile(self._file)
                self._last = part[:0]
            self._file.flush()
        except OSError as error:
            raise _disk_full_error(error) from None
        self._parts, self._pending_bytes = [], 0


def _map_file(file: int, size: int, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    return np.frombuffer(mmap.mmap(file, size), dtype)


def _disk_full_error(error: OSError) -> OutputError:
    return OutputError(
        f"{tempfile.gettempdir()}: cannot keep a large recording there ({error.strerror}); make room, or name another "
        "folder in the environment variable TMPDIR"
    )
