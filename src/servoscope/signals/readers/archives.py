"""Recordings in archives, folders and globs: which files are meant, and what is inside of packed ones."""

from __future__ import annotations

import functools
import gzip
import lzma
import re
import weakref
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, TypeVar

from servoscope.core.errors import RecordingError
from servoscope.core.temporary import temporary_folder
from servoscope.signals.readers.addresses import is_address
from servoscope.signals.readers.table import (
    MAX_UNPACKED_RATIO,
    MIN_UNPACKED_LIMIT_BYTES,
    Table,
    TableFile,
    shorten_error,
)

_T = TypeVar("_T")

GZIP, ZIP = ".gz", ".zip"
ARCHIVES = (GZIP, ZIP)
ACCOMPANYING_FILES = re.compile(
    r"(?:^|/)(?:read\W?me|lies\W?mich|lisez\W?moi|licen[cs]e|notes?)\b[^/]*$|\.(?:md|pdf|rtf|docx?|png|jpe?g)$", re.I
)
MAX_UNPACKED_BYTES = 8_000_000_000  # of one file when it is unpacked


def expand_paths(paths: Sequence[Path], suffixes: Collection[str], what: str = "recordings") -> list[Path]:
    """Return the files that are meant by files, folders, globs and archives of several files, in order of their names.

    Raises RecordingError if a folder or an archive holds none, or a pattern meets none.
    """
    expanded: list[Path] = []
    for path in paths:
        if is_address(path):
            expanded.append(path)
        elif path.is_dir():
            files = sorted(entry for entry in path.iterdir() if entry.is_file() and entry.suffix.lower() in suffixes)
            if not files:
                raise RecordingError(f"{path}: holds no {what}; readable are {', '.join(suffixes)}")
            expanded += expand_paths(files, suffixes, what)
        elif any(sign in str(path) for sign in "*?[") and not path.exists():
            root = Path(path.anchor) if path.is_absolute() else Path()
            files = sorted(root.glob(str(path.relative_to(root))))
            if not files:
                raise RecordingError(f"{path}: no file has such a name, check the pattern")
            expanded += expand_paths(files, suffixes, what)
        elif path.suffix.lower() == ZIP and path.is_file():
            members = list_members(path)
            expanded += [path / member for member in members] if len(members) > 1 else [path]
        else:
            expanded.append(path)
    return expanded


def archive_of(path: Path) -> tuple[Path, str] | None:
    """Return the archive that a path leads into, and the name inside, empty for its only file; None: it is none."""
    if path.suffix.lower() in ARCHIVES and path.is_file():
        return path, ""
    for parent in path.parents:
        if parent.suffix.lower() == ZIP and parent.is_file():
            return parent, path.relative_to(parent).as_posix()
    return None


def list_members(path: Path) -> list[str]:
    """Return the names of the files in an archive; raises RecordingError if it is damaged."""
    return list(_open_archive(path)[1])


def _open_archive(path: Path) -> tuple[zipfile.ZipFile, list[str]]:
    """Return an archive and the names of its files; raises RecordingError if it is damaged."""
    try:
        stat_result = path.stat()
        return _open_version(path, stat_result.st_mtime_ns, stat_result.st_size)
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise RecordingError(f"{path}: is a damaged ZIP archive ({shorten_error(error)}), pack it again") from None


@functools.lru_cache(maxsize=1)  # its directory is not read again for each of its thousands of files
def _open_version(path: Path, _changed: int, _size: int) -> tuple[zipfile.ZipFile, list[str]]:
    archive = zipfile.ZipFile(path)
    names = [info.filename for info in archive.infolist() if not info.is_dir()]
    names = sorted(name for name in names if not name.rpartition("/")[2].startswith((".", "_")))
    # what is beside a log: a text that describes it, its pictures
    logs = [name for name in names if not ACCOMPANYING_FILES.search(name)]
    return archive, logs or names


def unpack(path: Path, open_plain: Callable[[Path], TableFile]) -> TableFile:
    """Open a file in an archive by way of a temporary file, which is removed with what is returned.

    Raises RecordingError if the archive is damaged, holds several files, or its file is improbably large.
    """
    place = archive_of(path)
    assert place is not None, "the caller has asked"
    archive, member = place
    folder = temporary_folder("unpacked")
    try:
        if archive.suffix.lower() == GZIP:
            inside = Path(folder.name) / (archive.stem or "log.csv")
            with gzip.open(archive) as source:
                _copy(source, inside, path, archive.stat().st_size)
        else:
            opened, names = _open_archive(archive)
            if not member and len(names) != 1:
                shown = ", ".join(f"{archive.name}/{name}" for name in names[:3]) or "none"
                raise RecordingError(f"{path}: holds {len(names)} files, name one of them: {shown}")
            name = member or names[0]
            if name not in names:
                raise RecordingError(f"{path}: {archive.name} holds no {name}, but {', '.join(names[:5])}")
            inside = Path(folder.name) / (Path(name).name or "log.csv")
            with opened.open(name) as packed:
                _copy(packed, inside, path, opened.getinfo(name).compress_size)
        table = _renamed(path, inside, lambda: open_plain(inside))
    except RecordingError:
        folder.cleanup()
        raise
    # a library of others unpacks: it raises nearly anything at damaged archives, also for a password
    except (zipfile.BadZipFile, OSError, EOFError, zlib.error, lzma.LZMAError, ValueError, RuntimeError) as error:
        folder.cleanup()
        raise RecordingError(f"{path}: cannot be unpacked ({shorten_error(error)}), pack it again") from None

    def read_chunks(wanted: Sequence[str], texts: Collection[str]) -> Iterator[Table]:
        chunks = table.tables(wanted, texts)
        while (chunk := _renamed(path, inside, lambda: next(chunks, None))) is not None:
            yield chunk

    unpacked = replace(table, path=path, read_chunks=read_chunks)
    weakref.finalize(unpacked, folder.cleanup)
    return unpacked


def _copy(source: IO[bytes] | gzip.GzipFile, target: Path, path: Path, packed: int) -> None:
    most = min(MAX_UNPACKED_BYTES, max(MIN_UNPACKED_LIMIT_BYTES, MAX_UNPACKED_RATIO * packed))
    with target.open("wb") as file:
        while piece := source.read(1 << 20):
            file.write(piece)
            if file.tell() > most:
                raise RecordingError(f"{path}: is larger than {most / 1e6:.0f} MB when unpacked, unpack it yourself")


def _renamed(path: Path, inside: Path, read: Callable[[], _T]) -> _T:
    """Call a function whose errors name the temporary file; they name the archive then."""
    try:
        return read()
    except RecordingError as error:
        text = str(error).replace(str(inside), str(path)).replace(str(inside.parent), str(path))
        raise type(error)(text) from None
