"""The rules of docs/architecture.md, held: who imports whom, what importing costs, what a file looks like."""

from __future__ import annotations

import ast
import json
import os
import re
import statistics
import subprocess
import sys
from collections.abc import Container, Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

from sources import PACKAGE, PROJECT, SOURCES, house, listing

TESTS = sorted((PROJECT / "tests").rglob("*.py"))
SCRIPTS = sorted((PROJECT / "scripts").glob("*.py"))
AT_THE_TOP = {"__init__.py", "__main__.py", "py.typed"}
HEAVY = ("numba", "scipy", "matplotlib", "pyarrow", "h5py", "pandas", "jinja2")
LONG, TOO_LONG = 300, 400
LONG_FUNCTION = 60
ONE_SUBJECT = {  # files of one subject that is read together
    "benchmarks/hostile/targets.py": 450,
    "tests/diagnosis/test_live.py": 450,
}


def rows_of(document: str) -> list[tuple[str, str, list[str]]]:
    """Return package, what it holds and what it may import, from the table of the section Packages."""
    section = document.split("\n## Packages\n")[1].split("\n## ")[0]
    rows = re.findall(r"^\| `(\w+)/` \|(.*)\|([^|]*)\|$", section, flags=re.MULTILINE)
    assert len(rows) == len(re.findall(r"^\|", section, flags=re.MULTILINE)) - 2, "a row that cannot be read"
    return [(package, holds.strip(), re.findall(r"\w+", may)) for package, holds, may in rows]


@cache
def table() -> list[tuple[str, str, list[str]]]:
    return rows_of((PROJECT / "docs" / "architecture.md").read_text(encoding="utf-8"))


def imports_of(source: Any) -> Iterator[tuple[int, str]]:
    """Yield line and dotted name of all that a file imports, wherever in the file that is written."""
    package = ("servoscope", *source.path.parts[:-1])
    for node in ast.walk(source.tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            base = ".".join([*above, *filter(None, [node.module])])
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)


def own_imports(sources: Iterable[Any]) -> dict[str, list[tuple[int, str]]]:
    """Return what each file imports of servoscope."""
    return {
        source.path.as_posix(): [
            (line, name) for line, name in imports_of(source) if name.split(".")[0] == "servoscope"
        ]
        for source in sources
    }


@cache
def imports() -> dict[str, list[tuple[int, str]]]:
    return own_imports(SOURCES)


def forbidden(imports: dict[str, list[tuple[int, str]]], rows: list[tuple[str, str, list[str]]]) -> list[str]:
    """Return the imports that the row of their package does not allow."""
    allowed = {package: {package, "__version__", *may} for package, _, may in rows}
    return [
        f"{path}:{line} imports {name}"
        for path, names in imports.items()
        if path not in AT_THE_TOP
        for line, name in names
        if [*name.split("."), ""][1] not in allowed.get(path.split("/")[0], ())
    ]


def file_of(name: str, files: Container[str]) -> str:
    """Return the file that an import of a dotted name reads: of the name itself, or of the module that it is in."""
    parts = name.split(".")[1:]
    for length in range(len(parts), 0, -1):
        stem = "/".join(parts[:length])
        for path in (f"{stem}.py", f"{stem}/__init__.py"):
            if path in files:
                return path
    return "__init__.py"


def circles(imports: dict[str, list[tuple[int, str]]]) -> list[str]:
    """Return the circles of imports: of each set of files that all reach each other, the shortest from its first."""
    graph = {
        path: sorted({file_of(name, imports) for _, name in names} - {path} - AT_THE_TOP)
        for path, names in imports.items()
        if path not in AT_THE_TOP
    }
    found, seen = [], set()
    for start in sorted(graph):
        paths, waiting = {start: [start]}, [start]
        for path in waiting:  # breadth first, so that each path is a shortest one
            for other in graph[path]:
                if other not in paths:
                    paths[other] = [*paths[path], other]
                    waiting.append(other)
        back = [path for path in waiting if start in graph[path]]
        if back and start not in seen:
            found.append(" -> ".join([*paths[back[0]], start]))
            seen |= {path for path in waiting if start in _reached(graph, path)}
    return found


def _reached(graph: dict[str, list[str]], start: str) -> set[str]:
    reached, waiting = set(), [start]
    while waiting:
        new = [other for other in graph[waiting.pop()] if other not in reached]
        reached.update(new)
        waiting += new
    return reached


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


def test_the_table_names_each_package_once_and_allows_only_earlier_ones() -> None:
    before: list[str] = []
    for package, holds, may in table():
        assert package not in before, f"{package} has two rows"
        assert holds, f"{package}: what does it hold?"
        assert may == [name for name in before if name in may], f"{package}: not above it, or not in order: {may}"
        before.append(package)


def test_the_packages_are_those_of_the_table_and_nothing_else_stands_at_the_top() -> None:
    listed = {package for package, _, _ in table()}
    exist = {path.name for path in PACKAGE.iterdir()} - {"__pycache__"}
    odd, missing = sorted(exist - listed - AT_THE_TOP), sorted((listed | AT_THE_TOP) - exist)
    assert not odd, f"in src/servoscope, and no package of docs/architecture.md:{listing(odd)}"
    assert not missing, f"not in src/servoscope:{listing(missing)}"
    files = {source.path for source in SOURCES}
    bare = sorted({path.parent.as_posix() for path in files if path.parent / "__init__.py" not in files})
    assert not bare, f"folders without __init__.py:{listing(bare)}"


