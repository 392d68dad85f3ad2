"""Work in other processes: a worker with limits, for what may fail or comes from strangers, and pools of equal ones.

A worker is told what to do in pickles and answers in lines of JSON, so that a file that takes over the worker that
reads it has no way into the process that asked. Where tasks are trusted and many, a pool of `concurrent.futures` is
enough.
"""

from __future__ import annotations

import importlib
import json
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from servoscope.core.cache_folders import replace_library_warnings
from servoscope.core.errors import ServoscopeError

Progress = Callable[[str], None]

WORKER_CODE = "from servoscope.core.workers import worker_main; worker_main()"
NICENESS = 5  # samples and pages come first
MAX_ANSWER_BYTES = 64 << 20
OPEN_FILES = 256  # of a process with limits


class WorkerError(ServoscopeError):
    """A task in another process failed, or the process did: it died, took too long or needed too much."""


@dataclass(frozen=True)
class ProcessLimits:
    """What one process may take."""

    cpu_s: float  # processor time [s]
    memory_mb: float  # address space [MB]
    file_mb: float = 500.0  # largest file that it writes [MB]

    def apply(self) -> None:
        """Bound this process: beyond its limits the kernel refuses, or ends it."""
        import resource

        for kind, limit in (
            (resource.RLIMIT_CPU, round(self.cpu_s)),
            (resource.RLIMIT_AS, round(self.memory_mb * 1e6)),
            (resource.RLIMIT_FSIZE, round(self.file_mb * 1e6)),
            (resource.RLIMIT_NOFILE, OPEN_FILES),
            (resource.RLIMIT_CORE, 0),
        ):
            hard = resource.getrlimit(kind)[1]
            limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
            # one second between the signal that can be ignored and the one that cannot
            grace = 1 if kind == resource.RLIMIT_CPU and hard != limit else 0
            resource.setrlimit(kind, (limit, limit + grace))


