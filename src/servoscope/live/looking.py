"""Full diagnoses in a process of their own: seconds of work that would otherwise hold up the samples of all assets."""

from __future__ import annotations

import json
import os
import pickle
import struct
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import IO, Any

from servoscope.baseline import Baseline
from servoscope.live.block import Block
from servoscope.live.examining import Told, diagnose_in_full
from servoscope.live.logs import log

__all__ = ["Looker"]

LENGTH = struct.Struct("<Q")
NICE = 5  # samples come first
TRIES = 2  # of a diagnosis that takes its process down with it
PROGRAM = "from servoscope.live.looking import look; look()"


class Looker:
    """Makes full diagnoses, one after the other.

    Its process reads jobs from a pipe, and ends when that does: with the service, however the service ends.
    """

    def __init__(self) -> None:
        self._one = ThreadPoolExecutor(1, "full-diagnosis")  # waits for answers
        self._process: subprocess.Popen[bytes] | None = None
        self._closed = False

    def submit(self, baseline: Baseline, name: str, blocks: Sequence[Block]) -> Future[Told]:
        """Ask for the diagnosis of a window."""
        return self._one.submit(self._ask, baseline, name, list(blocks))

    def close(self) -> None:
        """Stop; what is under way is dropped."""
        self._closed = True
        self._end()
        self._one.shutdown(wait=True, cancel_futures=True)
        self._end()

    def _ask(self, baseline: Baseline, name: str, blocks: list[Block]) -> Told:
        text = json.dumps(baseline.model_dump(mode="json", by_alias=True))
        job = pickle.dumps((text, name, [(block.sequence, block.pack()) for block in blocks]))
        for _ in range(TRIES):
            if self._closed:
                break
            process = self._running()
            assert process.stdin is not None and process.stdout is not None, "both are pipes"
            try:
                _send(process.stdin, job)
                return Told(*pickle.loads(_receive(process.stdout)))
            except (OSError, EOFError):
                if self._closed:  # on purpose, then
                    break
                log("error", "full diagnosis lost its process", asset=name, code=process.poll())
                self._end()
        return Told("undetermined", "Undetermined: the full diagnosis took its process down.", None, {})

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            command = [sys.executable, "-c", PROGRAM]
            # a session of its own: Ctrl-C in a terminal is for the service, which then ends it
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
            )
        return self._process

    def _end(self) -> None:
        process = self._process
        if process is None:
            return
        self._process = None
        process.kill()
        process.wait()
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                stream.close()


def look() -> None:
    """Answer jobs from stdin on stdout until there are no more; what runs in the process of its own."""
    os.nice(NICE)
    jobs, answers = sys.stdin.buffer, os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # whatever prints must not get between the answers
    known: dict[str, Baseline] = {}
    while True:
        try:
            text, name, packed = pickle.loads(_receive(jobs))
        except EOFError:
            return
        if text not in known:
            known[text] = Baseline.model_validate(json.loads(text))
        blocks = [Block.unpack(name, *one) for one in packed]
        _send(answers, pickle.dumps(tuple(diagnose_in_full(known[text], name, blocks))))


def _send(stream: IO[bytes], message: bytes) -> None:
    stream.write(LENGTH.pack(len(message)) + message)
    stream.flush()


def _receive(stream: IO[bytes]) -> bytes:
    head = _exactly(stream, LENGTH.size)
    return _exactly(stream, LENGTH.unpack(head)[0])


def _exactly(stream: IO[bytes], size: int) -> bytes:
    found: Any = stream.read(size)
    if len(found) < size:
        raise EOFError
    return bytes(found)