def test_a_package_imports_only_what_its_row_allows() -> None:
    wrong = forbidden(imports(), table())
    assert not wrong, f"{len(wrong)} imports that docs/architecture.md does not allow:{listing(wrong)}"


def test_no_files_import_each_other_in_a_circle() -> None:
    found = circles(imports())
    assert not found, f"circles of imports:{listing(found)}"


def test_what_is_forbidden_is_found_wherever_it_stands(tmp_path: Path) -> None:
    files = {
        "__init__.py": "if TYPE_CHECKING:\n  from servoscope.web.app import App\n",
        "core/errors.py": "from servoscope import __version__\n",
        "core/__init__.py": "from servoscope.core.errors import Error\n",
        "models/__init__.py": "",
        "models/loop.py": "import servoscope\ndef f():\n  from ..web import app\n  from ..core.errors import Error\n",
        "models/plants/__init__.py": "from .eha import Eha\n",
        "models/plants/base.py": "import servoscope.models.plants.eha\nimport numpy.core\n",
        "models/plants/eha.py": "if TYPE_CHECKING:\n  from . import base\nfrom .. import loop\n",
        "models/plants/first.py": "from servoscope.models.plants import Eha\n",
        "web/__init__.py": "",
        "web/app.py": "from servoscope.models import plants\nfrom servoscope import learn\n",
    }
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    document = (
        "# A\n\n## Packages\n\n| package | holds | may import |\n|---|---|---|\n"
        "| `core/` | the `a | b` of all | - |\n| `models/` | x | core |\n| `web/` | x | core models |\n\n## Words\n"
    )
    rows = rows_of(document)
    assert rows == [("core", "the `a | b` of all", []), ("models", "x", ["core"]), ("web", "x", ["core", "models"])]
    names = own_imports(house.read(tmp_path))
    assert forbidden(names, rows) == [
        "models/loop.py:1 imports servoscope",
        "models/loop.py:3 imports servoscope.web.app",
        "web/app.py:2 imports servoscope.learn",
    ]
    # models/plants/__init__.py -> eha -> loop -> app -> it, and base <-> eha in the same set: told once, the shortest.
    assert circles(names) == [
        "models/loop.py -> web/app.py -> models/plants/__init__.py -> models/plants/eha.py -> models/loop.py"
    ]
    names["models/loop.py"] = []
    assert circles(names) == ["models/plants/base.py -> models/plants/eha.py -> models/plants/base.py"]
    names["models/plants/base.py"] = []
    assert circles(names) == []
    names["models/plants/eha.py"] = [(1, "servoscope.models.plants.Other")]
    assert circles(names) == ["models/plants/__init__.py -> models/plants/eha.py -> models/plants/__init__.py"]


def test_importing_loads_nothing_heavy() -> None:
    modules = ["servoscope", "servoscope.models.loop", "servoscope.cli"]
    loaded = json.loads(
        python(
            f"import importlib, json, sys\nloaded = {{}}\nfor module in {modules!r}:\n"
            "    importlib.import_module(module)\n"
            f"    loaded[module] = sorted({{name.split('.')[0] for name in sys.modules}} & {set(HEAVY)!r})\n"
            "print(json.dumps(loaded))"
        )
    )
    assert not any(loaded.values()), f"import these where they are used: {loaded}"


def texts() -> dict[str, str]:
    """Return the Python files of package, tests and scripts, by their path in the project."""
    return {
        **{f"src/servoscope/{source.path.as_posix()}": source.text for source in SOURCES},
        **{path.relative_to(PROJECT).as_posix(): path.read_text(encoding="utf-8") for path in [*TESTS, *SCRIPTS]},
    }


def test_a_file_says_what_it_is_for_in_its_first_line() -> None:
    silent = [
        f"{name} begins with {text.partition(chr(10))[0]!r}"
        for name, text in texts().items()
        if not re.match(r'(#!.*\n)?r?"""\S.*\S', text)
    ]
    assert not silent, f"files must begin with a docstring:{listing(silent)}"


def test_no_file_is_too_long() -> None:
    lengths = {name: text.count("\n") for name, text in texts().items()}
    long = [f"{name}: {lines}" for name, lines in lengths.items() if lines > ONE_SUBJECT.get(name, TOO_LONG)]
    assert not long, f"past {LONG} lines a file is usually two, past {TOO_LONG} always:{listing(long)}"


def test_no_step_of_learning_or_diagnosis_is_a_long_function() -> None:
    long = []
    for source in (source for source in SOURCES if source.path.parts[0] in ("learning", "diagnosis")):
        for node in ast.walk(source.tree):
            if isinstance(node, ast.FunctionDef):
                described = node.body[0] if ast.get_docstring(node) else None
                lines = node.end_lineno - node.lineno + 1
                lines -= described.end_lineno - described.lineno + 1 if described else 0
                long += [f"{source.path}: {node.name}: {lines}"] if lines > LONG_FUNCTION else []
    assert not long, (
        f"a function of more than {LONG_FUNCTION} lines, its docstring apart, is several steps:{listing(long)}"
    )


