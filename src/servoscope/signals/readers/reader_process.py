"""Files whose libraries a damaged one may hang or kill: read in processes of their own, with limits.

Commands open so what may do that: rows come back as streams of Arrow, each batch with what its `Table` knows besides
the columns. A service leaves all that is done with a file, unpacking too, to such a process.
"""

from __future__ import annotations

import atexit
import importlib
import json
import os
import shutil
import weakref
from collections.abc import Collection, Iterator, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import uuid4

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import (
    EmptyRecordingError,
    IrregularTimeError,
    LoopError,
    NotEnoughError,
    OutputError,
    RecordingError,
    ServoscopeError,
)
from servoscope.core.sandbox import Sandbox
from servoscope.core.temporary import temporary_folder, temporary_folders_in
from servoscope.core.workers import ProcessLimits, Progress, WorkerError, Workers
from servoscope.signals.readers.table import Table, TableFile, rows_wanted

BASE_S, BYTES_PER_S = 15.0, 5e5  # of processor time that a small file may take, and what is larger
WALL_TIME_FACTOR = 10.0  # how much longer it may take by the clock on the wall, on a busy machine or a slow share
LIMITS = ProcessLimits(cpu_s=1e6, memory_mb=8000.0, file_mb=1e6)  # a task's time is bound, not the process's
LIBRARIES = (
    "pandas",
    "pyarrow",
    "h5py",
    "scipy.io",
)  # what most readers use; Arrow looks for pandas at its first array

TEXT_LIBRARIES = ("pyarrow", "pyarrow.csv", "pyarrow.parquet")  # what most logs need: loading counts for no file
TABLE_KEY = b"table"  # of the metadata of a batch
ERRORS = {
    kind.__name__: kind for kind in (EmptyRecordingError, NotEnoughError, IrregularTimeError, LoopError, OutputError)
}
COLUMNS = "columns"  # the file in which columns come back

_kept: dict[tuple[Path, ...], TemporaryDirectory[str]] = {}  # by what a process may read, where it may write
_workers = Workers(LIMITS)  # kept, because starting one and loading its libraries takes a second
atexit.register(_workers.close)
# in a worker: the file that it read last; whether all that is done with a file is done there
_opened: dict[tuple[str, int, int, str], TableFile] = {}
_is_inside = False


def is_inside() -> bool:
    """Tell whether this is a restricted process, in which a reader needs no other one."""
    return _is_inside


def run_restricted(
    readable: tuple[Path, ...], path: Path, size: int, task: str, *arguments: Any
) -> tuple[Any, list[FloatArray]]:
    """Let a task read a file in a process that lasts, which can open what is `readable`, files or folders, and no more.

    `path`, `size` [B]: of the file, for errors, and for how long it may take. The task, ``"package.module:name"``, is
    called with the arguments, and returns what can be written as JSON, and columns of numbers. Raises what it raises on
    purpose, RecordingError where it took more time or memory than files of its size do, OutputError without room.
    """
    if readable not in _kept:  # a process for each file would cost more than what most files hold
        _kept[readable] = temporary_folder("read")
    kept = _kept[readable].name
    scratch = Path(kept) / uuid4().hex  # removed whatever becomes of the process
    sandbox = Sandbox(read=tuple(map(str, readable)), write=(kept,))
    libraries = (__name__, task.partition(":")[0], *TEXT_LIBRARIES)
    cpu_s = BASE_S + size / BYTES_PER_S
    try:
        scratch.mkdir()
        given = (f"{__name__}:run_task", task, arguments, str(scratch))
        answer = _workers.run(
            *given, timeout_s=WALL_TIME_FACTOR * cpu_s, cpu_s=cpu_s, libraries=libraries, sandbox=sandbox
        )
        if "error" in answer:
            raise answered_error(answer)
        with (scratch / COLUMNS).open("rb") as file:
            return answer["about"], [np.fromfile(file, count=int(rows)) for rows in answer["rows"]]
    except WorkerError as error:
        raise RecordingError(f"{path}: is damaged ({str(error)[:120]}), export it again") from None
    except OSError as error:
        raise OutputError(f"{kept}: cannot be written ({error.strerror}), make room") from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def run_task(_progress: Progress, task: str, arguments: tuple[Any, ...], scratch: str) -> dict[str, Any]:
    """Run a task of `run_restricted`, in the worker."""
    global _is_inside
    _is_inside = True
    _silence()
    module, _, name = task.partition(":")
    try:
        with temporary_folders_in(scratch):
            about, columns = getattr(importlib.import_module(module), name)(*arguments)
    except ServoscopeError as error:
        return error_answer(error)
    try:
        with Path(scratch, COLUMNS).open("wb") as file:
            for column in columns:
                np.ascontiguousarray(column, np.float64).tofile(file)
    except OSError as error:
        return error_answer(OutputError(f"{scratch}: cannot be written ({error.strerror}), make room"))
    return {"about": about, "rows": [len(column) for column in columns]}


def error_answer(error: ServoscopeError) -> dict[str, Any]:
    """Return an error as a task answers it."""
    return {"error": str(error), "kind": type(error).__name__}


