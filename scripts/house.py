#!/usr/bin/env python3
"""Counts the structure of src/servoscope: sizes, comments, and names that several things have.

    python scripts/house.py                                     a table
    python scripts/house.py --compare scripts/house-1.0.json    beside the figures of an earlier release
    python scripts/house.py --json                              the figures alone, for a later --compare
    python scripts/house.py --bounds                            lower the bounds that tests/project/test_house.py holds
    python scripts/house.py --reach                             in addition, what one log reaches: it runs the package

It needs nothing but Python, but for ``--reach``. What is a rule is in ``tests/project/test_architecture.py`` and
``test_names.py``.
"""

from __future__ import annotations

import argparse
import ast
import io
import itertools
import json
import math
import re
import statistics
import subprocess
import sys
import tokenize
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

PACKAGE = Path("src", "servoscope")
ENTRY = {"__init__", "__main__"}  # the two modules that belong at the top
LONG = 300
FUNCTION = ast.FunctionDef | ast.AsyncFunctionDef

# What names a kind of thing, in code without comments and docstrings.
KINDS = {
    "covariates": r"[Cc]ovariate",
    "operating points": r"operating_?point|OperatingPoint",
    "features": r"[Ff]eature(Model|Evidence|Monitor|_spans)",
    "arms": r"Arm[A-Z]|is_arm",
    "pressures": r"Pressure(Model|Layout)|pressure_(model|evidence)",
    "sequential test": r"sequential|cusum",
}
ARM_QUESTION = r"isinstance\(.*ArmBaseline|AnyBaseline|is_arm"
METHOD = {
    "baseline",
    "detection",
    "isolation",
    "evidence",
    "diagnosis",
    "estimation",
    "learning",
    "fit",
    "design",
    "prognosis",
}
PRODUCTS = {"service", "web", "fleet", "export", "cli"}
MIN_FIELDS, MIN_SHARED = 4, 0.6  # of two records that are nearly the same

# What tells a tool something, not a reader.
DIRECTIVE = re.compile(r"#(?:!|\s*(?:noqa|type:\s*ignore|pragma\b|fmt:|mypy:|ruff:|isort:|-\*-))")


@dataclass(frozen=True)
class Source:
    """One file of the package, read and parsed once.

    Parameters
    ----------
    path:
        Relative to the package, as in ``models/plants/eha.py``.
    text, tree:
        Its content.
    """

    path: Path
    text: str
    tree: ast.Module

    @property
    def lines(self) -> int:
        """The number of lines."""
        return self.text.count("\n")

    @cached_property
    def nodes(self) -> list[ast.AST]:
        """The nodes of its tree: walking them takes longer than anything that is done with them."""
        return list(ast.walk(self.tree))

    @cached_property
    def classes(self) -> list[str]:
        """The names of all classes, private and nested ones too."""
        return [node.name for node in self.nodes if isinstance(node, ast.ClassDef)]


