"""The engine of one machine: tasks on all cores, few at a time; a task that kills its process costs itself only."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from typing import Any

from servoscope.core.workers import create_pool
from servoscope.fleet.tasks import ExamineTask, LearnTask

Task = LearnTask | ExamineTask
TaskResult = tuple[Task, dict[str, Any]]
Engine = Callable[[Sequence[Task]], Iterator[TaskResult]]  # results come as tasks finish, in any order
TASKS_PER_PROCESS = 2  # tasks handed out per process: enough to keep it busy, few enough to keep memory bounded


def local(jobs: int) -> Engine:
    """Return the engine that runs tasks in so many processes; with one, in this one."""

    def run(tasks: Sequence[Task]) -> Iterator[TaskResult]:
        if jobs == 1:
            yield from ((task, task.run()) for task in tasks)
            return
        waiting = iter(tasks)
        while suspects := (yield from _run_pool(jobs, waiting)):
            for task in suspects:  # one of them killed its process: alone, it takes no other with it
                yield task, _run_isolated(task)

    return run


def crash_result(task: Task) -> dict[str, Any]:
    """Return the result of a task that killed its process."""
    error = "its process died, perhaps for want of memory"
    if isinstance(task, LearnTask):
        return {"name": task.name, "error": error, "unused": {}}
    item = task.item
    return {"asset": item.asset, "day": item.day, "stamp": item.stamp, "status": "failed", "error": error}


def _run_pool(jobs: int, waiting: Iterator[Task]) -> Generator[TaskResult, None, list[Task]]:
    """Run tasks until there are none, or a process dies; return those that were under way then."""
    running: dict[Future[dict[str, Any]], Task] = {}
    with create_pool(jobs) as pool:
        try:
            while True:
                for task in islice(waiting, TASKS_PER_PROCESS * jobs - len(running)):
                    running[pool.submit(task.run)] = task
                if not running:
                    return []
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    result = future.result()
                    yield running.pop(future), result
        except BrokenProcessPool:
            return list(running.values())


def _run_isolated(task: Task) -> dict[str, Any]:
    with create_pool(1) as pool:
        try:
            return pool.submit(task.run).result()
        except BrokenProcessPool:
            return crash_result(task)
