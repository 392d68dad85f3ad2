"""A folder that others may write to: its files are opened and moved by descriptors, and no link in it is followed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

FOLDER_FLAGS = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
NEW_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
START_BYTES, NO_TEXT = 4096, (b"\0", b"\x89", b"\xff")  # of a file's start: bytes that logs in text do not have


class Share:
    """A folder by its path, which may be a link itself; names in it are relative, with ``/``."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @contextmanager
    def folder(self, name: str, *, make: bool = False) -> Iterator[int]:
        """Yield the descriptor of a folder in it, made if it is missing; raises OSError, also where one is a link."""
        opened = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            for part in filter(None, name.split("/")):
                if make:
                    with suppress(FileExistsError):
                        os.mkdir(part, dir_fd=opened)
                above, opened = opened, os.open(part, FOLDER_FLAGS, dir_fd=opened)
                os.close(above)
            yield opened
        finally:
            os.close(opened)

    @contextmanager
    def file(self, name: str) -> Iterator[int]:
        """Yield the descriptor of a file to read; raises OSError, also where it or a folder above it is a link."""
        place, _, last = name.rpartition("/")
        with self.folder(place) as folder:
            opened = os.open(last, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=folder)
        try:
            yield opened
        finally:
            os.close(opened)

    def stat(self, name: str) -> os.stat_result:
        """Return what is known of a file; of a link, of itself."""
        place, _, last = name.rpartition("/")
        with self.folder(place) as folder:
            return os.stat(last, dir_fd=folder, follow_symlinks=False)

    def ends_within_line(self, name: str) -> bool:
        """Whether a file is a text whose last line has no end yet."""
        with self.file(name) as opened:
            size = os.fstat(opened).st_size
            start, end = os.pread(opened, START_BYTES, 0), os.pread(opened, 1, max(0, size - 1))
        return bool(end) and end not in b"\r\n" and not any(byte in start for byte in NO_TEXT)

    def move(self, name: str, target: str, other: str) -> None:
        """Rename a file within it, to the name `other` in the folder of `target` if that is taken; replaces nothing.

        Raises OSError, also where one of the folders is a link.
        """
        (place, _, last), (aim, _, wanted) = name.rpartition("/"), target.rpartition("/")
        with self.folder(place) as source, self.folder(aim, make=True) as destination:
            for candidate in (wanted, other):
                try:  # a file of our own, which the rename may replace
                    taken = os.open(candidate, NEW_FLAGS, 0o600, dir_fd=destination)
                except FileExistsError:
                    if candidate == other:
                        raise
                    continue
                os.close(taken)
                try:
                    os.rename(last, candidate, src_dir_fd=source, dst_dir_fd=destination)
                except BaseException:
                    os.unlink(candidate, dir_fd=destination)
                    raise
                return
