"""Work in other processes, with limits, for what may fail or comes from strangers, or needs several cores.

A worker is told what to do in pickles and answers in JSON, so that a file that takes over the worker that reads it has
no way into the process that asked.

A worker's process loads libraries, and forks for each sandbox: walls are for good, and loading takes a second.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from pickle import UnpicklingError
from queue import SimpleQueue
from typing import Any, TypeVar

from servoscope.core.cache_folders import replace_library_warnings
from servoscope.core.errors import ServoscopeError
from servoscope.core.sandbox import Sandbox
from servoscope.core.temporary import process_folder

Progress = Callable[[str], None]
Task = TypeVar("Task")

WORKER_CODE = "import sys; from servoscope.core.workers import worker_main; worker_main(sys.argv[1])"
START_S = 60.0  # that a process and its libraries may take to start, on a machine that is busy
SIGNAL_CODE = 128  # plus the number of the signal that ended a task's process: exit code of the one that forked it
TASKS_PER_PROCESS = 2  # tasks handed out per process: enough to keep it busy
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


class Workers:
    """Processes that run tasks, as many as there are tasks at a time; each keeps what it has loaded for its next one.

    They end with the process that started them, however that ends.

    Parameters
    ----------
    limits
        Of each; None: as much as it takes.
    folder, environment
        Where they run, and their environment variables; None: those of this process.
    """

    def __init__(
        self,
        limits: ProcessLimits | None = None,
        *,
        folder: Path | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._start = partial(_TaskProcess, limits, folder, environment)
        self._lock = threading.Lock()
        self._idle, self._busy = list[_TaskProcess](), set[_TaskProcess]()
        self._stopped = False

    def run(
        self,
        function: str,
        *arguments: Any,
        progress: Progress = lambda _: None,
        timeout_s: float | None = None,
        cpu_s: float | None = None,
        libraries: Sequence[str] = (),
        sandbox: Sandbox | None = None,
    ) -> Any:
        """Run a function and return its result; from any thread.

        Parameters
        ----------
        function
            ``"package.module:name"``. It is called with a callback for steps of its progress and the arguments, and
            returns what can be written as JSON.
        timeout_s
            How long it may take by the clock on the wall [s].
        cpu_s
            How much processor time it may take [s], in whole seconds; None: what its process may.
        libraries
            Modules that are loaded before this time counts, once for all sandboxes.
        sandbox
            Within which it runs; tasks of another one do not see what it has left in memory.

        Raises
        ------
        WorkerError
            If it failed, or needed more than its limits; its process has ended then.
        """
        with self._lock:
            if self._stopped:
                raise WorkerError("it was stopped")
            inside = [worker for worker in self._idle if worker.entered == (libraries, sandbox)]
            worker = (inside or self._idle or [self._start()])[-1]
            with suppress(ValueError):
                self._idle.remove(worker)
            self._busy.add(worker)
        try:
            worker.enter(libraries, sandbox)
            return worker.exchange((function, arguments, cpu_s), progress, timeout_s, cpu_s)
        finally:
            with self._lock:
                self._busy.remove(worker)
                if worker.process.poll() is None:
                    self._idle.append(worker)

    def map(self, function: str, tasks: Iterable[Task], processes: int) -> Iterator[tuple[Task, Any]]:
        """Yield tasks with what a function makes of each, as they end; of a task that failed, its WorkerError.

        A task that kills its process costs itself only. Few wait at a time, so that memory is bounded. Stops at the
        end, as `stop` does.
        """

        def attempt(task: Task) -> tuple[Task, Any]:
            try:
                return task, self.run(function, task)
            except WorkerError as error:
                return task, error

        waiting, running = iter(tasks), set[Future[tuple[Task, Any]]]()
        with ThreadPoolExecutor(processes, "workers") as threads, closing(self):
            while True:
                some = islice(waiting, TASKS_PER_PROCESS * processes - len(running))
                running |= {threads.submit(attempt, task) for task in some}
                if not running:
                    return
                done, running = wait(running, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in done)

    def close(self) -> None:
        """Stop for good, from any thread; tasks that are running fail."""
        with self._lock:
            self._stopped = True
            for worker in (*self._idle, *self._busy):
                worker.end()


class _TaskProcess:
    """A process that runs one task after the other, until one fails."""

    def __init__(
        self, limits: ProcessLimits | None, folder: Path | None, environment: Mapping[str, str] | None
    ) -> None:
        self._limits = limits
        self.entered: tuple[Sequence[str], Sandbox | None] | None = None  # libraries and sandbox of its tasks
        # not pipes: whoever holds one end of a pipe can open the other one through /proc
        ours, theirs = socket.socketpair()
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, "-c", WORKER_CODE, process_folder()],
                stdin=theirs.fileno(),
                cwd=folder,
                env=environment,
                start_new_session=True,  # Ctrl-C in a terminal is for the parent, which then ends it
            )
        self._connection = Connection(ours.detach())

    def enter(self, libraries: Sequence[str], sandbox: Sandbox | None) -> None:
        """Load libraries, and let the next tasks run within a sandbox."""
        if self.entered != (libraries, sandbox):
            if self.entered is not None:
                self.exchange(None)
            self.exchange((libraries, self._limits, sandbox), timeout_s=START_S)
            self.entered = libraries, sandbox

    def exchange(
        self,
        question: Any,
        progress: Progress = lambda _: None,
        timeout_s: float | None = None,
        cpu_s: float | None = None,
    ) -> Any:
        """Send a question and return the answer; raises WorkerError, see `Workers.run`."""
        late = threading.Event()

        def expire() -> None:
            late.set()
            self._kill()

        timer = threading.Timer(threading.TIMEOUT_MAX if timeout_s is None else timeout_s, expire)
        timer.daemon = True
        timer.start()
        try:
            self._connection.send(question)
            while True:
                kind, content = json.loads(self._connection.recv_bytes(MAX_ANSWER_BYTES))
                if kind == ("ended" if question is None else "result"):
                    return content
                if kind == "ended":  # a task has left its process
                    raise EOFError
                if kind == "error":
                    raise WorkerError(content)
                progress(content)
        except (EOFError, OSError, TypeError, ValueError, RecursionError):
            code = self.end()  # it has ended, perhaps in the middle of an answer
        except BaseException:
            self.end()
            raise
        finally:
            timer.cancel()
        if late.is_set():
            raise WorkerError(f"it took more than {timeout_s:g} s, and was stopped")
        raise WorkerError(self._cause_of_death(code if code <= SIGNAL_CODE else SIGNAL_CODE - code, cpu_s))

    def _kill(self) -> None:
        with suppress(ProcessLookupError):
            if self.process.returncode is None:  # otherwise its number may be another's by now
                os.killpg(self.process.pid, signal.SIGKILL)  # whatever it has started too

    def end(self) -> int:
        """End the process and return its exit code: its own one, if it had ended already."""
        self._kill()
        return self.process.wait()

    def _cause_of_death(self, code: int, cpu_s: float | None) -> str:
        limits = self._limits
        if limits is not None and code == -signal.SIGXCPU:
            return f"it takes more than {round(cpu_s or limits.cpu_s, 1):g} s of processor time, and was stopped"
        need = f"; it may need more than {limits.memory_mb:g} MB of memory" if limits is not None else ""
        return f"it took its process down ({code}){need}"


def worker_main(temporary: str) -> None:
    """Fork a process for each sandbox that comes from stdin, until that is closed; what a worker executes.

    `temporary`: the folder of its parent, which is removed when that has ended.
    """
    os.nice(NICENESS)
    replace_library_warnings()
    parent = Connection(os.dup(sys.stdin.fileno()))
    silent = os.open(os.devnull, os.O_RDONLY)
    os.dup2(silent, sys.stdin.fileno())
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    while True:
        try:
            libraries, limits, sandbox = parent.recv()
        except (EOFError, OSError, UnpicklingError):  # the last: the parent was killed in the middle of a task
            return shutil.rmtree(temporary, ignore_errors=True)
        for library in libraries:
            with suppress(ImportError):  # a task says what is missing
                importlib.import_module(library)
        child = os.fork()
        if child == 0:
            _run_tasks(parent, limits, sandbox)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if code:
            os._exit(code if code > 0 else SIGNAL_CODE - code)
        with suppress(BrokenPipeError):  # the parent has ended
            parent.send_bytes(b'["ended", null]')


def _run_tasks(parent: Connection, limits: ProcessLimits | None, sandbox: Sandbox | None) -> None:
    """Run tasks until the parent ends, or asks for another sandbox."""

    def answer(kind: str, content: Any) -> None:
        text = json.dumps((kind, content)).encode()
        if len(text) > MAX_ANSWER_BYTES:
            text = json.dumps(("error", f"its answer is larger than {MAX_ANSWER_BYTES >> 20} MB")).encode()
        parent.send_bytes(text)

    def progress(step: str) -> None:
        answer("step", step)

    def run(name: str, *arguments: Any) -> None:
        module, _, function = name.partition(":")
        try:
            answer("result", getattr(importlib.import_module(module), function)(progress, *arguments))
        except BrokenPipeError:  # the parent has ended, and nobody is left to be told
            os._exit(0)
        except ServoscopeError as error:
            answer("error", str(error))
        except MemoryError:
            answer("error", f"it needs more than {limits.memory_mb:g} MB of memory" if limits else "memory is full")
        except Exception as error:  # a damaged file may lead to anything, and must not look like a fault of the parent
            traceback.print_exc()
            answer("error", f"it cannot be used ({type(error).__name__}: {str(error)[:200]})")

    waiting: SimpleQueue[tuple[str, tuple[Any, ...], float | None]] = SimpleQueue()
    run(f"{__name__}:enter_bounds", limits, sandbox)  # before there is another thread: walls are around each thread
    threading.Thread(target=_read_tasks, args=(parent, waiting), daemon=True).start()
    while True:
        name, arguments, cpu_s = waiting.get()
        if cpu_s is not None:
            _bound_task(cpu_s)
        run(name, *arguments)


def enter_bounds(_: Progress, limits: ProcessLimits | None, sandbox: Sandbox | None) -> None:
    """Bound this process, before its first task."""
    if sandbox is not None:
        sandbox.enter()
    if limits is not None:
        limits.apply()


def _bound_task(cpu_s: float) -> None:
    """Let the kernel end this process after so much more processor time [s], until the next task has its own bound."""
    import resource

    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    limit = math.ceil(time.process_time() + cpu_s)
    resource.setrlimit(resource.RLIMIT_CPU, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))


def _read_tasks(parent: Connection, waiting: SimpleQueue[tuple[str, tuple[Any, ...], float | None]]) -> None:
    """Read tasks in a thread, so that the end of the parent ends a task too."""
    try:
        while task := parent.recv():
            waiting.put(task)
    except (EOFError, OSError, UnpicklingError):
        pass
    except Exception:  # what a task needs cannot be imported here
        traceback.print_exc()
        os._exit(1)
    os._exit(0)