def answered_error(answer: Mapping[str, Any]) -> ServoscopeError:
    """Return the error that a task has answered."""
    return ERRORS.get(answer["kind"], RecordingError)(str(answer["error"]))


def open_bounded(path: Path, kind: str, module: str, function: str, library: str, *layout: Any) -> TableFile:
    """Open a file in a worker, which can open no other one.

    `kind`: what errors call the file; `module`, `function`: what opens it, with `library`, given the path and `layout`.
    Raises RecordingError if it cannot be read, also where it would take more time or memory than files of its size do.
    """
    cpu_s = BASE_S + path.stat().st_size / BYTES_PER_S
    place = (module, function, str(path.absolute()), str(path), layout)
    folder = temporary_folder("read")
    target, sandbox = Path(folder.name) / "rows.arrow", Sandbox(read=(place[2],), write=(folder.name,))

    def run(task: str, *arguments: Any) -> Any:
        try:
            answer = _workers.run(
                f"{__name__}:{task}",
                *place,
                *arguments,
                timeout_s=WALL_TIME_FACTOR * cpu_s,
                cpu_s=cpu_s,
                libraries=(__name__, module, library, *LIBRARIES),
                sandbox=sandbox,
            )
        except WorkerError as error:
            raise RecordingError(f"{path}: is a damaged {kind} file ({str(error)[:120]}), export it again") from None
        if "error" in answer:  # in the reader's own words
            raise (EmptyRecordingError if answer["empty"] else RecordingError)(answer["error"])
        return answer

    def read_chunks(wanted: Sequence[str], texts: Collection[str]) -> Iterator[Table]:
        import pyarrow as pa

        run("extract_rows", list(wanted), list(texts), rows_wanted(), str(target))
        with pa.OSFile(str(target)) as source:
            target.unlink()
            while source.tell() < source.size():
                with pa.ipc.open_stream(source) as stream:
                    for batch, metadata in stream.iter_batches_with_custom_metadata():
                        yield _read_table(path.name, batch, metadata)

    weakref.finalize(read_chunks, folder.cleanup)
    description = run("describe_file")
    groups = tuple(tuple(group) for group in description["groups"])
    return TableFile(
        path, tuple(description["columns"]), read_chunks, description["others"], groups, description["aliases"]
    )


def _read_table(name: str, batch: Any, metadata: Any) -> Table:
    import pyarrow as pa

    columns = {name: pa.chunked_array([column]) for name, column in zip(batch.schema.names, batch.columns, strict=True)}
    first_row, broken, share = json.loads(metadata[TABLE_KEY])
    return Table(name, columns, first_row, tuple(tuple(row) for row in broken), share)


def describe_file(
    _: Progress, module: str, function: str, path: str, shown: str, layout: tuple[Any, ...]
) -> dict[str, Any]:
    """Open a file, and return what columns it has, or why it cannot be read; in the worker."""
    try:
        opened = _open(module, function, path, layout)
    except RecordingError as error:
        return _describe_error(error, path, shown)
    described = {"columns": opened.columns, "others": opened.non_channels, "groups": opened.channel_groups}
    return {**described, "aliases": opened.aliases}


def _describe_error(error: RecordingError, path: str, shown: str) -> dict[str, Any]:
    return {"error": str(error).replace(path, shown), "empty": isinstance(error, EmptyRecordingError)}


def extract_rows(
    _: Progress,
    module: str,
    function: str,
    path: str,
    shown: str,
    layout: tuple[Any, ...],
    wanted: list[str],
    texts: list[str],
    most: int | None,
    target: str,
) -> dict[str, Any]:
    """Write some columns of a file as streams of Arrow batches, or return why that cannot be; in the worker.

    A stream has columns of one kind: where a text file turns from whole numbers to others, another one begins. `most`:
    rows after which the next piece is the last one that is wanted.
    """
    import pyarrow as pa

    writer, schema, rows = None, None, 0
    with pa.OSFile(target, "wb") as sink:
        try:
            for table in _open(module, function, path, layout).tables(wanted, texts):
                frame = pa.table(table.columns).combine_chunks()
                for batch in frame.to_batches() or [pa.RecordBatch.from_pylist([], frame.schema)]:
                    if writer is None or batch.schema != schema:
                        if writer is not None:
                            writer.close()
                        schema = batch.schema
                        writer = pa.ipc.new_stream(sink, schema)
                    about = json.dumps((table.first_row, table.broken, table.share))
                    writer.write_batch(batch, {TABLE_KEY: about})
                if most is not None and rows >= most:
                    break
                rows += table.rows
        except RecordingError as error:
            return _describe_error(error, path, shown)
        finally:
            if writer is not None:
                writer.close()
    return {}


def _open(module: str, function: str, path: str, layout: tuple[Any, ...]) -> TableFile:
    _silence()
    about = Path(path).stat()
    key = path, about.st_mtime_ns, about.st_size, str(layout)
    if key not in _opened:
        _opened.clear()
        _opened[key] = attrgetter(function)(importlib.import_module(module))(Path(path), *layout)
    return _opened[key]


def _silence() -> None:
    """Discard what libraries print of a damaged file; answers have a stream of their own."""
    silent = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(silent, stream)
    os.close(silent)
