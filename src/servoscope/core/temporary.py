"""Temporary folders that go with the process that made them, also where it is killed: its workers remove them then."""

from __future__ import annotations

import functools
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

_place: ContextVar[str | None] = ContextVar("place", default=None)  # within `temporary_folders_in`


def temporary_folder(what: str) -> tempfile.TemporaryDirectory[str]:
    """Return a new folder, `what` in its name, that is removed when it is closed or forgotten, or this process ends."""
    return tempfile.TemporaryDirectory(prefix=f"{what}-", dir=_place.get() or process_folder())


@contextmanager
def temporary_folders_in(folder: str) -> Iterator[None]:
    """Make temporary folders in a folder for a while, whose owner removes what a process that is killed leaves."""
    before = _place.set(folder)
    try:
        yield
    finally:
        _place.reset(before)


def process_folder() -> str:
    """Return the folder in which all those of this process are."""
    return _process_folder(os.getpid()).name  # a process that was forked has one of its own


@functools.cache
def _process_folder(_: int) -> tempfile.TemporaryDirectory[str]:
    folder = tempfile.TemporaryDirectory(prefix="servoscope-", ignore_cleanup_errors=True)
    Path(folder.name).chmod(0o711)  # a worker with another user's rights passes through it to a folder of its own
    return folder
