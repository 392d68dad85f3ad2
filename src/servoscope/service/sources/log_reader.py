"""Reads log files: small ones once, ahead of their turn, and none waits for another one that is slow."""

from __future__ import annotations

import hashlib
import math
import os
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import suppress
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple, TypeVar

from servoscope.core.errors import EmptyRecordingError, OutputError
from servoscope.models.loop import Loop
from servoscope.service.sources.log_files import (
    FileNames,
    FileRows,
    FolderNames,
    LogFile,
    Parsed,
    describe_error,
    find_first_time,
    parse_files,
    told_time,
)
from servoscope.service.sources.share import Share
from servoscope.signals.readers.formats import BUILT_IN

FIRST_S = 15.0  # that the first file is waited for, while its process starts
QUICK_S = 1.0  # and each other one
MAX_SLOW = 2  # files that take longer, at a time; a further one is waited for
LOOK_S = 0.2  # between two looks whether to stop
SMALL_BYTES = 1 << 20  # files up to this size are read once, when their first time stamps are compared
MAX_KEPT_ROWS = 1_000_000  # of these, that are kept until it is the files' turn
SMALL_TEXT_BYTES, BATCH_FILES = 1 << 16, 32  # texts up to this size are read together, so many at a time
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


def _is_small_text(file: LogFile) -> bool:
    """Tell whether a file cannot be slow by what it holds, as an archive can."""
    reader = BUILT_IN.get(Path(file.name).suffix.lower())
    return file.version.size <= SMALL_TEXT_BYTES and reader is not None and reader.format == "CSV"


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
        # files that are being read together, with their digests, and those that cannot be
        self._batches: dict[tuple[LogFile, ...], dict[LogFile, bytes]] = {}
        self._alone = set[LogFile]()
        self._kept_rows = 0
        self.asked_at = math.inf  # since when an answer of the share is waited for, by the monotonic clock [s]

    def read_ahead(self, files: Sequence[LogFile]) -> None:
        """Read small texts before it is their turn, many in one exchange with the process that reads them.

        Raises OSError, and OutputError where there is no room.
        """
        known = {*self._contents, *self._alone, *(file for batch in self._batches for file in batch)}
        small = [file for file in files if file not in known and _is_small_text(file)]
        batches = (tuple(small[begin : begin + BATCH_FILES]) for begin in range(0, len(small), BATCH_FILES))
        for batch in (*self._batches, *batches):
            if self._kept_rows >= MAX_KEPT_ROWS:
                break
            self._read_batch(batch)

    def _read_batch(self, batch: tuple[LogFile, ...]) -> None:
        if batch not in self._batches:
            digests = dict[LogFile, bytes]()
            for file in batch:
                with suppress(FileNotFoundError, PermissionError):  # told when it is its turn
                    digests[file] = self._digest(file)
            if not digests:
                return
            batch = tuple(digests)
            self._batches[batch] = digests
        if (contents := self._read_files(batch, self._batches[batch])) is not None:
            del self._batches[batch]
            for file, own in contents.items():
                self._keep(file, own)

    def _keep(self, file: LogFile, contents: Contents) -> None:
        self._contents[file] = contents
        self._kept_rows += contents.count_rows()

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
        if file not in self._contents and file.version.size <= SMALL_BYTES and self._kept_rows < MAX_KEPT_ROWS:
            try:
                contents = self._read(file)
            except (FileNotFoundError, PermissionError):  # told when it is its turn
                return told
            if contents is None:
                return None
            self._keep(file, contents)
        if (known := self._contents.get(file)) is not None:
            return min((float(rows.samples.t[0]) + rows.offset for rows in known.rows.values()), default=told)
        future = self._readers.ask((file,), "first time", partial(find_first_time, self._share.path, file, loop))
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
        contents = self._read_files((file,), {file: self._digest(file)})
        return None if contents is None else contents.get(file)

    def _read_files(
        self, files: tuple[LogFile, ...], digests: Mapping[LogFile, bytes]
    ) -> dict[LogFile, Contents] | None:
        """Return what files hold, without those that have changed; None: they are still being read.

        Raises OSError, and OutputError where there is no room.
        """
        self.asked_at = math.inf  # how long it takes depends on their size
        parse = partial(parse_files, self._share.path, files, self._names, self._settings, self._loops)
        if (future := self._readers.ask(files, "rows", parse)) is None:
            return None
        try:
            outcomes: Sequence[Parsed | Exception] = future.result()
        except OutputError:
            raise
        except Exception as error:  # readers of other packages raise what they like
            outcomes = [error]
        if len(outcomes) < len(files):  # one of them has ended the process: it is found by reading them one by one
            self._alone.update(files)
            return {}
        kept = dict[LogFile, Contents]()
        for file, outcome in zip(files, outcomes, strict=True):
            contents = self._make_contents(file, digests[file], outcome)
            with suppress(FileNotFoundError, PermissionError):
                about = self._share.stat(file.name)
                is_same = (about.st_size, about.st_mtime_ns) == file.version
                if is_same and not (contents.failures and self._digest(file) != contents.digest):
                    kept[file] = contents
        return kept

    def _make_contents(self, file: LogFile, digest: bytes, outcome: Parsed | Exception) -> Contents:
        if isinstance(outcome, OutputError):
            raise outcome
        if isinstance(outcome, EmptyRecordingError):
            return Contents(digest, empty=str(outcome))
        if isinstance(outcome, Exception):
            assets = [file.asset] if file.asset else list(self._loops)
            return Contents(digest, failures=dict.fromkeys(assets, describe_error(outcome)))
        return Contents(digest, *outcome)

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
        self._alone &= there
        self._batches = {batch: digests for batch, digests in self._batches.items() if not there.isdisjoint(batch)}
        self._first_times = {file: t for file, t in self._first_times.items() if file in there}
        self._contents = {file: contents for file, contents in self._contents.items() if file in there}
        self._kept_rows = sum(contents.count_rows() for contents in self._contents.values())


