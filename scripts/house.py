#!/usr/bin/env python3
"""Measures the structure of src/servoscope: sizes, names, comments, and what stands twice.

    python scripts/house.py                                     a table
    python scripts/house.py --compare scripts/house-0.1.json    beside the figures of an earlier release
    python scripts/house.py --json                              the figures alone, for a later --compare
    python scripts/house.py --offenders                         the table, and below it the names behind the counts

It needs nothing but Python. ``tests/project/test_architecture.py`` uses its functions and holds the figures that are rules.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import math
import re
import statistics
import sys
import tokenize
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

PACKAGE = Path("src", "servoscope")
ENTRY = {"__init__", "__main__"}  # the two modules that belong at the top
LONG = 300
FUNCTION = ast.FunctionDef | ast.AsyncFunctionDef

# Participles that do not end in -ed, and `since`, which names nothing either. Not here: forms that are a noun of the
# field or a plain verb as well (bound, cut, fit, put, read, run, set, split).
_IRREGULAR = """
arisen awoken beaten become begun bent bitten blown born borne bought broken brought built caught chosen come dealt done
drawn driven eaten fallen felt fled flown forgotten found fought frozen given gone grown heard held hidden hung kept
known laid learnt left lent lost made meant met overheard overtaken paid proven ridden risen said seen sent shaken shown
slept sold sought spelt spent spoken spun stolen stood struck stuck swept sworn taken taught thought thrown told torn
undone understood unheard unseen won worn woven written
since
"""
IRREGULAR = frozenset(_IRREGULAR.split())

# Words in -ing and -ed that count nowhere, with the reason. A participle that could stand there as a plain adjective
# (`fitted`, `measured`, `weighted`) is no exception: the thing has a noun.
EXCEPTIONS: dict[str, str] = {
    # not formed from a verb at all
    "string": "no participle",
    "ring": "no participle: a ring buffer",
    "spring": "no participle: a mechanical spring",
    "thing": "no participle",
    "nothing": "no participle",
    "speed": "no participle: a signal",
    "seed": "no participle: of random numbers",
    "feed": "no participle: a feed of data, feed rate",
    "need": "no participle",
    "exceed": "no participle: the infinitive",
    "embed": "no participle: the infinitive",
    "red": "no participle: the colour",
    "hundred": "no participle: the number",
    # parts and properties of a machine
    "bearing": "noun: the machine part",
    "gearing": "noun: the machine part",
    "coupling": "noun: the machine part; coupling between axes",
    "damping": "noun: the coefficient",
    # control, signals and statistics
    "tuning": "noun: of an estimator or a controller",
    "tracking": "noun: tracking error, control's word for following a reference",
    "settling": "noun: settling time",
    "sampling": "noun: sampling time, sampling rate",
    "timing": "noun: of samples or of a benchmark",
    "filtering": "noun: of signals",
    "smoothing": "noun: of signals",
    "whitening": "noun: of noise",
    "forgetting": "noun: forgetting factor of a recursion",
    "rounding": "noun: rounding error",
    "scaling": "noun: of variables",
    "scoring": "noun: of detectors",
    "learning": "noun: as in machine learning; the package",
    "monitoring": "noun: condition monitoring, the field itself",
    "engineering": "noun: the profession",
    # data and software
    "recording": "noun: the data of one measurement, the product's central record",
    "reading": "noun: the value that an instrument shows",
    "setting": "noun: what a user configures",
    "warning": "noun: as in the standard library",
    "logging": "noun: as in the standard library",
    "finding": "noun: one result of an inspection or audit",
    "streaming": "noun: Spark Structured Streaming",
    "plotting": "noun: as in matplotlib and pandas",
    "housekeeping": "noun: of a service",
}

# Pairs of words that are one term.
TERMS: dict[tuple[str, str], str] = {
    ("closed", "loop"): "control's term",
    ("sliding", "window"): "the estimator's name in the literature",
    ("coloured", "noise"): "term of statistics",
    ("fixed", "point"): "term of arithmetic and of analysis",
    ("mean", "squared"): "term of statistics",
    ("shared", "memory"): "term of operating systems",
}

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
    def module(self) -> str:
        """The name that a reader gives it: the folder's for an ``__init__``."""
        return self.path.parent.name or "servoscope" if self.path.stem == "__init__" else self.path.stem

    @property
    def lines(self) -> int:
        """The number of lines."""
        return self.text.count("\n")

    @cached_property
    def classes(self) -> list[str]:
        """The names of all classes, private and nested ones too."""
        return [node.name for node in ast.walk(self.tree) if isinstance(node, ast.ClassDef)]


def read(package: Path) -> list[Source]:
    """Return the Python files of a package, in the order of their paths."""
    sources = []
    for path in sorted(package.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        sources.append(Source(path.relative_to(package), text, ast.parse(text, str(path))))
    return sources


def words_of(name: str) -> list[str]:
    """Split a name at underscores and capitals: ``_OrderTried`` and ``order_tried`` are both order, tried."""
    parts = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)
    return [part.lower() for part in parts]


def participles_in(name: str) -> list[str]:
    """Return the words of a name that are participles or gerunds, and no exceptions."""
    words = words_of(name)
    for one, other in pairwise(words):
        if (one, other) in TERMS:
            words = [word for word in words if word not in (one, other)]
    return [word for word in words if word in IRREGULAR or (word.endswith(("ing", "ed")) and word not in EXCEPTIONS)]


def repeated(names: Iterable[tuple[str, Path]]) -> dict[str, list[Path]]:
    """Return the names that stand twice or more, with the files of each."""
    places: dict[str, list[Path]] = defaultdict(list)
    for name, path in names:
        places[name].append(path)
    return {name: paths for name, paths in sorted(places.items()) if len(paths) > 1}


