"""The rules of docs/architecture.md, held: who imports whom, what importing costs, what a file looks like."""

from __future__ import annotations

import ast
import os
import re
import statistics
import subprocess
import sys
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parent.parent
PACKAGE = PROJECT / "src" / "servoscope"
SOURCES = sorted(PACKAGE.rglob("*.py"))
TESTS = sorted((PROJECT / "tests").rglob("*.py"))
TEXTS = [
    *SOURCES,
    *TESTS,
    *sorted((PROJECT / "docs").rglob("*.md")),
    *sorted(PROJECT.glob("*.md")),
    *(PROJECT / name for name in ("Makefile", "pyproject.toml", "requirements-dev.lock", ".ci/run")),
    *sorted((PROJECT / "scripts").iterdir()),
]
OUTSIDE = {"__init__", "__main__"}
HEAVY = ("numba", "scipy", "matplotlib", "pyarrow", "h5py", "pandas")
LONG, TOO_LONG = 300, 400


def name_of(path: Path) -> str:
    return path.relative_to(PROJECT).as_posix()


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def rooms_in_order() -> list[str]:
    text = (PROJECT / "docs" / "architecture.md").read_text(encoding="utf-8")
    section = text.split("\n## Rooms\n")[1].split("\n## ")[0]
    return re.findall(r"^\d+\. `(\w+)(?:\.py|/)`: \S", section, flags=re.MULTILINE)


def imports_of(path: Path) -> list[tuple[int, str]]:
    """Return line and dotted name of all that a file imports, wherever in the file that is written."""
    found: list[tuple[int, str]] = []
    package = ("servoscope", *path.relative_to(PACKAGE).parts[:-1])
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            base = ".".join([*above, *filter(None, [node.module])])
            found += [(node.lineno, f"{base}.{alias.name}") for alias in node.names]
    return found


def python(code: str) -> str:
    """Run code in a fresh interpreter that finds the package in src."""
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(PROJECT / "src")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_the_document_lists_the_rooms_that_exist() -> None:
    listed = rooms_in_order()
    assert len(listed) == len(set(listed)), "docs/architecture.md lists a room twice"
    exist = {room_of(path) for path in SOURCES} - OUTSIDE
    unlisted, gone = sorted(exist - set(listed)), sorted(set(listed) - exist)
    assert not unlisted, f"rooms without a line in docs/architecture.md: {', '.join(unlisted)}"
    assert not gone, f"rooms in docs/architecture.md that are not in src/servoscope: {', '.join(gone)}"


@pytest.mark.parametrize("path", [path for path in SOURCES if room_of(path) not in OUTSIDE], ids=name_of)
def test_a_room_imports_only_rooms_above_it(path: Path) -> None:
    order = rooms_in_order()
    room = room_of(path)
    assert room in order, f"{room} has no line in docs/architecture.md"
    allowed = {*order[: order.index(room) + 1], "__version__"}
    if path.parent == PACKAGE:
        allowed.discard(room)
    wrong = [
        f"{name_of(path)}:{line} imports {name}"
        for line, name in imports_of(path)
        if name.split(".")[0] == "servoscope" and [*name.split("."), ""][1] not in allowed
    ]
    assert not wrong, f"{'; '.join(wrong)}: not above {room} in docs/architecture.md"


def test_the_imports_of_a_room_are_found_wherever_they_stand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "PACKAGE", tmp_path)
    path = tmp_path / "plants" / "x.py"
    path.parent.mkdir()
    path.write_text(
        "import servoscope.a\ndef f():\n  from servoscope.b import c\n  from .base import d\n  from .. import e\n"
    )
    names = {name for _, name in imports_of(path)}
    assert names == {"servoscope.a", "servoscope.b.c", "servoscope.plants.base.d", "servoscope.e"}


@pytest.mark.parametrize("module", ["servoscope", "servoscope.loop", "servoscope.cli"])
def test_importing_loads_nothing_heavy(module: str) -> None:
    loaded = python(
        f"import sys, {module}\nprint(*sorted({{name.split('.')[0] for name in sys.modules}} & {set(HEAVY)!r}))"
    )
    assert loaded == "", f"import {module} loads {loaded}: import these where they are used"


def test_importing_is_fast() -> None:
    code = "import time; begin = time.perf_counter(); import servoscope; print(time.perf_counter() - begin)"
    # The best of three: a busy machine makes any one of them slow.
    assert min(float(python(code)) for _ in range(3)) < 0.4


@pytest.mark.parametrize("path", SOURCES + TESTS, ids=name_of)
def test_a_file_says_what_it_is_for_in_its_first_line(path: Path) -> None:
    first = path.read_text(encoding="utf-8").split("\n", 1)[0]
    assert re.match(r'r?"""\S.*\S', first), f"{name_of(path)} must begin with a docstring, not with {first!r}"


@pytest.mark.parametrize("path", SOURCES + TESTS, ids=name_of)
def test_no_file_is_too_long(path: Path) -> None:
    lines = path.read_text(encoding="utf-8").count("\n")
    assert lines <= TOO_LONG, f"{name_of(path)} has {lines} lines: it is usually two rooms past {LONG}"


def test_few_files_are_long() -> None:
    lengths = {name_of(path): path.read_text(encoding="utf-8").count("\n") for path in SOURCES}
    long = {name: lines for name, lines in lengths.items() if lines > LONG}
    assert len(long) <= len(lengths) / 10, f"at most one file in ten may have more than {LONG} lines: {long}"
    assert statistics.median(lengths.values()) <= LONG / 1.5


@pytest.mark.parametrize("path", TEXTS, ids=name_of)
def test_nothing_is_left_for_later_and_no_path_is_somebodys_own(path: Path) -> None:
    text = re.sub(r"\A#!.*\n", "", path.read_text(encoding="utf-8"))
    later = re.findall(r"\b(?:TO[D]O|FIX[M]E|XX[X]|HAC[K])\b", text)
    assert not later, f"{name_of(path)}: do it, or write it down elsewhere: {later}"
    roots = "work|tmp|home|usr|root|opt|var|etc|mnt|srv|Users"
    absolute = re.findall(rf"(?<![\w.\-~$/)}}\]>])/(?:{roots})\b[\w./-]*|\b[A-Z]:\\\w+", text)
    assert not absolute, f"{name_of(path)}: absolute paths {absolute}"
