"""Tables of results as Markdown or JSON, and a line that says when and on what they were measured."""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import servoscope


@dataclass(frozen=True)
class Table:
    """One table of results: a title, what it shows, column heads and rows of text."""

    title: str
    note: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def markdown(self) -> str:
        """Return the table with its heading."""
        lines = [self.columns, ("---",) * len(self.columns), *self.rows]
        table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
        return f"## {self.title}\n\n{self.note}\n\n{table}\n"


def parser(description: str | None) -> argparse.ArgumentParser:
    """Return a command line that knows --json."""
    made = argparse.ArgumentParser(description=(description or "").splitlines()[0])
    made.add_argument("--json", action="store_true", help="print one JSON object instead of Markdown")
    return made


def parse_with_data(command: argparse.ArgumentParser, folder: str) -> argparse.Namespace:
    """Parse a command line that also knows --data, where `folder` must be; else it ends with a line that says so."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    command.add_argument("--data", type=Path, default=default, help="folder of the recordings")
    given = command.parse_args()
    if not (given.data / folder).is_dir():
        command.error(f"{given.data}: no recordings there; name their folder with --data")
    return given


def show(tables: Iterable[Table], as_json: bool, values: Mapping[str, str] | None = None) -> None:
    """Print tables under the line of the machine; `values` are figures that stand alone in sentences of documents."""
    made = list(tables)
    if as_json:
        print(
            json.dumps(
                {"machine": machine(), "tables": [asdict(t) for t in made], "values": dict(values or {})}, indent=1
            )
        )
    else:
        print("\n".join([f"{machine()}\n", *(table.markdown() for table in made)]), end="")


def machine() -> str:
    """Say in a line when and on what this runs."""
    import numba
    import numpy

    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        lines = info.read_text(encoding="utf-8").splitlines()
        model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), model)
    versions = f"Python {platform.python_version()}, numpy {numpy.__version__}, numba {numba.__version__}"
    when = time.strftime("%Y-%m-%d")
    return f"servoscope {servoscope.__version__}, {when}, {os.cpu_count()} cores of {model}, {versions}"