def repeated_classes(sources: Iterable[Source]) -> dict[str, list[Path]]:
    """Return the class names that stand twice or more."""
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


def modules_by_participle(sources: Iterable[Source]) -> list[str]:
    """Return the paths of the modules that are named by a participle or gerund."""
    return [source.path.as_posix() for source in sources if participles_in(source.module)]


def classes_by_participle(sources: Iterable[Source]) -> list[str]:
    """Return path and name of the classes that are named by a participle or gerund."""
    return [
        f"{source.path.as_posix()}: {name}" for source in sources for name in source.classes if participles_in(name)
    ]


def statements_of(tree: ast.Module) -> int:
    """Count the statements, without docstrings."""
    total = 0
    for node in ast.walk(tree):
        total += isinstance(node, ast.stmt)
        if isinstance(node, ast.Module | ast.ClassDef | FUNCTION):
            total -= ast.get_docstring(node, clean=False) is not None
    return total


def function_lengths(tree: ast.Module) -> list[int]:
    """Return the lines of each function, methods and inner functions too, from ``def`` to its last line."""
    return [(node.end_lineno or node.lineno) - node.lineno + 1 for node in ast.walk(tree) if isinstance(node, FUNCTION)]


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


def measure(sources: list[Source]) -> dict[str, float]:
    """Return the figures."""
    lengths = sorted(length for source in sources for length in function_lengths(source.tree)) or [0]
    comments = [comments_of(source.text) for source in sources]
    return {
        "lines": sum(source.lines for source in sources),
        "nonblank_lines": sum(bool(line.strip()) for source in sources for line in source.text.splitlines()),
        "statements": sum(statements_of(source.tree) for source in sources),
        "files": len(sources),
        "packages": len({source.path.parts[0] for source in sources if len(source.path.parts) > 1}),
        "loose_modules": sum(len(source.path.parts) == 1 and source.path.stem not in ENTRY for source in sources),
        "function_median": statistics.median(lengths),
        "function_p99": lengths[math.ceil(0.99 * len(lengths)) - 1],
        "longest_file": max((source.lines for source in sources), default=0),
        "long_files": sum(source.lines > LONG for source in sources),
        "modules_by_participle": len(modules_by_participle(sources)),
        "classes": sum(len(source.classes) for source in sources),
        "classes_by_participle": len(classes_by_participle(sources)),
        "comment_lines": sum(alone for alone, _ in comments),
        "trailing_comments": sum(trailing for _, trailing in comments),
        "repeated_classes": len(repeated_classes(sources)),
        "repeated_functions": len(repeated_functions(sources)),
        "repeated_modules": len(repeated_modules(sources)),
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
    ("modules named by a participle or gerund", _share("modules_by_participle", "files")),
    ("classes named by a participle or gerund", _share("classes_by_participle", "classes")),
    ("comment lines", _share("comment_lines", "nonblank_lines")),
    ("code lines that end in a comment", _share("trailing_comments", "nonblank_lines")),
    ("class names that stand twice or more", _plain("repeated_classes")),
    ("names of top-level functions in two files or more", _plain("repeated_functions")),
    ("file names in two folders or more", _plain("repeated_modules")),
]


def table(now: dict[str, float], before: dict[str, float] | None = None) -> str:
    """Return the figures as a table in Markdown."""
    columns = [now] if before is None else [before, now]
    rows = [[label, *(show(figures) for figures in columns)] for label, show in ROWS]
    head = ["`src/servoscope`", "now"] if before is None else ["`src/servoscope`", "before", "now"]
    widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]

    def line(cells: list[str]) -> str:
        first, *others = cells
        numbers = [cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True)]
        return f"| {' | '.join([first.ljust(widths[0]), *numbers])} |"

    rule = "|" + "|".join("-" * (w + 2) if k == 0 else "-" * (w + 1) + ":" for k, w in enumerate(widths)) + "|"
    return "\n".join([line(head), rule, *map(line, rows)])


def offenders(sources: list[Source]) -> str:
    """Return the names behind the counts."""
    lists = {
        f"Files of more than {LONG} lines": [
            f"{source.path.as_posix()}: {source.lines}" for source in sources if source.lines > LONG
        ],
        "Modules named by a participle or gerund": modules_by_participle(sources),
        "Classes named by a participle or gerund": classes_by_participle(sources),
    }
    for title, found in {
        "Class names that stand twice or more": repeated_classes(sources),
        "Names of top-level functions in two files or more": repeated_functions(sources),
        "File names in two folders or more": repeated_modules(sources),
    }.items():
        lists[title] = [f"{name}: {', '.join(path.as_posix() for path in paths)}" for name, paths in found.items()]
    return "\n\n".join("\n".join([f"{title}:", *(f"- {line}" for line in lines)]) for title, lines in lists.items())


def main() -> int:
    """Run as a command."""
    parser = argparse.ArgumentParser(description="Measure the structure of src/servoscope.")
    parser.add_argument("--root", type=Path, default=Path(__file__).resolve().parent.parent, help="the project")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    parser.add_argument("--compare", type=Path, metavar="FILE.json", help="figures of an earlier --json")
    parser.add_argument("--offenders", action="store_true", help="print the names behind the counts too")
    given = parser.parse_args()
    sources = read(given.root / PACKAGE)
    if not sources:
        parser.error(f"no Python files in {given.root / PACKAGE}")
    now = measure(sources)
    if given.json:
        print(json.dumps(now, indent=2))
        return 0
    print(table(now, json.loads(given.compare.read_text(encoding="utf-8")) if given.compare else None))
    if given.offenders:
        print("\n" + offenders(sources))
    return 0


if __name__ == "__main__":
    sys.exit(main())
