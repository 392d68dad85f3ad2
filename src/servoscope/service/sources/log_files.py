"""Log files of a folder: which asset and time their names say, and the rows in them by asset."""

from __future__ import annotations

import fnmatch
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple
from zoneinfo import ZoneInfo

import numpy as np
from pydantic import Field

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import ConfigError, OutputError, RecordingError, ServoscopeError
from servoscope.core.files import atomic_write
from servoscope.core.settings import NonEmptyStr
from servoscope.models.loop import Loop
from servoscope.service.log import log
from servoscope.service.sources.settings import SourceSettings
from servoscope.signals.readers.reader_process import answered_error, error_answer, run_restricted
from servoscope.signals.readers.recording_file import first_time, read_log
from servoscope.signals.samples import Samples

TEMPORARY_NAMES = ("*.part", "*.filepart", "*.tmp", "*.crdownload", "~$*", ".*")
MIN_EPOCH_S = 1e8  # time stamps from 1973 on are dates; smaller ones count from the beginning of a file
NAME_PARTS = re.compile(r"(\{asset\}|\{time\}|\*)")
TIME_FORMATS = {8: "%Y%m%d", 10: "%Y%m%d%H", 12: "%Y%m%d%H%M", 14: "%Y%m%d%H%M%S"}  # by how many digits there are


class FolderNames(SourceSettings):
    """Which files of a folder are read, and of which asset they are."""

    # which files in it: ``*`` stands for anything but ``/``, ``{asset}`` for an asset, ``{time}`` for the date and time
    # of the first row
    match: NonEmptyStr = "*"
    ignore: tuple[NonEmptyStr, ...] = TEMPORARY_NAMES  # names of files that are not complete
    asset_column: NonEmptyStr | None = None  # the column that names the asset of a row, where files hold several
    called: dict[NonEmptyStr, NonEmptyStr] = Field(default_factory=dict)  # by asset, what files call it


class FileVersion(NamedTuple):
    """What tells that a file has changed."""

    size: int
    modified_ns: int


class LogFile(NamedTuple):
    """A file in the folder whose name matches."""

    name: str  # relative to the folder, with /
    asset: str  # by its name; empty: a column names assets
    time: str  # of its first row, by its name; empty: the name does not say
    version: FileVersion
    changed_at: float  # when it was written, or put there [UTC s]

    @property
    def modified_at(self) -> float:
        """When it was written [UTC s]."""
        return self.version.modified_ns / 1e9


class IncompleteFile(NamedTuple):
    """A file of which nobody knows yet whether it is complete; by the monotonic clock [s]."""

    version: FileVersion
    unchanged_since: float
    seen_since: float


class HandedFiles:
    """The files that were handed over and are not dealt with, noted in a file: rows of theirs alone may be counted.

    `path`: None where nothing can be noted.
    """

    def __init__(self, path: Path | None) -> None:
        self._path, self._noted = path, dict[str, FileVersion]()
        self._before: dict[str, FileVersion] | None = None  # of an earlier process; None: nobody knows
        if path is not None:
            try:
                noted = json.loads(path.read_bytes()) if path.exists() else {}
                self._before = {str(name): FileVersion(*version) for name, version in noted.items()}
            except (OSError, ValueError, TypeError, AttributeError):
                log("warning", "files in hand cannot be read", file=str(path))

    def may_be_counted(self, file: LogFile) -> bool:
        """Whether an earlier process may have counted rows of a file that lay there at first."""
        return self._before is None or self._before.get(file.name) == file.version

    def note(self, files: Iterable[LogFile]) -> None:
        """Note the files that are handed over from now on, and those that are in hand, of an earlier process too."""
        noted = {**(self._before or {}), **{file.name: file.version for file in files}}
        if self._path is None or noted == self._noted:
            return
        try:
            atomic_write(self._path, json.dumps(noted).encode())
        except OutputError as error:
            log("warning", "files in hand cannot be noted", why=str(error))
        self._noted = noted