def read(package: Path) -> list[Source]:
    """Return the Python files of a package, in the order of their paths."""
    sources = []
    for path in sorted(package.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        sources.append(Source(path.relative_to(package), text, ast.parse(text, str(path))))
    return sources


def repeated(names: Iterable[tuple[str, Path]]) -> dict[str, list[Path]]:
    """Return the names that stand twice or more, with the files of each."""
    places: dict[str, list[Path]] = defaultdict(list)
    for name, path in names:
        places[name].append(path)
    return {name: paths for name, paths in sorted(places.items()) if len(paths) > 1}


def repeated_classes(sources: Iterable[Source]) -> dict[str, list[Path]]:
    """Return the class names that occur twice or more."""
    return repeated((name, source.path) for source in sources for name in source.classes)


def repeated_functions(sources: Iterable[Source]) -> dict[str, list[Path]]:
    """Return the names of top-level functions that stand in two files or more."""
    return repeated(
        (name, source.path)
        for source in sources
        for name in sorted({node.name for node in source.tree.body if isinstance(node, FUNCTION)})
    )


def repeated_modules(sources: Iterable[Source]) -> dict[str, list[Path]]:
    """Return the file names that stand in two folders or more, ``__init__`` apart."""
    return repeated((source.path.stem, source.path) for source in sources if source.path.stem not in ENTRY)


def statements_of(source: Source) -> int:
    """Count the statements, without docstrings."""
    total = 0
    for node in source.nodes:
        total += isinstance(node, ast.stmt)
        if isinstance(node, ast.Module | ast.ClassDef | FUNCTION):
            total -= ast.get_docstring(node, clean=False) is not None
    return total


def function_lengths(source: Source) -> list[int]:
    """Return the lines of each function, methods and inner functions too, from ``def`` to its last line."""
    functions = (node for node in source.nodes if isinstance(node, FUNCTION))
    return [(node.end_lineno or node.lineno) - node.lineno + 1 for node in functions]


def comments_of(text: str) -> tuple[int, int]:
    """Count the lines that hold nothing but a comment, and those that end in one."""
    alone = trailing = 0
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT and not DIRECTIVE.match(token.string):
            if token.line[: token.start[1]].strip():
                trailing += 1
            else:
                alone += 1
    return alone, trailing


def code_of(source: Source) -> str:
    """Return the code, without comments and docstrings; nothing of a file in which nothing is looked for."""
    if not any(re.search(pattern, source.text) for pattern in (*KINDS.values(), ARM_QUESTION)):
        return ""
    bare = ast.parse(source.text)
    for node in ast.walk(bare):
        if isinstance(node, ast.Module | ast.ClassDef | FUNCTION) and ast.get_docstring(node, clean=False) is not None:
            node.body = node.body[1:] or [ast.Pass()]
    return ast.unparse(bare)


def files_outside(codes: dict[Path, str], pattern: str) -> int:
    """Count the files that match, but for those in the folder at the top that has most of them."""
    homes = Counter(path.parts[0] for path, code in codes.items() if re.search(pattern, code))
    return sum(homes.values()) - max(homes.values(), default=0)


def imported_names(sources: Iterable[Source]) -> set[str]:
    """Return the names of the method that products import."""
    names = set()
    for source in sources:
        for node in source.nodes if source.path.parts[0] in PRODUCTS else ():
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[1:2] and not node.level:
                names |= {alias.name for alias in node.names if str(node.module).split(".")[1] in METHOD}
    return names


def similar_records(sources: Iterable[Source]) -> list[tuple[str, str]]:
    """Return the pairs of classes whose fields have mostly the same names."""
    fields = {}
    for source in sources:
        for node in source.nodes:
            if isinstance(node, ast.ClassDef):
                own = {
                    part.target.id
                    for part in node.body
                    if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name)
                }
                if len(own) >= MIN_FIELDS:
                    fields[f"{source.path}:{node.name}"] = own
    return [
        (a, b)
        for (a, first), (b, second) in itertools.combinations(fields.items(), 2)
        if len(first & second) >= MIN_SHARED * min(len(first), len(second))
    ]


def measure_reach(sources: list[Source]) -> dict[str, float]:
    """Return what learning, diagnosing and monitoring one log reach, in a process of its own."""
    script = Path(__file__).with_name("reach.py")
    told = json.loads(subprocess.run([sys.executable, script], check=True, capture_output=True, text=True).stdout)
    modules = set(told["modules"])
    reached = [source for source in sources if ".".join(source.path.with_suffix("").parts) in modules]
    return {
        "reach": sum(statements_of(source) for source in reached),
        "reach_modules": len(reached),
        "callers": max(count for package, count in told["callers"].items() if package in METHOD),
    }


def measure(sources: list[Source]) -> dict[str, float]:
    """Return the figures."""
    codes = {source.path: code_of(source) for source in sources}
    foreign = [code for path, code in codes.items() if "arm" not in path.parts and "arm" not in path.stem.split("_")]
    lengths = sorted(length for source in sources for length in function_lengths(source)) or [0]
    comments = [comments_of(source.text) for source in sources]
    return {
        "lines": sum(source.lines for source in sources),
        "nonblank_lines": sum(bool(line.strip()) for source in sources for line in source.text.splitlines()),
        "statements": sum(statements_of(source) for source in sources),
        "files": len(sources),
        "packages": len({source.path.parts[0] for source in sources if len(source.path.parts) > 1}),
        "loose_modules": sum(len(source.path.parts) == 1 and source.path.stem not in ENTRY for source in sources),
        "function_median": statistics.median(lengths),
        "function_p99": lengths[math.ceil(0.99 * len(lengths)) - 1],
        "longest_file": max((source.lines for source in sources), default=0),
        "long_files": sum(source.lines > LONG for source in sources),
        "classes": sum(len(source.classes) for source in sources),
        "comment_lines": sum(alone for alone, _ in comments),
        "trailing_comments": sum(trailing for _, trailing in comments),
        "repeated_classes": len(repeated_classes(sources)),
        "repeated_functions": len(repeated_functions(sources)),
        "repeated_modules": len(repeated_modules(sources)),
        **{f"outside_{kind}": files_outside(codes, pattern) for kind, pattern in KINDS.items()},
        "arm_questions": sum(bool(re.search(ARM_QUESTION, line)) for code in foreign for line in code.splitlines()),
        "method_names": len(imported_names(sources)),
        "similar_records": len(similar_records(sources)),
    }


