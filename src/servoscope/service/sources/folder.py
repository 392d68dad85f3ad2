"""Log files that fall into a folder: each is read when it is complete, in the order of time; each row counts once."""

from __future__ import annotations

import errno
import hashlib
import heapq
import math
import os
import queue
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import AwareDatetime

from servoscope.core.errors import EmptyRecordingError, OutputError
from servoscope.core.messages import message as text
from servoscope.core.messages import render
from servoscope.core.settings import NonEmptyStr
from servoscope.service.assets.reception import Reception
from servoscope.service.config_types import Seconds
from servoscope.service.log import log
from servoscope.service.sources.block import Block, ResumePosition
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.log_files import (
    FileNames,
    FileRows,
    FileVersion,
    FolderNames,
    IncompleteFile,
    LogFile,
    ReadFile,
    describe_error,
    find_first_time,
    parse_file,
)
from servoscope.service.sources.message import (
    POLL_S,
    Content,
    Decoder,
    InboxMessage,
    RejectionCounter,
    SourceAsset,
    ThreadTransport,
)

DONE, FAILED = "done", "failed"  # subfolders that files are moved to
MAX_CLOCK_DIFFERENCE_S = 3600.0  # between the file server and whoever writes the time stamps
MAX_COMPARED = 1000  # files whose first time stamps are compared with each other
MAX_REMEMBERED = 10_000  # contents by which a file that comes again is recognised
MAX_CHANGE_S = 86400.0  # after which a file that was read is not looked at again
MAX_ANSWER_S = 30.0  # that a share may take to answer
IDLE_S = 0.2
PIECE_BYTES = 1 << 20


class FolderSettings(FolderNames):
    """A source of kind ``folder``."""

    kind: Literal["folder"]
    path: NonEmptyStr  # the folder, relative to the service file
    complete_after_s: Seconds = 10.0  # without a change for so long, a file is complete [s]
    poll_s: Seconds = 5.0  # time between two looks into the folder [s]
    interval_s: Seconds = 600.0  # longest time between two files of an asset [s]; silence is what lasts longer
    # where an asset begins of which nothing has been counted: with what lies there, now, or at a time
    start: Literal["beginning", "now"] | AwareDatetime = "beginning"
    afterwards: Literal["stay", "move"] = "stay"  # what becomes of files: ``move`` to ``done`` and ``failed``
    block: Seconds = 1.0  # length of a block [s]

    visit_changes: ClassVar[Mapping[str, Any]] = {"afterwards": "stay"}

    def identity(self, name: str) -> str:
        """Return what no other source may share: a folder whose files it moves."""
        return f"folder {self.path}" if self.afterwards == "move" else ""

    @property
    def pause_s(self) -> float:
        """How long an asset may pause without being silent [s]."""
        return self.interval_s

    @property
    def is_exclusive(self) -> bool:
        """Whether one process has to follow all its assets: one that moves a file takes it from the others."""
        return self.afterwards == "move"

    def carries(self, covariate: str, address: Any) -> bool:
        """Files have what the loop's columns name."""
        return True

    def create(self, name: str, assets: Mapping[str, SourceAsset], folder: Path) -> Inbox:
        """Return the source; raises ConfigError where nothing says of which asset a file is."""
        rejections = RejectionCounter()
        decoder = LogDecoder(self, assets, rejections)
        return Inbox(FolderTransport(self, assets, folder / self.path), decoder, assets, rejections)

    def begin_times(self, assets: Iterable[str], resume: Mapping[str, ResumePosition]) -> dict[str, float]:
        """Return up to when the rows of each asset were counted, or are to be left out [UTC s]."""
        begin = time.time() if self.start == "now" else -math.inf
        if isinstance(self.start, datetime):
            begin = self.start.timestamp()
        return {name: resume[name].last_t if name in resume else begin for name in assets}


