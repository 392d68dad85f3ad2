"""Temporary folders that go with the process that made them, also where it is killed: its workers remove them then."""

from __future__ import annotations

import functools
import os
import tempfile
from pathlib import Path


def temporary_folder(what: str) -> tempfile.TemporaryDirectory[str]:
    """Return a new folder, `what` in its name, that is removed when it is closed or forgotten, or this process ends."""
    return tempfile.TemporaryDirectory(prefix=f"{what}-", dir=process_folder())


def process_folder() -> str:
    """Return the folder in which all those of this process are."""
    return _process_folder(os.getpid()).name  # a process that was forked has one of its own


@functools.cache
def _process_folder(_: int) -> tempfile.TemporaryDirectory[str]:
    folder = tempfile.TemporaryDirectory(prefix="servoscope-", ignore_cleanup_errors=True)
    Path(folder.name).chmod(0o711)  # a worker with another user's rights passes through it to a folder of its own
    return folder
