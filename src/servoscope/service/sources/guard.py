"""The message in hand, noted in a file: one that hung or killed the process is known after its end, and tried first."""

from __future__ import annotations

import mmap
import os
from contextlib import closing
from pathlib import Path
from typing import Any

from servoscope.core.errors import MessageError, OutputError
from servoscope.core.files import atomic_write
from servoscope.core.workers import ProcessLimits, WorkerError, Workers
from servoscope.service.log import log

TRIAL_S = 10.0  # for one message in a process of its own; the largest that is accepted takes a second
TRIAL_LIMITS = ProcessLimits(cpu_s=60.0, memory_mb=4000.0)
MAX_SUSPECTS = 63  # that are remembered; the oldest gives way
MARK_BYTES = 8


class MessageGuard:
    """Tries messages that an earlier process had in hand when it ended, before they are decoded in this one.

    Its file holds marks of messages, which are not 0, in 8 bytes each: first that of the message in hand, then those of
    suspects. It is mapped into memory, so that a mark costs no call of the system and survives ``kill -9``. A suspect
    is decoded in a process with limits; only one that exceeds them is set aside, in a file of its own.

    Parameters
    ----------
    path
        The file. Raises OSError if it cannot be written.
    task, arguments
        What a worker runs to decode a message: the task takes these arguments, the message's address and its content.
    """

    def __init__(self, path: Path, task: str, *arguments: Any) -> None:
        self._path, self._task = path, (task, *arguments)
        size = (1 + MAX_SUSPECTS) * MARK_BYTES
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            # written, so that it has its place on the disk: a page without one ends the process when the disk is full
            os.pwrite(file, os.pread(file, size, 0).ljust(size, b"\0"), 0)
            self._marks = memoryview(mmap.mmap(file, size)).cast("Q")
        finally:
            os.close(file)
        marks = [mark for mark in (*self._marks[1:], self._marks[0]) if mark]
        self._suspects = dict.fromkeys(marks[-MAX_SUSPECTS:])
        self._refusals: dict[int, MessageError] = {}
        self._write_suspects()
        self._marks[0] = 0

    def is_suspect(self, mark: int) -> bool:
        """Return whether a message has to be tried."""
        return mark in self._suspects and mark not in self._refusals

    def try_message(self, mark: int, address: str, content: bytes) -> None:
        """Decode a message in a process of its own, for seconds perhaps; what it comes to is known to `check`."""
        if why := self._try(address, content):
            self._refusals[mark] = self._set_aside(mark, address, content, why)
        else:
            del self._suspects[mark]
            self._write_suspects()

    def check(self, mark: int, address: str, content: bytes) -> None:
        """Try a message if it is a suspect; raises MessageError if it is set aside."""
        if self.is_suspect(mark):
            self.try_message(mark, address, content)
        if mark in self._refusals:  # it remains a suspect: until it is acknowledged it may come again
            raise self._refusals[mark]

    def begin(self, mark: int) -> None:
        """Note that a message is in hand."""
        self._marks[0] = mark

    def end(self) -> None:
        """Note that none is."""
        self._marks[0] = 0

    def _write_suspects(self) -> None:
        for k, mark in enumerate([*self._suspects, *[0] * (MAX_SUSPECTS - len(self._suspects))], 1):
            self._marks[k] = mark

    def _try(self, address: str, content: bytes) -> str:
        """Return why a message cannot be decoded within the limits; empty: it can, whatever comes of it."""
        with closing(Workers(TRIAL_LIMITS)) as workers:
            try:
                workers.run(*self._task, "", b"")  # imports what it needs, which may take its time
            except WorkerError as error:
                log("error", "no process to try a message in", why=str(error))
                return ""
            try:
                workers.run(*self._task, address, content, timeout_s=TRIAL_S)
            except WorkerError as error:
                return str(error)
        return ""

    def _set_aside(self, mark: int, address: str, content: bytes, why: str) -> MessageError:
        path = self._path.with_name(f"{self._path.name}.{mark:x}")
        try:
            atomic_write(path, content)
        except OutputError as error:
            log("error", "message cannot be kept", why=str(error))
        reason = f"{len(content)} bytes from {address[:100]!r} ended the service, and once more: {why}; kept as {path}"
        return MessageError("set aside", reason)
