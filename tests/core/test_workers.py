"""Workers: results, progress, errors; a process that dies, hangs, needs too much or loses its parent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from servoscope.core.workers import ProcessLimits, Progress, WorkerError, Workers

TESTS = Path(__file__).parent
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(str(path) for path in (TESTS, TESTS.parents[1] / "src"))}


def double(progress: Progress, x: float) -> float:
    print("printed between two answers")
    progress("doubling")
    return 2.0 * x


def process_number(_: Progress) -> int:
    return os.getpid()


def die(_: Progress, code: int) -> None:
    os._exit(code)


def hang(_: Progress, file: str = "") -> None:
    if file:
        Path(file).write_text(str(os.getpid()))
    time.sleep(600.0)


def hang_for(_: Progress, seconds: float) -> None:
    time.sleep(seconds)


def fill_memory(_: Progress) -> int:
    return len(bytearray(10**10))


def fail(_: Progress) -> None:
    raise ZeroDivisionError("by nothing")


def run(worker: Workers, name: str, *arguments: object, **more: object) -> object:
    return worker.run(f"test_workers:{name}", *arguments, **more)  # type: ignore[arg-type]


def test_a_worker_answers_and_lasts_until_it_fails() -> None:
    worker, steps = Workers(environment=ENVIRONMENT), list[str]()
    try:
        assert run(worker, "double", 0.1, progress=steps.append) == 0.2 and steps == ["doubling"]
        first = run(worker, "process_number")
        assert run(worker, "process_number") == first != os.getpid()
        for task, arguments, words in (("fail", (), "ZeroDivisionError: by nothing"), ("die", (3,), r"down \(3\)")):
            with pytest.raises(WorkerError, match=words):
                run(worker, task, *arguments)
        assert run(worker, "process_number") != first
    finally:
        worker.close()
    with pytest.raises(WorkerError, match="stopped"):
        run(worker, "double", 1.0)


def test_a_worker_that_hangs_or_needs_too_much_is_ended() -> None:
    worker = Workers(ProcessLimits(10.0, 1000.0), environment=ENVIRONMENT)
    try:
        with pytest.raises(WorkerError, match="more than 1000 MB"):
            run(worker, "fill_memory")
        with pytest.raises(WorkerError, match=r"more than 0\.5 s"):
            run(worker, "hang", timeout_s=0.5)
        threading.Timer(0.5, worker.close).start()
        with pytest.raises(WorkerError):
            run(worker, "hang")
    finally:
        worker.close()


def test_a_map_that_is_left_ends_what_still_runs() -> None:
    workers = Workers(environment=ENVIRONMENT)
    results = workers.map("test_workers:hang_for", [0.0, 600.0], 2)
    assert next(results) == (0.0, None)
    begin = time.monotonic()
    results.close()  # type: ignore[attr-defined]  # a generator
    assert time.monotonic() - begin < 60.0
    with pytest.raises(WorkerError, match="stopped"):
        run(workers, "double", 1.0)


def test_a_busy_worker_ends_with_its_parent(tmp_path: Path) -> None:
    file = tmp_path / "pid"
    code = f"from servoscope.core.workers import Workers; Workers().run('test_workers:hang', {str(file)!r})"
    with subprocess.Popen([sys.executable, "-c", code], env=ENVIRONMENT) as parent:
        deadline = time.monotonic() + 30.0
        while not (file.exists() and file.read_text()) and time.monotonic() < deadline:
            time.sleep(0.05)
        parent.send_signal(signal.SIGKILL)
    worker = int(file.read_text())
    while time.monotonic() < deadline:
        try:
            os.kill(worker, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    pytest.fail("the worker outlives its parent")


def test_temporary_folders_go_with_a_process_that_is_killed() -> None:
    program = """
import time
from servoscope.core.temporary import temporary_folder
from servoscope.core.workers import Workers
folder = temporary_folder("read")
Workers().run("builtins:str")
print(folder.name, flush=True)
time.sleep(600)
"""
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, env=ENVIRONMENT
    ) as parent:
        assert parent.stdout is not None
        folder = Path(parent.stdout.readline().strip())
        assert folder.is_dir()
        parent.kill()
    deadline = time.monotonic() + 60.0
    while folder.parent.exists():
        assert time.monotonic() < deadline, "the folder is still there"
        time.sleep(0.05)
