"""Log files that fall into a folder: each is read when it is complete, in the order of time; each row counts once."""

from __future__ import annotations

import errno
import math
import os
import queue
import stat
import time
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import AwareDatetime

from servoscope.core.errors import OutputError
from servoscope.core.messages import message as text
from servoscope.core.messages import render
from servoscope.core.settings import NonEmptyStr
from servoscope.service.assets.reception import Reception
from servoscope.service.config_types import Seconds
from servoscope.service.sources.block import ResumePosition
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.log_decoder import LogDecoder
from servoscope.service.sources.log_files import (
    FileNames,
    FileRows,
    FileVersion,
    FolderNames,
    HandedFiles,
    IncompleteFile,
    LogFile,
    ReadFile,
    describe_error,
    parse_file,
)
from servoscope.service.sources.log_reader import LogReader
from servoscope.service.sources.message import (
    POLL_S,
    Backlog,
    InboxMessage,
    RejectionCounter,
    SourceAsset,
    ThreadTransport,
)
from servoscope.service.sources.share import Share

DONE, FAILED = "done", "failed"  # subfolders that files are moved to
MAX_CLOCK_DIFFERENCE_S = 3600.0  # between the file server and whoever writes the time stamps
MAX_COMPARED = 1000  # files whose first time stamps are compared with each other
MAX_HANDED_ROWS = 200_000  # rows of files that are read, and wait to be decoded
MAX_REMEMBERED = 10_000  # contents by which a file that comes again is recognised
MAX_CHANGE_S = 86400.0  # after which a file that was read is not looked at again
MAX_ANSWER_S = 30.0  # that a share may take to answer
IDLE_S = 0.2


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
        decoder = LogDecoder(self.block, partial(self.begin_times, assets), assets, rejections)
        return Inbox(FolderTransport(self, assets, folder / self.path), decoder, assets, rejections)

    def begin_times(self, assets: Iterable[str], resume: Mapping[str, ResumePosition]) -> dict[str, float]:
        """Return up to when the rows of each asset were counted, or are to be left out [UTC s]."""
        begin = time.time() if self.start == "now" else -math.inf
        if isinstance(self.start, datetime):
            begin = self.start.timestamp()
        return {name: resume[name].last_t if name in resume else begin for name in assets}