class LogDecoder(Decoder):
    """Cuts the rows of files into blocks, those that were not counted before, whichever file they are in."""

    def __init__(
        self, settings: FolderSettings, assets: Mapping[str, SourceAsset], rejections: RejectionCounter
    ) -> None:
        self.settings, self._assets, self._rejections = settings, assets, rejections
        self._counted: dict[str, float] = {}  # by asset, up to when its rows are in blocks [UTC s]
        self._sequences: dict[str, int] = {}

    def open(self, resume: Mapping[str, ResumePosition]) -> None:
        """Begin; assets in `resume` continue behind the last row that was counted."""
        self._counted = self.settings.begin_times(self._assets, resume)
        self._sequences = {name: resume[name].sequence if name in resume else -1 for name in self._assets}

    def decode(self, message: InboxMessage) -> Content:
        """Return the blocks of the rows of a file that were not counted before, in the order of time."""
        read: ReadFile = message.content
        firsts = {name: self._first_new(name, rows) for name, rows in read.rows.items()}
        total = sum(rows.samples.t.size for rows in read.rows.values())
        new = total - sum(firsts.values())
        log("info", "file read", file=read.file.name, rows=total, new=new)
        if total and not new and read.is_new:
            why = render(text("service.folder.late", file=read.file.name))
            self._rejections.add(read.file.asset, "late", why)
        streams = (self._cut_asset(name, read.rows[name], first) for name, first in firsts.items())
        return Content(blocks=heapq.merge(*streams, key=lambda block: float(block.t[-1])))

    def _first_new(self, name: str, rows: FileRows) -> int:
        half_s = 0.5 / self._assets[name].loop.sample_rate
        return int(np.searchsorted(rows.samples.t, self._counted[name] + half_s - rows.offset, side="right"))

    def _cut_asset(self, name: str, rows: FileRows, first: int) -> Iterator[Block]:
        asset, samples = self._assets[name], rows.samples
        size = max(1, round(self.settings.block * asset.loop.sample_rate))
        channels = [samples.channels[covariate] for covariate in asset.covariates]
        for begin in range(first, samples.t.size, size):
            columns = (samples.t, samples.r, samples.u, samples.y, *channels)
            signals = np.stack([column[begin : begin + size] for column in columns])
            signals[0] += rows.offset
            self._sequences[name] += 1
            self._counted[name] = float(signals[0, -1])
            yield Block.from_signals(name, self._sequences[name], signals, time.monotonic())


