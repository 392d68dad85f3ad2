"""Runs a command in this process and keeps its exit code and both streams apart."""

from __future__ import annotations

from dataclasses import dataclass

from typer.testing import CliRunner

from servoscope.cli import app


@dataclass(frozen=True)
class Run:
    """What a command left: exit code, stdout and stderr."""

    code: int
    out: str
    err: str


def run(*words: object) -> Run:
    """Run ``servoscope`` with some words; an unexpected exception is raised here."""
    result = CliRunner(env={"COLUMNS": "80"}).invoke(app, [str(word) for word in words], catch_exceptions=False)
    return Run(result.exit_code, result.stdout, result.stderr)