class FileRows(NamedTuple):
    """The rows of an asset in a file."""

    samples: Samples
    offset: float  # what makes seconds since 1970 of their time stamps [s]


@dataclass
class ReadFile:
    """A file that was read."""

    file: LogFile
    rows: Mapping[str, FileRows]  # by asset
    is_new: bool  # whether it came while we looked
    is_failed: bool  # whether its rows are of no use, or late
    is_refused: bool = False  # whether rows were refused, and have to come again
    is_released: bool = False  # whether all its rows are stored, or were refused


class FileNames:
    """Which files belong to which asset, as `match` says."""

    def __init__(self, settings: FolderNames, assets: Sequence[str]) -> None:
        if strange := set(settings.called) - set(assets):
            raise ConfigError(f"called: there is no asset {min(strange)!r} of this source")
        self.assets = {settings.called.get(name, name): name for name in assets}
        if len(self.assets) < len(assets):
            raise ConfigError("called: two assets of this source are called the same")
        named, by_column = "{asset}" in settings.match, settings.asset_column is not None
        if named == by_column and (named or len(assets) > 1):
            raise ConfigError("match: write {asset} where the name says which asset a file is of, or give asset_column")
        if settings.match.count("{asset}") > 1 or settings.match.count("{time}") > 1 or settings.match[0] == "/":
            raise ConfigError("match: a path in the folder, as {asset}/*.csv, with {asset} and {time} once at most")
        self._only = "" if by_column or not assets else next(iter(assets))
        called = "|".join(re.escape(name) for name in sorted(self.assets, key=len, reverse=True))
        parts = {"{asset}": f"(?P<asset>{called})", "{time}": r"(?P<time>\d[\d T_.:-]*)", "*": "[^/]*"}
        self._regex = re.compile("".join(parts.get(part, re.escape(part)) for part in NAME_PARTS.split(settings.match)))
        self._ignored = settings.ignore
        self.depth = settings.match.count("/")  # of folders in the folder

    def match(self, name: str) -> tuple[str, str] | None:
        """Return the asset and the time that a name says, empty where it says none; None: it is another file's."""
        match = self._regex.fullmatch(name)
        if match is None or any(fnmatch.fnmatch(name.rpartition("/")[2], pattern) for pattern in self._ignored):
            return None
        groups = match.groupdict(default="")
        return self.assets[groups["asset"]] if "asset" in groups else self._only, groups.get("time", "")


Parsed = tuple[dict[str, FileRows], dict[str, str]]  # rows by asset; of which assets they cannot be used, and why


def parse_files(
    folder: Path, files: Sequence[LogFile], names: FileNames, settings: FolderNames, loop_of: Mapping[str, Loop]
) -> list[Parsed | ServoscopeError]:
    """Return what each of some files holds, or why it cannot be read; in one exchange with a restricted process.

    Raises RecordingError if one of them ended that process, OutputError where there is no room.
    """
    loops = dict(loop_of)
    if all(file.asset for file in files):
        loops = {file.asset: loop_of[file.asset] for file in files}
    path, size = folder / (files[0].name if len(files) == 1 else ""), sum(file.version.size for file in files)
    about, columns = run_restricted(
        (folder,), path, size, f"{__name__}:pack_files", folder, list(files), names, settings, loops
    )
    others = iter(columns)
    return [_unpack_file(described, others) for described in about]


def parse_file(
    folder: Path, file: LogFile, names: FileNames, settings: FolderNames, loop_of: Mapping[str, Loop]
) -> Parsed:
    """Return the rows of a file by asset, and of which assets they cannot be used, and why; in a restricted process.

    Raises RecordingError if the file cannot be read.
    """
    (parsed,) = parse_files(folder, [file], names, settings, loop_of)
    if isinstance(parsed, ServoscopeError):
        raise parsed
    return parsed