class FolderTransport(ThreadTransport):
    """Follows the files of some assets in a folder; a thread looks into it and reads, one file ahead.

    What was counted of an asset is known by the time of its last sample alone: a restart reads what may hold later
    rows, and leaves out the others. So does any file that repeats rows of another one.
    """

    def __init__(self, settings: FolderSettings, assets: Mapping[str, SourceAsset], folder: Path) -> None:
        super().__init__()
        self.settings, self._assets, self._folder = settings, assets, folder
        self._loops = {name: asset.loop for name, asset in assets.items()}
        self._names = FileNames(settings, list(assets))
        self._resumed: dict[str, float] = {}  # by asset, up to when its rows had been counted [UTC s]
        # of the thread: files that may still change, those that were dealt with, and those that lay there at first;
        # contents by their digest; first time stamps [UTC s]
        self._changing: dict[str, IncompleteFile] = {}
        self._settled: dict[str, FileVersion] = {}
        self._first_names: set[str] | None = None
        self._digests: dict[bytes, str] = {}
        self._first_times: dict[tuple[str, FileVersion], float] = {}
        self._trouble = render(text("service.trouble.connecting"))
        self._asked_at = math.inf  # since when an answer of the share is waited for, by the monotonic clock [s]
        self._files_wait = True  # whether there are files that are complete, or soon will be
        self._stored = queue.SimpleQueue[ReadFile]()

    def open(self, resume: Mapping[str, ResumePosition]) -> None:
        """Look into the folder from now on."""
        self._resumed = self.settings.begin_times(self._assets, resume)
        super().open(resume)

    @property
    def connected(self) -> bool:  # type: ignore[override]
        """Whether the folder can be reached."""
        return not self.trouble

    @property
    def trouble(self) -> str:  # type: ignore[override]
        """Why the folder cannot be reached, in words; empty: nothing."""
        if time.monotonic() - self._asked_at > MAX_ANSWER_S:
            return self._describe_trouble(os.strerror(errno.ETIMEDOUT))
        return self._trouble

    def _describe_trouble(self, reason: str) -> str:
        return render(text("service.trouble.unreachable", reason=f"{self._folder}: {reason}"))

    @property
    def pause_s(self) -> float:  # type: ignore[override]
        """How long an asset may pause [s]: without bound while files wait, or the folder cannot be reached."""
        return math.inf if self._files_wait or self.trouble else self.settings.interval_s

    def preview(self) -> list[str]:
        """Return what it would read, and what it cannot."""
        try:
            files = sorted(self._find_files(), key=self._order)
        except OSError as error:
            return [self._describe_trouble(error.strerror or str(error))]
        lines = [f"{self._folder}: {len(files)} files match {self.settings.match}"]
        if "{asset}" in self.settings.match and (lacking := self._assets.keys() - {file.asset for file in files}):
            lines.append(f"no file of {', '.join(sorted(lacking))}")
        for file in files[:MAX_COMPARED]:
            try:
                parse_file(self._folder, file, self._names, self.settings, self._loops)
            except Exception as error:
                return [*lines, f"{file.name} cannot be read: {describe_error(error)}"]
        return [*lines, f"all can be read; the first is {files[0].name}"] if files else lines

    # What the thread does

    def _run(self) -> None:
        waiting, next_look = deque[LogFile](), 0.0
        while not self._stop_event.is_set():
            try:
                if time.monotonic() >= next_look:
                    waiting = deque(self._look())
                    next_look = time.monotonic() + self.settings.poll_s
                if waiting:
                    self._read(waiting.popleft())
                self._move_stored()
            except (OSError, OutputError) as error:
                self._trouble = self._describe_trouble(getattr(error, "strerror", None) or str(error))
                waiting.clear()
            self._asked_at = math.inf
            soon = time.monotonic() - self.settings.complete_after_s - 2.0 * self.settings.poll_s
            self._files_wait = bool(waiting) or any(file.seen_since > soon for file in self._changing.values())
            if not waiting:
                self._stop_event.wait(min(IDLE_S, self.settings.poll_s))

    def _find_files(self) -> Iterator[LogFile]:
        """Yield the files whose names match, without those that were dealt with; raises OSError."""
        folders = [("", self._names.depth)]
        while folders:
            place, depth = folders.pop()
            self._asked_at = time.monotonic()
            with os.scandir(self._folder / place) as entries:
                for entry in entries:
                    name = f"{place}{entry.name}"
                    # a link may lead to what the service may read, and whoever put it there may not
                    if depth and entry.is_dir(follow_symlinks=False) and name not in (DONE, FAILED):
                        folders.append((f"{name}/", depth - 1))
                    elif not depth and entry.is_file(follow_symlinks=False):
                        yield from self._match_entry(name, entry)

    def _match_entry(self, name: str, entry: os.DirEntry[str]) -> Iterator[LogFile]:
        says, settled = self._names.match(name), self._settled.get(name)
        if says is None or (settled and time.time() - settled.modified_ns / 1e9 > MAX_CHANGE_S):
            return
        try:
            about = entry.stat(follow_symlinks=False)
        except FileNotFoundError:  # moved meanwhile
            return
        version = FileVersion(about.st_size, about.st_mtime_ns)
        if version != settled:
            yield LogFile(name, *says, version, max(about.st_mtime, about.st_ctime))

    def _look(self) -> list[LogFile]:
        """Return the files that are complete and were not dealt with, in order; raises OSError."""
        complete, changing, now = list[LogFile](), dict[str, IncompleteFile](), time.monotonic()
        for file in self._find_files():
            assets = [file.asset] if file.asset else self._assets
            if file.changed_at + MAX_CLOCK_DIFFERENCE_S < min(self._resumed[name] for name in assets):
                self._settled[file.name] = file.version  # when it came, its rows were counted, or to be left out
                continue
            before = self._changing.get(file.name) or IncompleteFile(file.version, now, now)
            since = before.unchanged_since if before.version == file.version else now
            changing[file.name] = IncompleteFile(file.version, since, before.seen_since)
            is_old = time.time() - file.changed_at > MAX_CLOCK_DIFFERENCE_S
            if is_old or now - since >= self.settings.complete_after_s:
                complete.append(file)
        if self._first_names is None:
            self._first_names = set(changing)
        first = sorted(complete, key=lambda file: file.name)[:MAX_COMPARED]
        ordered = sorted(first, key=self._order) if len(first) > 1 else first
        self._changing, self._trouble = changing, ""
        return ordered

    def _order(self, file: LogFile) -> tuple[float, str]:
        """Return what files are sorted by: the first time stamp, and the name."""
        key = file.name, file.version
        if key not in self._first_times:
            self._asked_at, loop = time.monotonic(), self._assets[file.asset or next(iter(self._assets))].loop
            self._first_times[key] = find_first_time(self._folder / file.name, file, loop)
        return self._first_times[key], file.name

    def _read(self, file: LogFile) -> None:
        """Read a file that is complete, and hand it over; raises OSError, or OutputError where there is no room."""
        path, assets = self._folder / file.name, [file.asset] if file.asset else list(self._assets)
        self._first_times.pop((file.name, file.version), None)
        rows, failures = dict[str, FileRows](), dict[str, str]()
        try:
            digest = self._digest(file)
        except FileNotFoundError:  # somebody has moved it
            return
        except PermissionError as error:  # it may be open elsewhere: it is tried again
            refused = Reception("refused", f"{path}: cannot be read ({error.strerror})")
            if self.asset_troubles.get(assets[0]) != refused:
                self.rejections.add(file.asset, "unreadable", refused.why)
            self.asset_troubles = {**self.asset_troubles, **dict.fromkeys(assets, refused)}
            return
        if digest in self._digests:
            why = render(text("service.folder.repeated", file=file.name, other=self._digests[digest]))
            self.rejections.add(file.asset, "repeated", why)
        else:
            self._asked_at = math.inf  # how long it takes depends on its size
            try:
                rows, failures = parse_file(self._folder, file, self._names, self.settings, self._loops)
            except EmptyRecordingError as error:
                self.rejections.add(file.asset, "empty", str(error))
            except OutputError:
                raise
            except Exception as error:  # readers of other packages raise what they like
                failures = dict.fromkeys(assets, describe_error(error))
        about = path.stat()
        if (about.st_size, about.st_mtime_ns) != file.version or (failures and self._digest(file) != digest):
            return  # it has changed meanwhile, and is read when it is complete
        self._changing.pop(file.name, None)
        self._settled[file.name], self._digests[digest] = file.version, file.name
        if len(self._digests) > MAX_REMEMBERED:
            del self._digests[next(iter(self._digests))]
        for why in dict.fromkeys(failures.values()):
            self.rejections.add(file.asset, "unreadable", why)
        kept = {
            name: asset_trouble for name, asset_trouble in self.asset_troubles.items() if name not in assets or not rows
        }
        self.asset_troubles = kept | {name: Reception("refused", why) for name, why in failures.items()}
        is_new = file.name not in (self._first_names or ())
        read = ReadFile(file, rows, is_new, FAILED if failures else DONE)
        while self.waiting and not self._stop_event.wait(POLL_S):
            pass
        self.waiting.append(InboxMessage(file.name, read, time.monotonic(), partial(self._stored.put, read)))

    def _digest(self, file: LogFile) -> bytes:
        """Return what tells a file from others: its content, and what its name says; logs of machines at rest agree."""
        digest = hashlib.blake2b(f"{file.asset}\0{file.time}\0".encode(), digest_size=16)
        with (self._folder / file.name).open("rb") as content:
            while piece := content.read(PIECE_BYTES):
                self._asked_at = time.monotonic()
                digest.update(piece)
        return digest.digest()

    def _move_stored(self) -> None:
        """Move the files whose rows are all stored."""
        while not self._stored.empty():
            read = self._stored.get()
            if self.settings.afterwards == "stay":
                continue
            path, target = self._folder / read.file.name, self._folder / read.subfolder / read.file.name
            try:
                about = path.stat()
                if (about.st_size, about.st_mtime_ns) != read.file.version:
                    continue  # it has grown, and is read again
                target.parent.mkdir(parents=True, exist_ok=True)
                if target.exists():  # another one of that name
                    target = target.with_name(f"{about.st_mtime_ns}-{target.name}")
                path.rename(target)
            except OSError as error:
                why = f"{path}: cannot be moved ({error.strerror})"
                self.rejections.add(read.file.asset, "not moved", why)
