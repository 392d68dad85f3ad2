#!/usr/bin/env python3
"""Keeps the figures in documents true: they stand between markers, and programs print them again.

    scripts/figures.py                  compare every page with the stored results; run nothing
    scripts/figures.py --run [NAME...]  run the programs (all, or these) and print what differs from the pages
    scripts/figures.py --quick          the same for the programs marked quick, as CI does
    scripts/figures.py --render         write the pages from the stored results; run nothing
    scripts/figures.py --write [NAME...]  run them, store the results, and write the pages

`benchmarks/figures.toml` names the programs. Each prints, with ``--json``, one JSON object with "tables" (title, note,
columns, rows) and "values" (name -> text). In a page stand

    <!-- table PROGRAM: TITLE -->        ... <!-- end -->      a table with its note
    <!-- value PROGRAM: NAME -->text<!-- end -->               a value in a sentence or a cell
    <!-- measured PROGRAM -->            ... <!-- end -->      commit, versions and date of the run

A rate, as "9 of 10", gets its 95 % interval behind it in the page: the fewer recordings, the less it says.

Results are stored in `benchmarks/figures/PROGRAM.json`, so that a page can be checked without measuring. Of columns and
values that depend on the machine (listed as `volatile`), only the form is compared: every number counts as any other.
"""

from __future__ import annotations

import argparse
import difflib
import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scipy.stats import binomtest

ROOT = Path(__file__).resolve().parent.parent
MARKER = re.compile(r"(?<!`)(<!-- (table|value|measured) ([\w-]+)(?:: ([^>]*?))? -->)(.*?)(<!-- end -->)", re.DOTALL)
NUMBER = re.compile(r"\d+(?:[.,]\d+)?")
RATE = re.compile(r"(?<![\d.])(\d+) of (\d+)(?![\d.]|\w)")


@dataclass(frozen=True)
class Program:
    """A program that prints figures: its command, whether CI runs it, and what of its output depends on the machine."""

    name: str
    command: str
    quick: bool = False
    volatile: tuple[str, ...] = ()


class FigureError(Exception):
    """A page or a program that cannot be used; one line."""


def programs(root: Path) -> dict[str, Program]:
    """Return the programs that `benchmarks/figures.toml` names."""
    table = tomllib.loads((root / "benchmarks" / "figures.toml").read_text(encoding="utf-8"))
    return {
        name: Program(name, given["command"], given.get("quick", False), tuple(given.get("volatile", ())))
        for name, given in table.items()
    }


def pages(root: Path) -> list[Path]:
    """Return the documents that may hold figures."""
    return [*sorted(root.glob("*.md")), *sorted((root / "docs").rglob("*.md")), *(root / "benchmarks").rglob("*.md")]


def run(program: Program, root: Path) -> dict[str, Any]:
    """Run a program and return what it prints, with the commit that it ran on."""
    environment = {**os.environ, "PYTHONPATH": str(root / "src"), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, *shlex.split(program.command), "--json"]
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise FigureError(f"{program.name}: `{program.command}` failed: {last}")
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=root, capture_output=True, text=True, check=False
    )
    return {"commit": commit.stdout.strip() or "unknown", **json.loads(done.stdout)}


def store(root: Path, name: str) -> Path:
    """Return where the results of a program are stored."""
    return root / "benchmarks" / "figures" / f"{name}.json"