class FolderTransport(ThreadTransport):
    """Follows the files of some assets in a folder; a thread looks into it and reads, one file ahead.

    What was counted of an asset is known by the time of its last sample alone: a restart reads what may hold later
    rows, and leaves out the others. So does any file that repeats rows of another one.
    """

    def __init__(self, settings: FolderSettings, assets: Mapping[str, SourceAsset], folder: Path) -> None:
        super().__init__()
        self.settings, self._assets, self._folder = settings, assets, folder
        self._loops = {name: asset.loop for name, asset in assets.items()}
        self._share, self._names = Share(folder), FileNames(settings, list(assets))
        self._reader = LogReader(self._share, self._names, settings, self._loops, self._stop_event)
        self._resumed: dict[str, float] = {}  # by asset, up to when its rows had been counted [UTC s]
        self._began: frozenset[str] = frozenset()  # the assets of which some had been
        # of the thread: files that may still change, those that were dealt with, and those that lay there at first;
        # contents by their digest
        self._changing: dict[str, IncompleteFile] = {}
        self._settled: dict[str, FileVersion] = {}
        self._first_names: set[str] | None = None
        self._digests: dict[bytes, str] = {}
        self._handed_rows = self._taken_rows = 0  # so far
        self._handed, self._in_hand = HandedFiles(None), dict[str, LogFile]()
        self._trouble = render(text("service.trouble.connecting"))
        self._files_wait = True  # whether there are files that are complete, or soon will be
        # files whose rows are ahead of our clock, and until when they wait [UTC s]
        self._early: dict[str, tuple[FileVersion, float]] = {}
        self._unread = list[float]()  # since when files that are complete wait, by the monotonic clock [s]
        self._released = queue.SimpleQueue[ReadFile]()

    def open(self, resume: Mapping[str, ResumePosition]) -> None:
        """Look into the folder from now on."""
        self._handed = HandedFiles(self.state_file if self.settings.afterwards == "move" else None)
        self._resumed, self._began = self.settings.begin_times(self._assets, resume), frozenset(resume)
        super().open(resume)

    @property
    def connected(self) -> bool:  # type: ignore[override]
        """Whether the folder can be reached."""
        return not self.trouble

    @property
    def trouble(self) -> str:  # type: ignore[override]
        """Why the folder cannot be reached, in words; empty: nothing."""
        if time.monotonic() - self._reader.asked_at > MAX_ANSWER_S:
            return self._describe_trouble(os.strerror(errno.ETIMEDOUT))
        return self._trouble

    def _describe_trouble(self, reason: str) -> str:
        return render(text("service.trouble.unreachable", reason=f"{self._folder}: {reason}"))

    @property
    def backlog(self) -> Backlog:  # type: ignore[override]
        """The files that are complete and not yet stored."""
        since, handed = self._unread, len(self.waiting)
        begins = [*since[:1], *(message.at for message in list(self.waiting)[:1])]
        oldest_s = time.monotonic() - min(begins) if begins else 0.0
        words = text("service.folder.backlog", count=len(since) + handed, minutes=oldest_s / 60.0)
        return Backlog(len(since) + handed, oldest_s, render(words) if oldest_s > self.settings.interval_s else "")

    @property
    def pause_s(self) -> float:  # type: ignore[override]
        """How long an asset may pause [s]: without bound while files wait, or the folder cannot be reached."""
        return math.inf if self._files_wait or self.trouble else self.settings.interval_s

    def receive(self, most: int) -> Sequence[InboxMessage]:
        """Return up to so many files in the order in which they were read; at once."""
        messages = super().receive(most)
        self._taken_rows += sum(map(_count_rows, messages))
        return messages

    def preview(self) -> list[str]:
        """Return what it would read, and what it cannot."""
        try:
            files = sorted(self._find_files(), key=self._reader.order)
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
                is_crowded = len(self._unread) > MAX_COMPARED  # more were complete than were compared
                if time.monotonic() >= next_look or (is_crowded and not waiting):
                    waiting = deque(self._look())
                    next_look = time.monotonic() + self.settings.poll_s
                if waiting:
                    file = waiting.popleft()
                    if not self._read(file):  # nothing of its assets goes before it
                        held = {file.asset, ""} if file.asset else {other.asset for other in waiting}
                        waiting = deque(other for other in waiting if other.asset not in held)
                    self._unread = self._unread[1:]
                self._take_released()
            except (OSError, OutputError) as error:
                self._trouble = self._describe_trouble(getattr(error, "strerror", None) or str(error))
                waiting.clear()
            self._reader.asked_at = math.inf
            soon = time.monotonic() - self.settings.complete_after_s - 2.0 * self.settings.poll_s
            self._files_wait = bool(waiting) or any(file.seen_since > soon for file in self._changing.values())
            if not waiting:
                self._stop_event.wait(min(IDLE_S, self.settings.poll_s))

    def _find_files(self) -> Iterator[LogFile]:
        """Yield the files whose names match, without those that were dealt with; raises OSError."""
        folders = [("", self._names.depth)]
        while folders:
            place, depth = folders.pop()
            self._reader.asked_at = time.monotonic()
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
            version, until = self._early.get(file.name, (None, 0.0))
            if (version != file.version or time.time() >= until) and self._is_complete(file, now - since):
                complete.append(file)
        if self._first_names is None:
            self._first_names = set(changing)
        first = _take_turns(sorted(complete, key=lambda file: file.name))[:MAX_COMPARED]
        if len(first) > 1:
            self._reader.read_ahead(first)
        ordered = _take_turns(sorted(first, key=self._reader.order)) if len(first) > 1 else first
        self._changing, self._trouble = changing, ""
        self._early = {name: early for name, early in self._early.items() if name in changing}
        self._unread = sorted(changing[file.name].seen_since for file in complete)
        self._reader.retain(first)
        self._handed.note([*self._in_hand.values(), *first])
        return ordered

    def _is_complete(self, file: LogFile, unchanged_s: float) -> bool:
        """Whether nothing more is to be expected of a file; a last line without an end waits once more as long."""
        is_old = time.time() - file.changed_at > MAX_CLOCK_DIFFERENCE_S
        settled_s = unchanged_s + self.settings.complete_after_s * is_old
        if settled_s < self.settings.complete_after_s:
            return False
        try:
            return settled_s >= 2.0 * self.settings.complete_after_s or not self._share.ends_within_line(file.name)
        except OSError:  # what is wrong with it is told when it is read
            return True

    def _read(self, file: LogFile) -> bool:
        """Read a file that is complete, and hand it over; return whether it need not be waited for.

        Raises OSError, or OutputError where there is no room.
        """
        assets = [file.asset] if file.asset else list(self._assets)
        try:
            contents = self._reader.read(file)
        except FileNotFoundError:  # somebody has moved it
            return True
        except PermissionError as error:  # it may be open elsewhere: it is tried again
            refused = Reception("refused", f"{self._folder / file.name}: cannot be read ({error.strerror})")
            if self.asset_troubles.get(assets[0]) != refused:
                self.rejections.add(file.asset, "unreadable", refused.why)
            self.asset_troubles = {**self.asset_troubles, **dict.fromkeys(assets, refused)}
            return True
        if contents is None:
            return False
        digest, rows, failures, empty = contents
        if digest in self._digests:
            rows, failures, empty = {}, {}, ""
            why = render(text("service.folder.repeated", file=file.name, other=self._digests[digest]))
            self.rejections.add(file.asset, "repeated", why)
        if self._is_early(file, rows):
            return True
        self._changing.pop(file.name, None)
        self._settled[file.name], self._digests[digest] = file.version, file.name
        if len(self._digests) > MAX_REMEMBERED:
            del self._digests[next(iter(self._digests))]
        if empty:
            self.rejections.add(file.asset, "empty", empty)
        for why in dict.fromkeys(failures.values()):
            self.rejections.add(file.asset, "unreadable", why)
        kept = {
            name: asset_trouble for name, asset_trouble in self.asset_troubles.items() if name not in assets or not rows
        }
        self.asset_troubles = kept | {name: Reception("refused", why) for name, why in failures.items()}
        # of an asset that begins, what lay there is left out as its settings say
        was_handed = self._began.isdisjoint(assets) or self._handed.may_be_counted(file)
        is_new = file.name not in (self._first_names or ()) or not was_handed
        read = ReadFile(file, rows, is_new=is_new, is_failed=bool(failures))
        while self._handed_rows - self._taken_rows > MAX_HANDED_ROWS and not self._stop_event.wait(POLL_S):
            pass
        message = InboxMessage(file.name, read, time.monotonic(), partial(self._release, read))
        self._handed_rows += _count_rows(message)
        self._in_hand[file.name] = file
        self.waiting.append(message)
        return True

    def _is_early(self, file: LogFile, rows: Mapping[str, FileRows]) -> bool:
        """Whether a file has rows further ahead of our clock than allowed: it waits where it is until they are not.

        Rows that were counted with such times would make all rows of the next files late.
        """
        now = time.time()
        ends = {name: float(own.samples.t[-1]) + own.offset for name, own in rows.items()}
        early = {name: s for name in ends if (s := ends[name] - now - self._assets[name].ahead_s) > 0.0}
        if not early:
            self._early.pop(file.name, None)
            return False
        longest_s = max(early.values())
        why = render(text("service.folder.ahead", file=file.name, ahead_s=longest_s))
        if file.name not in self._early:
            for name in early:
                self.rejections.add(name, "ahead", why)
        self._early[file.name] = file.version, now + longest_s
        self.asset_troubles = {**self.asset_troubles, **dict.fromkeys(early, Reception("refused", why))}
        return True

    def _release(self, read: ReadFile) -> None:
        """Note that all rows of a file are stored, or were refused."""
        read.is_released = True
        self._released.put(read)

    def _take_released(self) -> None:
        """Move the files whose rows are all stored; one with rows that were ahead of our clock comes again."""
        while not self._released.empty():
            read = self._released.get()
            self._in_hand.pop(read.file.name, None)
            if read.is_refused:
                self._settled.pop(read.file.name, None)
                self._digests = {digest: name for digest, name in self._digests.items() if name != read.file.name}
            elif self.settings.afterwards == "move":
                self._move(read.file, FAILED if read.is_failed else DONE)

    def _move(self, file: LogFile, subfolder: str) -> None:
        try:
            about = self._share.stat(file.name)
            if (about.st_size, about.st_mtime_ns) != file.version or not stat.S_ISREG(about.st_mode):
                return  # it has grown, and is read again
            other = f"{about.st_mtime_ns}-{file.name.rpartition('/')[2]}"  # where there is one of that name
            self._share.move(file.name, f"{subfolder}/{file.name}", other)
        except OSError as error:
            why = f"{self._folder / file.name}: cannot be moved to {subfolder} ({error.strerror})"
            self.rejections.add(file.asset, "not moved", why)


def _count_rows(message: InboxMessage) -> int:
    read: ReadFile = message.content
    return sum(rows.samples.t.size for rows in read.rows.values())


def _take_turns(files: Iterable[LogFile]) -> list[LogFile]:
    """Return files so that each asset has its turn, those of one asset in the order in which they are."""
    turns: dict[int, list[LogFile]] = defaultdict(list)
    counts: dict[str, int] = defaultdict(int)
    for file in files:
        turns[counts[file.asset]].append(file)
        counts[file.asset] += 1
    return [file for turn in sorted(turns) for file in turns[turn]]
