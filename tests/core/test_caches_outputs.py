"""No folder for caches, and two commands that write to one place: one line, and never a mixture."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from commands import one_line, run

from servoscope.core.cache_folders import warn_of_missing_cache
from servoscope.core.files import atomic_write, exclusive_folder
from servoscope.core.jit.array_function import ArrayFunction

NOWHERE = "/proc/nowhere"  # not even the administrator can make it
NO_CACHES = {
    "HOME": NOWHERE,
    "XDG_CACHE_HOME": f"{NOWHERE}/c",
    "XDG_CONFIG_HOME": f"{NOWHERE}/d",
    "NUMBA_CACHE_DIR": f"{NOWHERE}/n",
}
NO_INSTALL = {"PYTHONDONTWRITEBYTECODE": "1"}
BOTH_LIBRARIES = """
from servoscope.core.cache_folders import replace_library_warnings
replace_library_warnings()
import matplotlib.figure
import numpy
from servoscope.models.lfilter import lfilter
lfilter(numpy.ones(2), numpy.ones(1), numpy.ones(3))
"""


def environment(**more: str) -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if name != "MPLCONFIGDIR"}
    return {**kept, "OPENBLAS_NUM_THREADS": "1", **NO_INSTALL, **more}


def test_without_a_folder_for_caches_there_is_one_line() -> None:
    made = subprocess.run([sys.executable, "-c", BOTH_LIBRARIES], env=environment(**NO_CACHES), capture_output=True)
    (line,) = made.stderr.decode().splitlines()
    assert made.returncode == 0
    assert line.startswith("servoscope: no folder for caches")


@pytest.mark.slow
def test_every_step_of_the_demonstration_works_without_home_and_caches(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "servoscope", "demo", "-o", str(tmp_path / "demo")]
    made = subprocess.run(command, env=environment(**NO_CACHES), capture_output=True, timeout=300.0)
    errors = [line for line in made.stderr.decode().splitlines() if line.startswith("servoscope:") or "NUMBA" in line]
    assert made.returncode == 0
    assert len(errors) == 1
    assert "Matplotlib" not in made.stderr.decode()
    assert not [path for path in (tmp_path / "demo").iterdir() if path.suffix == ".part"]


def test_a_cache_that_can_no_longer_be_written_is_done_without(monkeypatch: pytest.MonkeyPatch) -> None:
    warn_of_missing_cache.cache_clear()

    @ArrayFunction
    def twice(printer: Any, x: Any) -> Any:
        return x * 2.0

    monkeypatch.setenv("NUMBA_CACHE_DIR", NOWHERE)
    assert twice(1.5) == 3.0


def test_a_second_command_to_one_folder_is_refused(tmp_path: Path) -> None:
    with exclusive_folder(tmp_path):
        for command in ("demo", "reproduce"):
            one_line(run(command, "-o", tmp_path), str(tmp_path), "another command")
    assert not list(tmp_path.iterdir())
    with exclusive_folder(tmp_path):
        pass  # the lock has gone with its command


def test_of_two_that_write_one_file_the_last_wins_whole(tmp_path: Path) -> None:
    path, contents = tmp_path / "baseline.json", [json.dumps([number] * 50_000).encode() for number in range(4)]

    def write(content: bytes) -> None:
        for _ in range(10):
            atomic_write(path, content)

    write(contents[0])
    threads = [threading.Thread(target=write, args=(content,)) for content in contents]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        assert path.read_bytes() in contents
    for thread in threads:
        thread.join()
    assert [one.name for one in tmp_path.iterdir()] == ["baseline.json"]
