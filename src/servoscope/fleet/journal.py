"""Finished items, one line each, in a file that survives a crash: nothing is lost, nothing counted twice."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from servoscope.core.errors import OutputError
from servoscope.core.files import make_folder
from servoscope.fleet.lake import AssetDay

FORMAT, VERSION = "servoscope-fleet", 1


class Journal:
    """The results of finished items; made by `open_journal`."""

    def __init__(self, file: IO[bytes], entries: dict[tuple[str, str], dict[str, Any]]) -> None:
        self._file, self._entries = file, entries

    def is_examined(self, item: AssetDay) -> bool:
        """Return whether an item was examined as its files are now."""
        entry = self._entries.get(item.key)
        return entry is not None and entry["stamp"] == item.stamp and entry["status"] == "examined"

    def add(self, entry: dict[str, Any]) -> None:
        """Add a finished item; once this returns, it is on disk."""
        self._file.write(json.dumps(entry, allow_nan=False).encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())
        self._entries[entry["asset"], entry["day"]] = entry

    def entries(self) -> list[dict[str, Any]]:
        """Return the last result of each item, by asset and day in order."""
        return [self._entries[key] for key in sorted(self._entries)]


@contextmanager
def open_journal(path: Path, provenance: dict[str, Any]) -> Iterator[Journal]:
    """Open a journal, new or existing; a line that a crash left half-written is cut off: its item is not finished.

    `provenance`: what all results in it depend on.

    Raises OutputError if it belongs to other settings, is in use, or cannot be written.
    """
    import fcntl

    make_folder(path.parent)
    head = json.loads(json.dumps({"format": FORMAT, "version": VERSION, **provenance}))
    try:
        file = path.open("a+b")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise OutputError(f"{path}: another run writes to it: wait for it, or give another folder") from None
        file.seek(0)
        content = file.read()
        complete, _, torn = content.rpartition(b"\n")
        if torn:
            file.truncate(len(content) - len(torn))
        lines = [json.loads(line) for line in complete.splitlines()]
        if lines and lines[0] != head:
            changed = sorted(key for key in {*head, *lines[0]} if head.get(key) != lines[0].get(key))
            raise OutputError(f"{path}: belongs to a run with another {', '.join(changed)}: give another folder")
        if not lines:
            file.write(json.dumps(head).encode() + b"\n")
        yield Journal(file, {(entry["asset"], entry["day"]): entry for entry in lines[1:]})