class Worker:
    """A process that runs one task after the other; it is started by the first one, and again after a failure.

    It ends with the process that started it, however that ends.

    Parameters
    ----------
    limits
        None: as much as it takes.
    folder, environment
        Where it runs, and its environment variables; None: those of this process.
    """

    def __init__(
        self,
        limits: ProcessLimits | None = None,
        *,
        folder: Path | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._limits, self._folder, self._environment = limits, folder, environment
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._stopped = False

    def run(
        self, function: str, *arguments: Any, progress: Progress = lambda _: None, timeout_s: float | None = None
    ) -> Any:
        """Run a function and return its result.

        Parameters
        ----------
        function
            ``"package.module:name"``. It is called with a callback for steps of its progress and the arguments, and
            returns what can be written as JSON.
        timeout_s
            How long it may take by the clock on the wall [s].

        Raises
        ------
        WorkerError
            If it failed, or needed more than its limits; the worker has ended then.
        """
        process, late = self._start(), threading.Event()

        def expire() -> None:
            late.set()
            _kill(process)

        timer = threading.Timer(threading.TIMEOUT_MAX if timeout_s is None else timeout_s, expire)
        timer.daemon = True
        timer.start()
        try:
            return self._exchange(process, (function, arguments), progress)
        except (EOFError, OSError, ValueError):  # it has ended, perhaps in the middle of an answer
            code = self._end(process)
        except BaseException:
            self._end(process)
            raise
        finally:
            timer.cancel()
        if late.is_set():
            raise WorkerError(f"it took more than {timeout_s:g} s, and was stopped")
        raise WorkerError(self._cause_of_death(code))

    def stop(self) -> None:
        """Stop for good, from any thread; a task that is running fails."""
        with self._lock:
            self._stopped = True
            process = self._process
        if process is not None:
            self._end(process)

    def _start(self) -> subprocess.Popen[bytes]:
        with self._lock:
            if self._stopped:
                raise WorkerError("it was stopped")
            if self._process is None:
                self._process = subprocess.Popen(
                    [sys.executable, "-c", WORKER_CODE],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    cwd=self._folder,
                    env=self._environment,
                    start_new_session=True,  # Ctrl-C in a terminal is for the parent, which then ends it
                )
                with suppress(OSError):  # a process that has died already is met by the task
                    _send(self._process, asdict(self._limits) if self._limits is not None else None)
            return self._process

    def _exchange(self, process: subprocess.Popen[bytes], task: tuple[str, tuple[Any, ...]], progress: Progress) -> Any:
        assert process.stdout is not None, "it is a pipe"
        _send(process, task)
        while line := process.stdout.readline(MAX_ANSWER_BYTES + 1):
            if len(line) > MAX_ANSWER_BYTES:
                raise WorkerError(f"its answer is larger than {MAX_ANSWER_BYTES >> 20} MB")
            kind, content = json.loads(line)
            if kind == "result":
                return content
            if kind == "error":
                raise WorkerError(content)
            progress(content)
        raise EOFError

    def _end(self, process: subprocess.Popen[bytes]) -> int:
        """End a process and return its exit code: its own one, if it had ended already."""
        _kill(process)
        code = process.wait()
        with self._lock:
            if self._process is process:
                self._process = None
        for stream in (process.stdin, process.stdout):
            with suppress(OSError):
                assert stream is not None, "both are pipes"
                stream.close()
        return code

    def _cause_of_death(self, code: int) -> str:
        limits = self._limits
        if limits is not None and code == -signal.SIGXCPU:
            return f"it takes more than {limits.cpu_s:g} s of processor time, and was stopped"
        need = f"; it may need more than {limits.memory_mb:g} MB of memory" if limits is not None else ""
        return f"it took its process down ({code}){need}"


def _send(process: subprocess.Popen[bytes], content: Any) -> None:
    assert process.stdin is not None, "it is a pipe"
    pickle.dump(content, process.stdin)
    process.stdin.flush()


def _kill(process: subprocess.Popen[bytes]) -> None:
    with suppress(ProcessLookupError):
        if process.returncode is None:  # otherwise its number may be another's by now
            os.killpg(process.pid, signal.SIGKILL)  # whatever it has started too


def worker_main() -> None:
    """Run tasks from stdin until it is closed; what a worker's process executes."""
    os.nice(NICENESS)
    replace_library_warnings()
    tasks = sys.stdin.buffer
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # whatever prints must not get between the answers

    def answer(kind: str, content: Any) -> None:
        answers.write(json.dumps((kind, content)) + "\n")
        answers.flush()

    limits = pickle.load(tasks)
    if limits is not None:
        ProcessLimits(**limits).apply()
    waiting: SimpleQueue[tuple[str, tuple[Any, ...]]] = SimpleQueue()
    threading.Thread(target=_read_tasks, args=(tasks, waiting), daemon=True).start()
    while True:
        name, arguments = waiting.get()
        try:
            module, _, function = name.partition(":")
            run = getattr(importlib.import_module(module), function)
            answer("result", run(lambda step: answer("step", step), *arguments))
        except BrokenPipeError:  # the parent has ended, and nobody is left to be told
            os._exit(0)
        except ServoscopeError as error:
            answer("error", str(error))
        except MemoryError:
            answer("error", f"it needs more than {limits['memory_mb']:g} MB of memory" if limits else "memory is full")
        except Exception as error:  # a damaged file may lead to anything, and must not look like a fault of the parent
            traceback.print_exc()
            answer("error", f"it cannot be used ({type(error).__name__}: {str(error)[:200]})")


def _read_tasks(stream: Any, waiting: SimpleQueue[tuple[str, tuple[Any, ...]]]) -> None:
    """Read tasks in a thread, so that the end of the parent ends a task too."""
    try:
        while True:
            waiting.put(pickle.load(stream))
    except (EOFError, pickle.UnpicklingError):  # the latter where the parent was killed in the middle of a task
        os._exit(0)


def available_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def create_pool(processes: int) -> ProcessPoolExecutor:
    """Return a pool of fresh processes, which end with this one, however that ends."""
    # not forked: threads of Arrow and of the linear algebra do not survive that
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(processes, mp_context=context, initializer=_exit_with_parent)


def _exit_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None, "a pool has one"

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
