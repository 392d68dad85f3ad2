"""Work that takes seconds, or that reads what strangers have sent: in processes of its own, with limits, in a queue."""

from __future__ import annotations

import asyncio
import os
import secrets
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from starlette.exceptions import HTTPException

from servoscope.core.errors import ServoscopeError
from servoscope.core.messages import SETTING, current_language, say
from servoscope.core.sandbox import Sandbox
from servoscope.core.temporary import temporary_folder
from servoscope.core.workers import ProcessLimits, Progress, Workers
from servoscope.web import errors
from servoscope.web.schemas.responses import JobResponse, JsonObject

TASKS = "servoscope.web.jobs.tasks"
MAX_FINISHED = 200  # finished jobs that can still be asked for
MAX_QUEUED = 20  # jobs that may wait
MAX_RUNNING = 2  # jobs, and short tasks, at the same time
SHORT_CPU_S, SHORT_MEMORY_MB = 60.0, 2000.0  # of a short task
START_S = 20.0  # that a process may take to start by the clock on the wall
WALL_TIME_FACTOR = 4.0  # times its processor time that it may take after that
CACHE_VARIABLES = ("NUMBA_CACHE_DIR", "MPLCONFIGDIR", "XDG_CACHE_HOME", "XDG_CONFIG_HOME")
INHERITED_VARIABLES = ("PATH", "HOME", "LANG", "LC_ALL", "PYTHONPATH", "TMPDIR", *CACHE_VARIABLES)

_threads = ThreadPoolExecutor(2 * MAX_RUNNING, "jobs")  # which wait for processes


@dataclass
class Job:
    """A task in the queue, and what becomes of it."""

    kind: str
    user: str
    task: str  # function of `servoscope.web.jobs.tasks`
    arguments: tuple[Any, ...]
    folder: Path  # where it runs: the folder of its input, so that messages name files and not the server's folders
    reads: Sequence[str]  # what else it reads
    out: Path | None  # the folder into which it writes
    finish: Callable[[Any], JsonObject]  # turns the task's result into the job's, in a thread
    discard: Callable[[], None] = lambda: None  # removes what a failed job leaves
    response: JobResponse = field(init=False)  # what users see of it
    handle: asyncio.Task[None] = field(init=False)


class JobQueue:
    """Runs jobs, a few at the same time, each within the limits."""

    def __init__(self, limits: ProcessLimits, user: str | None = None) -> None:
        self._limits, self._user = limits, user
        self._short_limits = ProcessLimits(min(limits.cpu_s, SHORT_CPU_S), min(limits.memory_mb, SHORT_MEMORY_MB))
        self._jobs: dict[str, Job] = {}
        self._slots = asyncio.Semaphore(MAX_RUNNING)
        self._short_slots = asyncio.Semaphore(MAX_RUNNING)

    def submit(self, job: Job) -> JobResponse:
        """Put a job into the queue; raises HTTPException 429 if too many wait."""
        if sum(job.response.finished is None for job in self._jobs.values()) >= MAX_QUEUED:
            asyncio.get_running_loop().run_in_executor(None, job.discard)
            raise HTTPException(429, "too many jobs wait, try again later", headers={"Retry-After": "10"})
        for old in [job for job in self._jobs.values() if job.response.finished is not None][: -MAX_FINISHED or None]:
            del self._jobs[old.response.id]
        job.response = JobResponse(id=secrets.token_hex(8), kind=job.kind, created=time.time())
        self._jobs[job.response.id] = job
        job.handle = asyncio.create_task(self._run(job))
        return job.response

    def find(self, id_: str) -> Job:
        """Return a job; raises HTTPException 404 if there is none, or it ended long ago."""
        if id_ not in self._jobs:
            raise HTTPException(404, f"there is no job {id_}")
        return self._jobs[id_]

    async def close(self) -> None:
        """Stop all jobs."""
        handles = [job.handle for job in self._jobs.values()]
        for handle in handles:
            handle.cancel()
        await asyncio.gather(*handles, return_exceptions=True)

    async def run_now(self, task: str, folder: Path, *arguments: Any) -> Any:
        """Run a short task at once, within smaller limits, and return its result; raises WorkerError if it failed."""
        async with self._short_slots:
            return await run_task(task, arguments, folder, self._short_limits, self._sandbox(folder))

    def _sandbox(self, folder: Path, reads: Sequence[str] = (), out: Path | None = None) -> Sandbox:
        writes = _cache_folders() if out is None else (*_cache_folders(), str(out))
        return Sandbox((str(folder), *reads), writes, self._user)

    async def _run(self, job: Job) -> None:
        shown = job.response

        def show(step: str) -> None:
            shown.step = step

        try:
            async with self._slots:
                shown.state = "running"
                sandbox = self._sandbox(job.folder, job.reads, job.out)
                result = await run_task(job.task, job.arguments, job.folder, self._limits, sandbox, show)
                shown.result = await asyncio.to_thread(job.finish, result)
            shown.state = "done"
        except ServoscopeError as error:
            shown.problem = errors.problem(errors.http_status(error), str(error))
        except HTTPException as error:
            shown.problem = errors.problem(error.status_code, str(error.detail))
        except asyncio.CancelledError:
            shown.problem = errors.problem(409, say("web.job_stopped"))
        except Exception:
            shown.problem = errors.problem(500, say("web.job_failed"))
            raise
        finally:
            if shown.problem is not None:
                shown.state = "failed"
                await asyncio.to_thread(job.discard)
            shown.finished, shown.step = time.time(), None


async def run_task(
    task: str,
    arguments: tuple[Any, ...],
    folder: Path,
    limits: ProcessLimits,
    sandbox: Sandbox,
    progress: Progress = lambda _: None,
) -> Any:
    """Run a function of `servoscope.web.jobs.tasks` in a process of its own and return its result.

    Raises WorkerError if it failed, or needed more than its limits.
    """
    workers = Workers(limits, folder=folder, environment=_environment())

    def run() -> Any:
        with temporary_folder("job") as temporary:
            walls = replace(sandbox, write=(temporary, *sandbox.write))
            timeout_s = START_S + WALL_TIME_FACTOR * limits.cpu_s
            return workers.run(f"{TASKS}:{task}", *arguments, progress=progress, timeout_s=timeout_s, sandbox=walls)

    try:
        return await asyncio.get_running_loop().run_in_executor(_threads, run)
    finally:
        # the wait for the process is milliseconds: it is killed
        workers.close()


def _cache_folders() -> tuple[str, ...]:
    """Return where compiled kernels are kept, and what Matplotlib knows of fonts."""
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folders = {"NUMBA_CACHE_DIR": caches / "numba", "MPLCONFIGDIR": caches / "matplotlib"}
    return tuple(os.environ.get(name, str(folder)) for name, folder in folders.items())


def _environment() -> dict[str, str]:
    """Return the environment of a worker, which reads what strangers have sent: no secrets of the server."""
    environment = {name: os.environ[name] for name in INHERITED_VARIABLES if name in os.environ}
    if paths := environment.get("PYTHONPATH"):  # it runs in another folder
        environment["PYTHONPATH"] = os.pathsep.join(str(Path(path).absolute()) for path in paths.split(os.pathsep))
    return {**environment, SETTING: current_language(), "OPENBLAS_NUM_THREADS": "1", "PYTHONSAFEPATH": "1"}
