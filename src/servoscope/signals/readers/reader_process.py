"""Files whose libraries a damaged one may hang or kill: read in processes of their own, with limits."""

from __future__ import annotations

import atexit
import importlib
import os
import weakref
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from servoscope.core.errors import RecordingError
from servoscope.core.sandbox import Sandbox
from servoscope.core.temporary import temporary_folder
from servoscope.core.workers import ProcessLimits, Progress, WorkerError, Workers
from servoscope.signals.readers.table import TableFile

BASE_S, BYTES_PER_S = 15.0, 5e5  # that a small file may take, and what is larger, by the clock on the wall
LIMITS = ProcessLimits(cpu_s=1e6, memory_mb=8000.0, file_mb=1e6)  # a task's time is bound, not the process's
LIBRARIES = (
    "pandas",
    "pyarrow",
    "h5py",
    "scipy.io",
)  # what most readers use; Arrow looks for pandas at its first array

_workers = Workers(LIMITS)  # kept, because starting one and loading its libraries takes a second
atexit.register(_workers.close)
_opened: dict[tuple[str, int, int], TableFile] = {}  # in a worker: the file that it read last


def open_bounded(path: Path, kind: str, module: str, function: str, library: str) -> TableFile:
    """Open a file in a worker, which can open no other one.

    `kind`: what errors call the file; `module`, `function`: what opens it, with `library`. Raises RecordingError if it
    cannot be read, also where it would take more time or memory than files of its size do.
    """
    timeout_s = BASE_S + path.stat().st_size / BYTES_PER_S
    place = (module, function, str(path.absolute()), str(path))
    folder = temporary_folder("read")
    target = Path(folder.name) / "rows.arrow"
    sandbox = Sandbox(read=(place[2],), write=(folder.name,))

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
            raise RecordingError(answer["error"])
        return answer

    def read_chunks(wanted: Sequence[str], texts: Collection[str]) -> Iterator[Mapping[str, Any]]:
        import pyarrow as pa

        run("extract_rows", list(wanted), list(texts), str(target))
        with pa.OSFile(str(target)) as source:
            target.unlink()
            for batch in pa.ipc.open_stream(source):
                yield dict(zip(batch.schema.names, batch.columns, strict=True))

    weakref.finalize(read_chunks, folder.cleanup)
    description = run("describe_file")
    groups = tuple(tuple(group) for group in description["groups"])
    return TableFile(
        path, tuple(description["columns"]), read_chunks, description["others"], groups, description["aliases"]
    )


def describe_file(_: Progress, module: str, function: str, path: str, shown: str) -> dict[str, Any]:
    """Open a file, and return what columns it has, or why it cannot be read; in the worker."""
    try:
        opened = _open(module, function, path)
    except RecordingError as error:
        return {"error": str(error).replace(path, shown)}
    described = {"columns": opened.columns, "others": opened.non_channels, "groups": opened.channel_groups}
    return {**described, "aliases": opened.aliases}


def extract_rows(
    _: Progress, module: str, function: str, path: str, shown: str, wanted: list[str], texts: list[str], target: str
) -> dict[str, str]:
    """Write some columns of a file as a stream of Arrow batches, or return why that cannot be; in the worker."""
    import pyarrow as pa

    writer = schema = None
    with pa.OSFile(target, "wb") as sink:
        try:
            for table in _open(module, function, path).tables(wanted, texts):
                rows = pa.table(table.columns)
                if writer is None:
                    schema = rows.schema
                    writer = pa.ipc.new_stream(sink, schema)
                writer.write_table(rows if rows.schema == schema else rows.cast(schema))
        except RecordingError as error:
            return {"error": str(error).replace(path, shown)}
        if writer is None:
            writer = pa.ipc.new_stream(sink, pa.schema([(name, pa.float64()) for name in wanted]))
        writer.close()
    return {}


def _open(module: str, function: str, path: str) -> TableFile:
    silent = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):  # libraries print what they know of a damaged file; answers have a stream of their own
        os.dup2(silent, stream)
    os.close(silent)
    about = Path(path).stat()
    key = path, about.st_mtime_ns, about.st_size
    if key not in _opened:
        _opened.clear()
        _opened[key] = getattr(importlib.import_module(module), function)(Path(path))
    return _opened[key]