def test_few_files_are_long() -> None:
    lengths = {source.path.as_posix(): source.lines for source in SOURCES}
    long = [f"{name}: {lines}" for name, lines in lengths.items() if lines > LONG]
    assert len(long) <= len(lengths) / 10, f"at most one file in ten has more than {LONG} lines:{listing(long)}"
    assert statistics.median(lengths.values()) <= LONG / 1.5


def test_the_structure_is_measured(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "rows.py").write_text(
        '"""A."""\n\n# a reason\n# noqa: D100\n'
        'class Told:\n    """B."""\n\n    x = 1  # why\n    y = 2  # type: ignore\n'
    )
    (tmp_path / "rows.py").write_text(
        'def f():\n    """A."""\n    def g():\n        return 1\n    return g\nclass Told: ...\n'
    )
    figures = house.measure(house.read(tmp_path))
    assert {name: value for name, value in figures.items() if value} == {
        "lines": 15,
        "nonblank_lines": 13,
        "statements": 9,
        "files": 2,
        "packages": 1,
        "loose_modules": 1,
        "function_median": 3.5,
        "function_p99": 5,
        "longest_file": 9,
        "classes": 2,
        "comment_lines": 1,
        "trailing_comments": 1,
        "repeated_classes": 1,
        "repeated_modules": 1,
    }
    assert re.search(r"two folders or more +\| +1 \| +1 \|", house.table(figures, figures))


def test_the_reach_of_a_kind_of_thing_is_measured(tmp_path: Path) -> None:
    fields = "a: int\n    b: int\n    c: int\n    d: int\n"
    files = {
        "arm/model.py": '"""All of ArmModel."""\nis_arm = 1\n',
        "arm/day.py": "is_arm = 2\n",
        "web/asset.py": f"x = isinstance(thing, ArmBaseline)\nclass Asset:\n    {fields}",
        "web/words.py": '"""Says nothing of ArmBaseline."""  # is_arm\nfrom servoscope.diagnosis.arm import judge\n',
        "service/row.py": f"from servoscope.core import judge\nclass Row:\n    {fields}    e: int\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    figures = house.measure(house.read(tmp_path))
    names = "outside_arms", "arm_questions", "method_names", "similar_records"
    assert [figures[name] for name in names] == [1, 1, 1, 1]


def plant_questions(source: Any) -> Iterator[int]:
    """Yield the lines that compare the kind of a plant, or ask it for an attribute by name."""
    for node in ast.walk(source.tree):
        if isinstance(node, ast.Compare):
            sides = [ast.unparse(side) for side in (node.left, *node.comparators)]
            if any(re.search(r"\b(plant|declared)\.kind\b", side) for side in sides):
                yield node.lineno
        elif isinstance(node, ast.Call) and re.match(r"(get|has)attr\(([\w.]*[._])?plant,", ast.unparse(node)):
            yield node.lineno


def test_only_plants_ask_what_plant_it_is(tmp_path: Path) -> None:
    outside = [source for source in SOURCES if source.path.parts[:2] != ("models", "plants")]
    wrong = [f"{source.path.as_posix()}:{line}" for source in outside for line in plant_questions(source)]
    assert not wrong, f"a member of `Plant` must say it (models/plants/base.py):{listing(wrong)}"
    (tmp_path / "a.py").write_text(
        'if loop.plant.kind == "eha": ...\nx = getattr(self.plant, "a", 0)\ny = (a.kind, plant.kind) != z\n'
        'text = f"{plant.kind}"\nw = getattr(planted, "a")\n'
    )
    assert [line for source in house.read(tmp_path) for line in plant_questions(source)] == [1, 2, 3]


def test_nothing_is_left_for_later_and_no_path_is_somebodys_own() -> None:
    paths = [
        *TESTS,
        *(PACKAGE / source.path for source in SOURCES),
        *sorted((PROJECT / "docs").rglob("*.md")),
        *sorted(PROJECT.glob("*.md")),
        *(PROJECT / name for name in ("Makefile", "pyproject.toml", "requirements-dev.lock", ".ci/run")),
        *sorted(path for path in (PROJECT / "scripts").iterdir() if path.is_file()),
    ]
    roots = "work|tmp|home|usr|root|opt|var|etc|mnt|srv|Users"
    wrong = []
    for path in paths:
        text = re.sub(r"\A#!.*\n", "", path.read_text(encoding="utf-8"))
        later = re.findall(r"\b(?:TO[D]O|FIX[M]E|XX[X]|HAC[K])\b", text)
        absolute = re.findall(rf"(?<![\w.\-~$/)}}\]>])/(?:{roots})\b[\w./-]*|\b[A-Z]:\\\w+", text)
        wrong += [f"{path.relative_to(PROJECT).as_posix()}: {word}" for word in later + absolute]
    assert not wrong, f"work left for later, or absolute paths:{listing(wrong)}"