class _Readers:
    """Reads files of several assets; one thread asks, until `stop` is set."""

    def __init__(self, stop: threading.Event) -> None:
        self._stop, self._threads = stop, 0
        self._tasks = SimpleQueue[tuple[Future[Any], Callable[[], Any]]]()
        self._readings: dict[tuple[str, tuple[LogFile, ...]], Future[Any]] = {}  # by what is read, of which files

    def ask(self, files: tuple[LogFile, ...], what: str, read: Callable[[], T]) -> Future[T] | None:
        """Return what was read of files, and the error where it cannot be; None: it takes longer, ask again.

        `what`: name of what is asked for, `read` returns it.
        """
        key = what, files
        reading = self._readings.get(key)
        if reading is None:
            reading = self._readings[key] = Future()
            patience_s = QUICK_S if self._threads else FIRST_S
            if self._threads <= MAX_SLOW:
                self._threads += 1
                threading.Thread(target=self._work, name="file reader", daemon=True).start()
            self._tasks.put((reading, read))
            wait([reading], patience_s)
        while len(slow := [other for other in self._readings.values() if not other.done()]) > MAX_SLOW:
            if self._stop.is_set():
                return None
            wait(slow, LOOK_S, FIRST_COMPLETED)
        if not reading.done():
            return None
        del self._readings[key]
        return reading

    def is_reading(self, file: LogFile) -> bool:
        """Tell whether a file was asked for, and is still being read."""
        return any(file in files and not reading.done() for (_, files), reading in self._readings.items())

    def retain(self, files: Iterable[LogFile]) -> None:
        """Forget what was read of files that are not there any more."""
        there = set(files)
        self._readings = {
            key: reading for key, reading in self._readings.items() if not (there.isdisjoint(key[1]) and reading.done())
        }

    def _work(self) -> None:
        while True:
            future, read = self._tasks.get()
            try:
                future.set_result(read())
            except BaseException as error:  # readers of other packages raise what they like
                future.set_exception(error)