def _number(value: float) -> str:
    return f"{value:,.10g}".replace(",", " ")


def _plain(key: str) -> Callable[[dict[str, float]], str]:
    return lambda figures: _number(figures[key])


def _share(part: str, whole: str) -> Callable[[dict[str, float]], str]:
    return lambda figures: f"{_number(figures[part])} ({100 * figures[part] / max(figures[whole], 1):.1f} %)"


ROWS: list[tuple[str, Callable[[dict[str, float]], str]]] = [
    ("lines", _plain("lines")),
    ("statements, docstrings apart", _plain("statements")),
    ("files", _plain("files")),
    ("packages: folders at the top", _plain("packages")),
    ("loose modules at the top", _plain("loose_modules")),
    ("lines of a function: median", _plain("function_median")),
    ("lines of a function: 99th percentile", _plain("function_p99")),
    ("lines of the longest file", _plain("longest_file")),
    (f"files of more than {LONG} lines", _share("long_files", "files")),
    ("comment lines", _share("comment_lines", "nonblank_lines")),
    ("code lines that end in a comment", _share("trailing_comments", "nonblank_lines")),
    ("class names that occur twice or more", _plain("repeated_classes")),
    ("names of top-level functions in two files or more", _plain("repeated_functions")),
    ("file names in two folders or more", _plain("repeated_modules")),
    *((f"files that name {kind}, outside their main folder", _plain(f"outside_{kind}")) for kind in KINDS),
    ("lines outside files of arms that ask for one", _plain("arm_questions")),
    ("names of the method that products import", _plain("method_names")),
    (
        f"pairs of records of {MIN_FIELDS} fields that share {100 * MIN_SHARED:.0f} % of their names",
        _plain("similar_records"),
    ),
]
REACH = [
    ("statements that learning, diagnosing and monitoring one log import", _plain("reach")),
    ("modules that they import", _plain("reach_modules")),
    ("files that call into one package of the method during one diagnosis: most", _plain("callers")),
]


def table(now: dict[str, float], before: dict[str, float] | None = None) -> str:
    """Return the figures as a table in Markdown."""
    columns = [now] if before is None else [before, now]
    shown = [*ROWS, *(REACH if "reach" in now else ())]
    rows = [[label, *(show(figures) for figures in columns)] for label, show in shown]
    head = ["`src/servoscope`", "now"] if before is None else ["`src/servoscope`", "before", "now"]
    widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]

    def line(cells: list[str]) -> str:
        first, *others = cells
        numbers = [cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True)]
        return f"| {' | '.join([first.ljust(widths[0]), *numbers])} |"

    rule = "|" + "|".join("-" * (w + 2) if k == 0 else "-" * (w + 1) + ":" for k, w in enumerate(widths)) + "|"
    return "\n".join([line(head), rule, *map(line, rows)])


def lower_bounds(path: Path, figures: dict[str, float]) -> None:
    """Replace the bounds in a file that the figures are below."""
    bounds = json.loads(path.read_text(encoding="utf-8"))
    lower = {name: min(bound, figures[name]) for name, bound in bounds.items()}
    path.write_text(json.dumps(lower, indent=2) + "\n", encoding="utf-8")


def main() -> int:
    """Run as a command."""
    parser = argparse.ArgumentParser(description="Measure the structure of src/servoscope.")
    parser.add_argument("--root", type=Path, default=Path(__file__).resolve().parent.parent, help="the project")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    parser.add_argument("--compare", type=Path, metavar="FILE.json", help="figures of an earlier --json")
    parser.add_argument("--bounds", action="store_true", help="lower the stored bounds to what is better now")
    parser.add_argument("--reach", action="store_true", help="run one log, and count what it reaches")
    given = parser.parse_args()
    sources = read(given.root / PACKAGE)
    if not sources:
        parser.error(f"no Python files in {given.root / PACKAGE}")
    now = measure(sources) | (measure_reach(sources) if given.reach else {})
    if given.bounds:
        lower_bounds(Path(__file__).with_name("house-bounds.json"), now)
    if given.json:
        print(json.dumps(now, indent=2))
        return 0
    print(table(now, json.loads(given.compare.read_text(encoding="utf-8")) if given.compare else None))
    return 0


if __name__ == "__main__":
    sys.exit(main())
