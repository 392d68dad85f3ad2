"""Runs commands in this process, keeps exit code and streams apart, and makes the files that they take."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow.csv as pacsv
from typer.testing import CliRunner

from servoscope.cli import app, demo


@dataclass(frozen=True)
class Run:
    """What a command left: exit code, stdout and stderr."""

    code: int
    out: str
    err: str


def run(*words: object, input: str | None = None) -> Run:
    """Run ``servoscope`` with some words; an unexpected exception is raised here."""
    runner = CliRunner(env={"COLUMNS": "80"})
    result = runner.invoke(app, [str(word) for word in words], input=input, catch_exceptions=False)
    return Run(result.exit_code, result.stdout, result.stderr)


def prepared(folder: Path) -> Path:
    """Put loop.toml, healthy.csv, suspect.csv and baseline.json into a folder, by the commands themselves."""
    demo.write_loop_file(folder)
    for step in demo.demo_steps(folder)[:3]:
        assert run(*step.arguments).code == 0
    return folder


def rows_of(path: Path) -> dict[str, Any]:
    table = pacsv.read_csv(path)
    return {name: table.column(name).to_numpy().copy() for name in table.column_names}


def write_rows(path: Path, rows: dict[str, Any]) -> Path:
    lines = [",".join(rows), *(",".join(map(str, row)) for row in zip(*rows.values(), strict=True))]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def one_line(result: Run, *words: str) -> str:
    """Assert that a command refused its input in one line on stderr that has the words."""
    assert result.code == 1, result.err
    (line,) = result.err.splitlines()
    assert line.startswith("servoscope: ")
    for word in words:
        assert word in line
    return line


def loop_with(folder: Path, made: Path, old: str, new: str) -> Path:
    text = (made / "loop.toml").read_text(encoding="utf-8")
    assert old in text
    path = folder / "changed.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return path
