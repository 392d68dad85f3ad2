"""Files whose libraries a damaged one may hang or kill: read in processes of their own, with limits.

Commands read so what may do that; a service reads all files so. Rows come back as streams of Arrow, each batch with
what its `Table` knows besides the columns.
"""

from __future__ import annotations

import atexit
import importlib
import json
import os
import weakref
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from operator import attrgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import uuid4

from servoscope.core.errors import EmptyRecordingError, RecordingError
from servoscope.core.sandbox import Sandbox
from servoscope.core.temporary import temporary_folder
from servoscope.core.workers import ProcessLimits, Progress, WorkerError, Workers
from servoscope.signals.readers.table import Table, TableFile, rows_wanted

BASE_S, BYTES_PER_S = 15.0, 5e5  # that a small file may take, and what is larger, by the clock on the wall
LIMITS = ProcessLimits(cpu_s=1e6, memory_mb=8000.0, file_mb=1e6)  # a task's time is bound, not the process's
LIBRARIES = (
    "pandas",
    "pyarrow",
    "h5py",
    "scipy.io",
)  # what most readers use; Arrow looks for pandas at its first array

TABLE_KEY = b"table"  # of the metadata of a batch

_folder: ContextVar[Path | None] = ContextVar("folder", default=None)  # within `read_restricted`
_shared: dict[Path, TemporaryDirectory[str]] = {}  # what the process for such a folder may write
_workers = Workers(LIMITS)  # kept, because starting one and loading its libraries takes a second
atexit.register(_workers.close)
_opened: dict[tuple[str, int, int, str], TableFile] = {}  # in a worker: the file that it read last


@contextmanager
def read_restricted(folder: Path) -> Iterator[None]:
    """Read all files in restricted processes, in this thread for a while: those of a folder in one that lasts.

    It can open the files of the folder, and no others.
    """
    before = _folder.set(folder.absolute())
    try:
        yield
    finally:
        _folder.reset(before)


def is_restricted() -> bool:
    """Tell whether all files are read in restricted processes."""
    return _folder.get() is not None


def open_bounded(path: Path, kind: str, module: str, function: str, library: str, *layout: Any) -> TableFile:
    """Open a file in a worker, which can open no other one, or those of the folder that is being read.

    `kind`: what errors call the file; `module`, `function`: what opens it, with `library`, given the path and `layout`.
    Raises RecordingError if it cannot be read, also where it would take more time or memory than files of its size do.
    """
    timeout_s = BASE_S + path.stat().st_size / BYTES_PER_S
    place = (module, function, str(path.absolute()), str(path), layout)
    folder, sandbox = _sandbox(path)
    target = Path(folder.name) / f"rows-{uuid4().hex}.arrow"

    def run(task: str, *arguments: Any) -> Any:
        try:
            answer = _workers.run(
                f"{__name__}:{task}",
                *place,
                *arguments,
                timeout_s=timeout_s,
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

    weakref.finalize(read_chunks, target.unlink, missing_ok=True)
    if folder not in _shared.values():
        weakref.finalize(read_chunks, folder.cleanup)
    description = run("describe_file")
    groups = tuple(tuple(group) for group in description["groups"])
    return TableFile(
        path, tuple(description["columns"]), read_chunks, description["others"], groups, description["aliases"]
    )


def _sandbox(path: Path) -> tuple[TemporaryDirectory[str], Sandbox]:
    """Return where the rows of a file are written, and within what it is read."""
    folder, file = _folder.get(), path.absolute()
    if folder is None or not file.is_relative_to(folder) or file.is_symlink():
        own = temporary_folder("read")
        return own, Sandbox(read=(str(file),), write=(own.name,))
    if folder not in _shared:  # a process for each file would cost more than what most files hold
        _shared[folder] = temporary_folder("read")
    return _shared[folder], Sandbox(read=(str(folder),), write=(_shared[folder].name,))


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
    silent = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):  # libraries print what they know of a damaged file; answers have a stream of their own
        os.dup2(silent, stream)
    os.close(silent)
    about = Path(path).stat()
    key = path, about.st_mtime_ns, about.st_size, str(layout)
    if key not in _opened:
        _opened.clear()
        _opened[key] = attrgetter(function)(importlib.import_module(module))(Path(path), *layout)
    return _opened[key]
