"""The engine of one machine: tasks on all cores, few at a time; a task that kills its process costs itself only."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from typing import Any

from servoscope.fleet.tasks import Examine, Learn

__all__ = ["Engine", "Result", "Task", "cores", "died", "local"]

Task = Learn | Examine
Result = tuple[Task, dict[str, Any]]
Engine = Callable[[Sequence[Task]], Iterator[Result]]  # results come as tasks finish, in any order
AHEAD = 2  # tasks handed out per process: enough to keep it busy, few enough to keep memory bounded


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def local(jobs: int) -> Engine:
    """Return the engine that runs tasks in so many processes; with one, in this one."""

    def run(tasks: Sequence[Task]) -> Iterator[Result]:
        if jobs == 1:
            yield from ((task, task.run()) for task in tasks)
            return
        waiting = iter(tasks)
        while suspects := (yield from _together(jobs, waiting)):
            for task in suspects:  # one of them killed its process: alone, it takes no other with it
                yield task, _alone(task)

    return run


def died(task: Task) -> dict[str, Any]:
    """Return the result of a task that killed its process."""
    error = "its process died, perhaps for want of memory"
    if isinstance(task, Learn):
        return {"name": task.name, "error": error, "unused": {}}
    item = task.item
    return {"asset": item.asset, "day": item.day, "stamp": item.stamp, "status": "failed", "error": error}


def _pool(jobs: int) -> ProcessPoolExecutor:
    # not forked: threads of Arrow and of the linear algebra do not survive that
    return ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"), initializer=_leave_with_parent)


def _together(jobs: int, waiting: Iterator[Task]) -> Generator[Result, None, list[Task]]:
    """Run tasks until there are none, or a process dies; return those that were under way then."""
    running: dict[Future[dict[str, Any]], Task] = {}
    with _pool(jobs) as pool:
        try:
            while True:
                for task in islice(waiting, AHEAD * jobs - len(running)):
                    running[pool.submit(task.run)] = task
                if not running:
                    return []
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    result = future.result()
                    yield running.pop(future), result
        except BrokenProcessPool:
            return list(running.values())


def _alone(task: Task) -> dict[str, Any]:
    with _pool(1) as pool:
        try:
            return pool.submit(task.run).result()
        except BrokenProcessPool:
            return died(task)


def _leave_with_parent() -> None:
    """End this process when the one that started it is gone, however that went."""
    import threading

    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
