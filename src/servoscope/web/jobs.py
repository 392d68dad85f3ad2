"""Work that takes seconds, or that reads what strangers have sent: in processes of its own, with limits, in a queue."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import secrets
import signal
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from starlette.exceptions import HTTPException

from servoscope.errors import RecordingError, ServoscopeError
from servoscope.web import problems

__all__ = ["Job", "Jobs", "Limits"]

PROGRAM = "from servoscope.web.working import work; work()"
KEPT = 200  # finished jobs that can still be asked for
WAITING = 20  # jobs that may wait
AT_ONCE = 2
LINE = 64 << 20  # bytes of an answer, at most
PATIENCE = 4.0  # times its processor time that a process may take by the clock on the wall, and 20 s to start
PASSED_ON = ("PATH", "HOME", "LANG", "LC_ALL", "PYTHONPATH", "NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "TMPDIR")

Plain = dict[str, Any]


@dataclass(frozen=True)
class Limits:
    """Of one process: processor time [s], address space [MB], largest file that it writes [MB]."""

    cpu_s: float
    memory_mb: float
    file_mb: float = 500.0


@dataclass
class Job:
    """Something that was asked for.

    Parameters
    ----------
    kind
        What it is.
    who
        Who asked.
    task, arguments
        Function of `servoscope.web.tasks`, and what it is given.
    cwd
        Where it runs: the folder of what it reads, so that messages name files and not the server's folders.
    finish
        Turns its answer into the job's result, in a thread.
    abandon
        Takes away what it has begun, where it fails.
    """

    kind: str
    who: str
    task: str
    arguments: Plain
    cwd: Path
    finish: Callable[[Plain], Plain]
    abandon: Callable[[], None] = lambda: None
    id: str = field(default_factory=lambda: secrets.token_hex(8))
    state: str = "queued"
    step: str | None = None
    created: float = field(default_factory=time.time)
    finished: float | None = None
    result: Plain | None = None
    problem: Plain | None = None
    ended: asyncio.Event = field(default_factory=asyncio.Event)
    running: asyncio.Task[None] | None = None

    def plain(self) -> Plain:
        """Return what is told of it."""
        names = ("id", "kind", "state", "step", "created", "finished", "result", "problem")
        return {name: getattr(self, name) for name in names}


class Jobs:
    """The queue.

    Parameters
    ----------
    limits
        Of each job.
    """

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self._jobs: dict[str, Job] = {}
        self._turn = asyncio.Semaphore(AT_ONCE)
        self._glance = asyncio.Semaphore(AT_ONCE)

    def submitted(self, job: Job) -> Job:
        """Put a job into the queue and return it.

        Raises
        ------
        HTTPException
            429: if too many wait.
        """
        if sum(one.finished is None for one in self._jobs.values()) >= WAITING:
            job.abandon()
            raise HTTPException(429, "too many jobs wait, try again later", headers={"Retry-After": "10"})
        for old in [one for one in self._jobs.values() if one.finished is not None][: -KEPT or None]:
            del self._jobs[old.id]
        self._jobs[job.id] = job
        job.running = asyncio.create_task(self._run(job))
        return job

    def find(self, id_: str) -> Job:
        """Return a job.

        Raises
        ------
        HTTPException
            404: if there is none, or it is long over.
        """
        if id_ not in self._jobs:
            raise HTTPException(404, f"there is no job {id_}")
        return self._jobs[id_]

    def stop(self, job: Job) -> None:
        """Stop a job."""
        if job.running is not None and job.finished is None:
            job.running.cancel()

    async def close(self) -> None:
        """Stop all of them."""
        running = [job.running for job in self._jobs.values() if job.running is not None and job.finished is None]
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)

    async def glance(self, task: str, arguments: Plain, cwd: Path) -> Plain:
        """Do something short at once, with smaller limits, and return its answer.

        Raises
        ------
        ServoscopeError
            If it failed.
        """
        limits = Limits(min(self.limits.cpu_s, 60.0), min(self.limits.memory_mb, 2000.0))
        async with self._glance:
            return await carry_out(task, arguments, cwd, limits, lambda _: None)

    async def _run(self, job: Job) -> None:
        def tell(step: str) -> None:
            job.step = step

        try:
            async with self._turn:
                job.state = "running"
                answer = await carry_out(job.task, job.arguments, job.cwd, self.limits, tell)
                job.result = await asyncio.to_thread(job.finish, answer)
            job.state = "done"
        except ServoscopeError as error:
            job.state, job.problem = "failed", problems.describe(problems.status_of(error), str(error))
        except HTTPException as error:
            job.state, job.problem = "failed", problems.describe(error.status_code, str(error.detail))
        except asyncio.CancelledError:
            job.state, job.problem = "failed", problems.describe(409, "it was stopped")
        except Exception:
            job.state, job.problem = "failed", problems.describe(500, "it failed; the server's log has more")
            raise
        finally:
            if job.state == "failed":
                job.abandon()
            job.finished, job.step = time.time(), None
            job.ended.set()


async def carry_out(task: str, arguments: Plain, cwd: Path, limits: Limits, tell: Callable[[str], None]) -> Plain:
    """Run a task in a process of its own and return its answer.

    Raises
    ------
    ServoscopeError
        If it failed, or needed more than its limits.
    """
    environment = {name: os.environ[name] for name in PASSED_ON if name in os.environ}
    if paths := environment.get("PYTHONPATH"):  # it runs in another folder
        environment["PYTHONPATH"] = os.pathsep.join(str(Path(path).absolute()) for path in paths.split(os.pathsep))
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-c",
        PROGRAM,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        cwd=cwd,
        env={**environment, "OPENBLAS_NUM_THREADS": "1", "PYTHONSAFEPATH": "1"},
        limit=LINE,
        start_new_session=True,
    )
    asked = {"task": task, "arguments": arguments, "limits": vars(limits)}
    try:
        async with asyncio.timeout(20.0 + PATIENCE * limits.cpu_s):
            return await _talk(process, asked, limits, tell)
    except TimeoutError:
        raise RecordingError(f"it took more than {20.0 + PATIENCE * limits.cpu_s:g} s, and was stopped") from None
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        await process.wait()


async def _talk(
    process: asyncio.subprocess.Process, asked: Mapping[str, Any], limits: Limits, tell: Callable[[str], None]
) -> Plain:
    assert process.stdin is not None and process.stdout is not None, "both are pipes"
    with contextlib.suppress(ConnectionError):
        process.stdin.write(json.dumps(asked).encode() + b"\n")
        await process.stdin.drain()
        process.stdin.close()
    while line := await _line(process.stdout):
        said = json.loads(line)
        if "step" in said:
            tell(str(said["step"]))
        elif "problem" in said:
            raise RecordingError(said["problem"])
        else:
            answer: Plain = said["answer"]
            return answer
    code = await process.wait()
    if code == -signal.SIGXCPU:
        raise RecordingError(f"it takes more than {limits.cpu_s:g} s of processor time, and was stopped")
    raise RecordingError(f"it took its process down ({code}); it may need more than {limits.memory_mb:g} MB of memory")


async def _line(stream: asyncio.StreamReader) -> bytes:
    try:
        return await stream.readline()
    except ValueError:
        raise RecordingError(f"its answer is larger than {LINE >> 20} MB") from None
