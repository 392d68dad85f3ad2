"""Reads log files: small ones once, ahead of their turn, and none waits for another one that is slow."""

from __future__ import annotations

import hashlib
import math
import os
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from functools import partial
from queue import SimpleQueue
from typing import Any, NamedTuple, TypeVar

from servoscope.core.errors import EmptyRecordingError, OutputError
from servoscope.models.loop import Loop
from servoscope.service.sources.log_files import (
    FileNames,
    FileRows,
    FolderNames,
    LogFile,
    describe_error,
    find_first_time,
    parse_file,
    told_time,
)
from servoscope.service.sources.share import Share

FIRST_S = 15.0  # that the first file is waited for, while its process starts
QUICK_S = 1.0  # and each other one
MAX_SLOW = 2  # files that take longer, at a time; a further one is waited for
LOOK_S = 0.2  # between two looks whether to stop
SMALL_BYTES = 1 << 20  # files up to this size are read once, when their first time stamps are compared
MAX_KEPT_ROWS = 1_000_000  # of these, that are kept until it is the files' turn
PIECE_BYTES = 1 << 20

T = TypeVar("T")


class Contents(NamedTuple):
    """What a file holds."""

    digest: bytes
    rows: Mapping[str, FileRows] = {}  # by asset
    failures: Mapping[str, str] = {}  # why its rows cannot be used, by asset
    empty: str = ""  # that it holds none, in words

    def count_rows(self) -> int:
        """Return how many rows there are."""
        return sum(rows.samples.t.size for rows in self.rows.values())


class LogReader:
    """Reads the files of a folder; one thread asks, until `stop` is set."""

    def __init__(
        self,
        share: Share,
        names: FileNames,
        settings: FolderNames,
        loops: Mapping[str, Loop],
        stop: threading.Event,
    ) -> None:
        self._share, self._names, self._settings, self._loops = share, names, settings, loops
        self._readers = _Readers(stop)
        self._first_times: dict[LogFile, float] = {}  # [UTC s]
        self._contents: dict[LogFile, Contents] = {}  # of files that were read before it is their turn
        self._kept_rows = 0
        self.asked_at = math.inf  # since when an answer of the share is waited for, by the monotonic clock [s]

    def order(self, file: LogFile) -> tuple[float, str]:
        """Return what files are sorted by: the first time stamp [UTC s], and the name.

        Where the time cannot be read, it is as the file's name or its date says it; a file that is slow comes first.
        Raises OSError, and OutputError.
        """
        if file not in self._first_times and (future := self._find_first_time(file)) is not None:
            self._first_times[file] = future
        return self._first_times.get(file, -math.inf), file.name

    def _find_first_time(self, file: LogFile) -> float | None:
        self.asked_at, loop = time.monotonic(), self._loops[file.asset or next(iter(self._loops))]
        told = told_time(file, loop)
        if file.version.size <= SMALL_BYTES and self._kept_rows < MAX_KEPT_ROWS:
            try:
                contents = self._read(file)
            except (FileNotFoundError, PermissionError):  # told when it is its turn
                return told
            if contents is None:
                return None
            self._contents[file] = contents
            self._kept_rows += contents.count_rows()
            return min((float(rows.samples.t[0]) + rows.offset for rows in contents.rows.values()), default=told)
        future = self._readers.ask(file, "first time", partial(find_first_time, self._share.path, file, loop))
        return None if future is None else told if future.exception() else future.result()

    def read(self, file: LogFile) -> Contents | None:
        """Return what a file holds; None: it is slow, and still being read, or has changed.

        Raises OSError, also where it is gone or cannot be opened, and OutputError where there is no room.
        """
        if (contents := self._contents.pop(file, None)) is not None:
            self._kept_rows -= contents.count_rows()
        return contents or self._read(file)

    def _read(self, file: LogFile) -> Contents | None:
        if self._readers.is_reading(file):
            return None
        contents = Contents(self._digest(file))
        self.asked_at = math.inf  # how long it takes depends on its size
        parse = partial(parse_file, self._share.path, file, self._names, self._settings, self._loops)
        if (future := self._readers.ask(file, "rows", parse)) is None:
            return None
        try:
            contents = Contents(contents.digest, *future.result())
        except EmptyRecordingError as error:
            contents = contents._replace(empty=str(error))
        except OutputError:
            raise
        except Exception as error:  # readers of other packages raise what they like
            assets = [file.asset] if file.asset else list(self._loops)
            contents = contents._replace(failures=dict.fromkeys(assets, describe_error(error)))
        about = self._share.stat(file.name)
        is_same = (about.st_size, about.st_mtime_ns) == file.version
        return contents if is_same and not (contents.failures and self._digest(file) != contents.digest) else None

    def _digest(self, file: LogFile) -> bytes:
        """Return what tells a file from others: its content, and what its name says; logs of machines at rest agree."""
        digest = hashlib.blake2b(f"{file.asset}\0{file.time}\0".encode(), digest_size=16)
        with self._share.file(file.name) as opened:
            while piece := os.read(opened, PIECE_BYTES):
                self.asked_at = time.monotonic()
                digest.update(piece)
        return digest.digest()

    def retain(self, files: Iterable[LogFile]) -> None:
        """Forget what was read of other files: they have changed, or were taken away."""
        there = set(files)
        self._readers.retain(there)
        self._first_times = {file: t for file, t in self._first_times.items() if file in there}
        self._contents = {file: contents for file, contents in self._contents.items() if file in there}
        self._kept_rows = sum(contents.count_rows() for contents in self._contents.values())


class _Reading(NamedTuple):
    """A file that is being read."""

    file: LogFile
    future: Future[Any]


class _Readers:
    """Reads files of several assets; one thread asks, until `stop` is set."""

    def __init__(self, stop: threading.Event) -> None:
        self._stop, self._threads = stop, 0
        self._tasks = SimpleQueue[tuple[Future[Any], Callable[[], Any]]]()
        self._readings: dict[tuple[str, LogFile], _Reading] = {}  # by what is read of it

    def ask(self, file: LogFile, what: str, read: Callable[[], T]) -> Future[T] | None:
        """Return what was read of a file, and the error where it cannot be; None: it takes longer, ask again.

        `what`: name of what is asked for, `read` returns it.
        """
        key = what, file
        reading = self._readings.get(key)
        if reading is None:
            reading = self._readings[key] = _Reading(file, Future())
            patience_s = QUICK_S if self._threads else FIRST_S
            if self._threads <= MAX_SLOW:
                self._threads += 1
                threading.Thread(target=self._work, name="file reader", daemon=True).start()
            self._tasks.put((reading.future, read))
            wait([reading.future], patience_s)
        while (
            len(slow := [reading.future for reading in self._readings.values() if not reading.future.done()]) > MAX_SLOW
        ):
            if self._stop.is_set():
                return None
            wait(slow, LOOK_S, FIRST_COMPLETED)
        if not reading.future.done():
            return None
        del self._readings[key]
        return reading.future

    def is_reading(self, file: LogFile) -> bool:
        """Tell whether a file was asked for, and is still being read."""
        return any(reading.file == file and not reading.future.done() for reading in self._readings.values())

    def retain(self, files: Iterable[LogFile]) -> None:
        """Forget what was read of files that are not there any more."""
        there = set(files)
        kept = {
            key: reading
            for key, reading in self._readings.items()
            if reading.file in there or not reading.future.done()
        }
        self._readings = kept

    def _work(self) -> None:
        while True:
            future, read = self._tasks.get()
            try:
                future.set_result(read())
            except BaseException as error:  # readers of other packages raise what they like
                future.set_exception(error)
