"""The engine of one machine: tasks on all cores, few at a time; a task that kills its process costs itself only."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from servoscope.core.workers import Progress, WorkerError, Workers
from servoscope.fleet.tasks import ExamineTask, LearnTask

Task = LearnTask | ExamineTask
TaskResult = tuple[Task, dict[str, Any]]
Engine = Callable[[Sequence[Task]], Iterator[TaskResult]]  # results come as tasks finish, in any order


def local(jobs: int) -> Engine:
    """Return the engine that runs tasks in so many processes; with one, in this one."""

    def run(tasks: Sequence[Task]) -> Iterator[TaskResult]:
        if jobs == 1:
            yield from ((task, task.run()) for task in tasks)
            return
        for task, result in Workers().map(f"{__name__}:run_task", tasks, jobs):
            yield task, crash_result(task) if isinstance(result, WorkerError) else result

    return run


def run_task(_: Progress, task: Task) -> dict[str, Any]:
    """Run a task in a worker."""
    return task.run()


def crash_result(task: Task) -> dict[str, Any]:
    """Return the result of a task that killed its process."""
    error = "its process died, perhaps for want of memory"
    if isinstance(task, LearnTask):
        return {"name": task.name, "error": error, "unused": {}}
    item = task.item
    return {"asset": item.asset, "day": item.day, "stamp": item.stamp, "status": "failed", "error": error}