def keep(root: Path, name: str, results: Mapping[str, Any]) -> None:
    """Store the results of a program."""
    path = store(root, name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(results, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def load(root: Path, name: str) -> dict[str, Any]:
    """Return the stored results of a program."""
    path = store(root, name)
    if not path.is_file():
        raise FigureError(f"{path.relative_to(root)} is missing: scripts/figures.py --write {name}")
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found


def with_intervals(text: str) -> str:
    """Return a text with the 95 % interval of each rate behind it (Clopper and Pearson, 1934): 9 of 10 (55-99.7 %)."""

    def put(rate: re.Match[str]) -> str:
        successes, trials = int(rate[1]), int(rate[2])
        if not 0 <= successes <= trials or not trials:
            return rate[0]
        ends = binomtest(successes, trials).proportion_ci(method="exact")
        # 99.9 % of 99.97 %, where whole numbers would make 100 %
        low, high = (f"{100.0 * end:.{0 if end in (0.0, 1.0) or 0.01 <= end <= 0.99 else 1}f}" for end in ends)
        return f"{rate[0]} ({low}\N{EN DASH}{high} %)"

    return RATE.sub(put, text)


def text_of(kind: str, key: str, results: Mapping[str, Any], where: str) -> str:
    """Return what belongs between a marker and its end."""
    if kind == "measured":
        return f"{results['machine']}, commit {results['commit']}"
    if kind == "value":
        if key not in results.get("values", {}):
            raise FigureError(f"{where}: no value {key!r}, there are {', '.join(results.get('values', {})) or 'none'}")
        return with_intervals(str(results["values"][key]))
    table = next((one for one in results["tables"] if one["title"] == key), None)
    if table is None:
        titles = ", ".join(repr(one["title"]) for one in results["tables"])
        raise FigureError(f"{where}: no table {key!r}, there are {titles}")
    rows = [[with_intervals(cell) for cell in row] for row in table["rows"]]
    lines = [table["columns"], ["---"] * len(table["columns"]), *rows]
    return f"\n{table['note']}\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def masked(kind: str, key: str, text: str, volatile: Sequence[str]) -> str:
    """Return a text with the numbers that depend on the machine replaced by a sign for any number."""
    if kind == "measured" or key in volatile:
        return NUMBER.sub("#", text) if kind != "measured" else ""
    if kind != "table" or not volatile:
        return text
    lines = text.split("\n")
    head = next((i for i, line in enumerate(lines) if line.startswith("|")), None)
    if head is None:
        return text
    columns = [cell.strip() for cell in lines[head].strip("|").split("|")]
    for i in range(head + 2, len(lines)):
        cells = lines[i].split("|")
        for j, column in enumerate(columns):
            if column in volatile and j + 1 < len(cells) - 1:
                cells[j + 1] = NUMBER.sub("#", cells[j + 1])
        lines[i] = "|".join(cells)
    return "\n".join(lines)


@dataclass(frozen=True)
class Difference:
    """A marker of a page whose text is not what the results say."""

    page: Path
    line: int
    marker: str
    has: str
    should: str

    def __str__(self) -> str:
        if "\n" not in self.should:
            return f"{self.page}:{self.line}: {self.marker} has {self.has!r}, measured {self.should!r}"
        both = difflib.unified_diff(
            self.has.splitlines(), self.should.splitlines(), "page", "measured", lineterm="", n=0
        )
        return f"{self.page}:{self.line}: {self.marker}\n" + "\n".join(f"    {line}" for line in list(both)[2:])


def compare(root: Path, results: Mapping[str, Mapping[str, Any]], known: Mapping[str, Program]) -> Iterator[Difference]:
    """Yield the markers of all pages whose text differs from the results of their programs."""
    for page in pages(root):
        text = page.read_text(encoding="utf-8")
        for found in MARKER.finditer(text):
            _, kind, name, key, has, _ = found.groups()
            where = f"{page.relative_to(root)}:{text.count(chr(10), 0, found.start()) + 1}"
            if name not in known:
                raise FigureError(f"{where}: no program {name!r} in benchmarks/figures.toml")
            if name in results:
                should, key = text_of(kind, key or "", results[name], where), key or ""
                volatile = known[name].volatile
                if masked(kind, key, has, volatile) != masked(kind, key, should, volatile):
                    line = text.count("\n", 0, found.start()) + 1
                    yield Difference(page.relative_to(root), line, f"{kind} {name}: {key}".rstrip(": "), has, should)


def write(root: Path, results: Mapping[str, Mapping[str, Any]]) -> list[Path]:
    """Write the results into the pages; return those that changed."""
    changed = []
    for page in pages(root):
        before = page.read_text(encoding="utf-8")

        def put(found: re.Match[str], page: Path = page) -> str:
            begin, kind, name, key, has, end = found.groups()
            where = str(page.relative_to(root))
            return begin + (text_of(kind, key or "", results[name], where) if name in results else has) + end

        after = MARKER.sub(put, before)
        if after != before:
            page.write_text(after, encoding="utf-8")
            changed.append(page)
    return changed


def main(arguments: Sequence[str] | None = None, root: Path = ROOT) -> int:
    """Run the command line; 1 if a page says something else than the results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", help="programs; all of them if none is named")
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--run", action="store_true", help="run the programs and compare")
    how.add_argument("--quick", action="store_true", help="run the quick programs and compare")
    how.add_argument("--write", action="store_true", help="run the programs, store their results, write the pages")
    how.add_argument("--render", action="store_true", help="write the pages from the stored results")
    given = parser.parse_args(arguments)
    try:
        known = programs(root)
        unknown = [name for name in given.names if name not in known]
        if unknown:
            raise FigureError(f"no program {unknown[0]!r} in benchmarks/figures.toml, there are {', '.join(known)}")
        chosen = [known[name] for name in given.names or known if known[name].quick or not given.quick]
        results: dict[str, dict[str, Any]] = {}
        for program in chosen:
            if given.run or given.quick or given.write:
                print(f"{program.name}: {program.command}", file=sys.stderr, flush=True)
                results[program.name] = run(program, root)
                if given.write:  # at once: a long run that breaks off loses nothing, and later programs may read it
                    keep(root, program.name, results[program.name])
            else:
                results[program.name] = load(root, program.name)
        if given.write or given.render:
            print("\n".join(f"wrote {path.relative_to(root)}" for path in write(root, results)) or "no page changed")
            return 0
        differences = list(compare(root, results, known))
    except FigureError as error:
        print(error, file=sys.stderr)
        return 2
    print("\n".join(map(str, differences)) or f"{len(results)} programs, no page says otherwise")
    return 1 if differences else 0


if __name__ == "__main__":
    sys.exit(main())
