"""Each command's help ends with an example that can be parsed, and a reader that has seen enough is no error."""

from __future__ import annotations

import shlex
import subprocess
import sys

import pytest
import typer.main
from commands import run

from servoscope.cli import app
from servoscope.cli.examples import EXAMPLES


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_example_of_a_command_is_one(name: str) -> None:
    words = shlex.split(EXAMPLES[name])
    assert words[0] == "servoscope" and " ".join(words[1:]).startswith(name)
    group = typer.main.get_command(app)
    context = group.make_context("servoscope", words[1:])
    for word in name.split():
        group = group.get_command(context, word)  # type: ignore[attr-defined]
    group.make_context(name, words[1 + len(name.split()) :])
    assert f"Example: {EXAMPLES[name]}" in " ".join(run(*name.split(), "--help").out.split())


def test_the_end_of_a_pipe_is_no_error() -> None:
    command = f"{shlex.quote(sys.executable)} -m servoscope help | head -1"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert done.stderr == ""
