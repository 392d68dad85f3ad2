"""The walls around a process that reads what strangers have sent: each alone, with whatever kernel there is."""

from __future__ import annotations

import json
import os
import struct
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hostile.other_files import plant

from servoscope.core import sandbox
from servoscope.core.errors import ConfigError, RecordingError
from servoscope.core.sandbox import Sandbox
from servoscope.core.workers import Workers
from servoscope.signals.readers import reader_process


def test_a_reader_that_is_taken_over_opens_its_own_file_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second wall alone: a reader that tries, in the place of one that a file has led astray."""
    assert sandbox.landlock_version() > 0, "this kernel has no Landlock"
    secret, _ = plant(tmp_path)
    tried = (str(secret), f"/proc/{os.getpid()}/environ", "/proc/self/environ", str(Path("/", "etc", "passwd")))
    (tmp_path / "module").mkdir()
    (tmp_path / "module" / "curious.py").write_text(
        "from pathlib import Path\nfrom servoscope.core.errors import RecordingError\n"
        "def open_it(path):\n"
        "    found = {}\n"
        f"    for name in (path, *{tried!r}):\n"
        "        try:\n"
        "            found[str(name)] = len(Path(name).read_bytes())\n"
        "        except OSError as error:\n"
        "            found[str(name)] = error.strerror\n"
        "    try:\n"
        "        path.with_name('made').write_text('x')\n"
        "    except OSError as error:\n"
        "        found['made'] = error.strerror\n"
        "    raise RecordingError(repr(found))\n"
    )
    own = tmp_path / "own.bin"
    own.write_bytes(b"12345")
    monkeypatch.setattr(reader_process, "_workers", Workers(reader_process.LIMITS))
    paths = [str(tmp_path / "module"), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    with pytest.raises(RecordingError) as told:
        reader_process.open_bounded(own, "odd", "curious", "open_it", "curious")
    reader_process._workers.close()
    assert str(told.value).count("Permission denied") == 5 and ": 5," in str(told.value)
    assert not (tmp_path / "made").exists()


def process_number(_: object) -> int:
    return os.getpid()


def test_the_walls_are_around_each_thread_of_the_process() -> None:
    worker = Workers(environment={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)})
    number = worker.run(f"{__name__}:process_number", sandbox=Sandbox())
    threads = [path.read_text() for path in Path(f"/proc/{number}/task").glob("*/status")]
    worker.close()
    assert len(threads) > 1 and all("NoNewPrivs:\t1" in text for text in threads)


def outcomes(enter: Callable[[], None], *paths: Path) -> dict[str, str]:
    """Return what a process of its own finds in files behind a wall."""
    source, sink = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            enter()
            found = {}
            for path in paths:
                try:
                    found[path.name] = path.read_text()
                except OSError as error:
                    found[path.name] = type(error).__name__
            os.write(sink, json.dumps(found).encode())
        finally:
            os._exit(0)
    os.close(sink)
    os.waitpid(child, 0)
    with os.fdopen(source) as answers:
        return json.loads(answers.read() or "{}")


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, ...]:
    own, secret = tmp_path / "own", tmp_path / "secret"
    for path, mode in ((own, 0o644), (secret, 0o600)):
        path.write_text(path.name)
        path.chmod(mode)
    for folder in (tmp_path, *tmp_path.parents):
        if folder.stat().st_uid == os.geteuid() and str(folder) != tempfile.gettempdir():
            folder.chmod(folder.stat().st_mode | 0o111)
    return own, secret, Path(f"/proc/{os.getpid()}/environ")


def test_landlock_alone(files: tuple[Path, ...]) -> None:
    assert sandbox.landlock_version() > 0, "this kernel has no Landlock"
    found = outcomes(Sandbox(read=(str(files[0]),)).enter, *files)
    assert found == {"own": "own", "secret": "PermissionError", "environ": "PermissionError"}


def test_another_user_alone(files: tuple[Path, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    assert os.geteuid() == 0, "only root can change the user of a process"
    monkeypatch.setattr(sandbox, "landlock_version", lambda: 0)
    found = outcomes(Sandbox(user="nobody").enter, *files)
    assert found == {"own": "own", "secret": "PermissionError", "environ": "PermissionError"}
    with pytest.raises(ConfigError, match="no user 'nobody-at-all'"):
        Sandbox(user="nobody-at-all").enter()


@pytest.mark.parametrize("version", [1, 2, 3, 4, 5, 6, 7, 99])
def test_each_version_of_landlock_is_asked_for_what_it_knows(
    version: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[int, tuple[Any, ...]]] = []

    def system_call(number: int, *arguments: Any) -> int:
        calls.append((number, arguments))
        return version if arguments[-1] == sandbox.QUERY_VERSION else os.dup(0)

    monkeypatch.setattr(sandbox, "system_call", system_call)
    monkeypatch.setattr(sandbox.ctypes, "CDLL", lambda *_, **__: type("", (), {"prctl": lambda *_: 0})())
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(sandbox.tempfile, "tempdir", None)
    Sandbox(read=(sys.executable,), write=(str(tmp_path / "made"),)).enter()
    assert (tmp_path / "made").is_dir()
    _, (fields, size, _) = next(call for call in calls if call[0] == sandbox.CREATE_RULESET and call[1][0])
    handled = struct.unpack(f"{size // 8}Q", fields)
    bits = {1: 13, 2: 14, 3: 15, 4: 15}.get(version, 16)
    assert handled == ((1 << bits) - 1, *([3] if version >= 4 else []), *([3] if version >= 6 else []))
    rules = [struct.unpack("=Qi", call[1][2])[0] for call in calls if call[0] == sandbox.ADD_RULE]
    assert len(rules) > 10 and all(rights & ~handled[0] == 0 for rights in rules)
    assert calls[-1][0] == sandbox.RESTRICT_SELF


def test_without_landlock_a_process_is_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(number: int, *arguments: Any) -> int:
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(sandbox, "system_call", refuse)
    assert sandbox.landlock_version() == 0
    Sandbox(read=("/nowhere",)).enter()
    assert Path("/proc/self/environ").read_bytes()