def _unpack_file(about: dict[str, Any], columns: Iterator[FloatArray]) -> Parsed | ServoscopeError:
    if "error" in about:
        return answered_error(about)
    rows = dict[str, FileRows]()
    for name, offset, channels in about["rows"]:
        t, r, u, y, restart = (next(columns) for _ in range(5))
        carried = {channel: next(columns) for channel in channels}
        rows[str(name)] = FileRows(Samples.from_columns(t, r, u, y, restart, carried), float(offset))
    return rows, about["failures"]


def pack_files(
    folder: Path, files: Sequence[LogFile], names: FileNames, settings: FolderNames, loop_of: Mapping[str, Loop]
) -> tuple[list[dict[str, Any]], list[FloatArray]]:
    """Return what `extract_rows` finds in each of some files, as `run_restricted` takes it."""
    about, columns = list[dict[str, Any]](), list[FloatArray]()
    for file in files:
        loops = {file.asset: loop_of[file.asset]} if file.asset else loop_of
        try:
            rows, failures = extract_rows(folder, file, names, settings, loops)
        except ServoscopeError as error:
            about.append(error_answer(error))
            continue
        columns += [x for own in rows.values() for x in (*own.samples.columns, *own.samples.channels.values())]
        told = [(name, own.offset, list(own.samples.channels)) for name, own in rows.items()]
        about.append({"rows": told, "failures": failures})
    return about, columns


def extract_rows(
    folder: Path, file: LogFile, names: FileNames, settings: FolderNames, loop_of: Mapping[str, Loop]
) -> Parsed:
    """Do what `parse_file` does, in this process."""
    rows, failures, path = dict[str, FileRows](), dict[str, str](), folder / file.name
    loops = {loop.hash(): loop for loop in loop_of.values()}
    for key, loop in loops.items():
        logged = read_log(path, loop, settings.asset_column)
        for called, part in logged.parts.items():
            name = file.asset or names.assets.get(called, "")
            if not name or loop_of[name].hash() != key:
                continue
            try:
                samples = part.samples()
            except RecordingError as error:
                failures[name] = str(error)
                continue
            first, last = samples.t[[0, -1]].tolist()
            offset = logged.origin
            if first + offset < MIN_EPOCH_S:  # it says how much time has passed, and not since when
                named = _named_time(file.time, loop)
                offset = file.modified_at - last if named is None else named - first
            rows[name] = FileRows(samples, offset)
    return {name: rows[name] for name in loop_of if name in rows}, failures


def _named_time(text: str, loop: Loop) -> float | None:
    """Return the time that a file's name says [UTC s], local where the loop's columns are; None: it says none."""
    digits = re.sub(r"\D", "", text)[:14]
    zone = ZoneInfo(loop.columns.time_zone) if loop.columns.time_zone else UTC
    try:
        return datetime.strptime(digits, TIME_FORMATS[len(digits)]).replace(tzinfo=zone).timestamp()
    except (KeyError, ValueError):
        return None


def find_first_time(folder: Path, file: LogFile, loop: Loop) -> float:
    """Return the time of the first row [UTC s], as the file says it, read in a restricted process, or its name or date.

    Raises RecordingError if it cannot be read.
    """
    path = folder / file.name
    _, (first,) = run_restricted((folder,), path, file.version.size, f"{__name__}:pack_first_time", path, loop)
    t = float(first[0])
    return t if t >= MIN_EPOCH_S else told_time(file, loop)


def pack_first_time(path: Path, loop: Loop) -> tuple[None, list[FloatArray]]:
    """Return the first time stamp of a file, as `run_restricted` takes it."""
    return None, [np.array([first_time(path, loop)])]


def told_time(file: LogFile, loop: Loop) -> float:
    """Return the time of the first row [UTC s] as the name of a file says it, or its date."""
    return _named_time(file.time, loop) or file.modified_at


def describe_error(error: Exception) -> str:
    """Return what a file's reader raised, in one line."""
    return str(error) if isinstance(error, ServoscopeError) else f"{type(error).__name__}: {error}"
