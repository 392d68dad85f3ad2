"""Runs the code blocks of a page as a reader would: in order, in one folder, with what they print compared.

```sh       each line is a command of servoscope, or cd
```python   runs in one namespace per page
```text     what the block before it prints; ... stands for anything, and spaces do not count
`NAME`:     before a block, writes it into that file
"""

from __future__ import annotations

import contextlib
import doctest
import io
import os
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from commands import run

from servoscope.cli.exit import RAN

BLOCK = re.compile(r"(?:^ *`(?P<file>[\w.-]+)`:\n\n)?^ *```(?P<kind>\w*)\n(?P<text>.*?)^ *```$", re.M | re.S)
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


@dataclass(frozen=True)
class CodeBlock:
    """A fenced block of a page: its language, its text, where it stands, and the file that it is for."""

    kind: str
    text: str
    line: int
    file: str | None


def code_blocks(page: Path) -> Iterator[CodeBlock]:
    text = page.read_text(encoding="utf-8")
    for found in BLOCK.finditer(text):
        yield CodeBlock(found["kind"], found["text"], text.count("\n", 0, found.start("kind")) + 1, found["file"])


def command_lines(text: str) -> list[list[str]]:
    """Return the words of each command of a block; a backslash continues a line, # begins a comment."""
    lines = text.replace("\\\n", " ").splitlines()
    return [words for words in (shlex.split(line, comments=True) for line in lines) if words]


def run_page(page: Path, folder: Path, names: dict[str, Any] | None = None) -> int:
    """Run the blocks of a page in a folder and return how many there were; an error names the page and the line."""
    before, count, printed = Path.cwd(), 0, ""
    names = {"__name__": "__main__"} if names is None else names
    os.chdir(folder)
    try:
        for block in code_blocks(page):
            where = f"{page.name}:{block.line}"
            if block.file is not None:
                Path(block.file).write_text(block.text, encoding="utf-8")
            elif block.kind == "sh":
                printed = "".join([_run(words, where) for words in command_lines(block.text)])
            elif block.kind == "python":
                shown = io.StringIO()
                with contextlib.redirect_stdout(shown):
                    exec(compile("\n" * block.line + block.text, str(page), "exec"), names)  # errors name the line
                printed = shown.getvalue()
            elif block.kind == "text":
                plain = printed.replace("\N{NO-BREAK SPACE}", " ")
                same = doctest.OutputChecker().check_output(block.text, plain, FLAGS)
                assert same, f"{where}: the page says\n{block.text}\nand this was printed\n{printed}"
            else:
                continue
            count += 1
    finally:
        os.chdir(before)
    return count


def _run(words: list[str], where: str) -> str:
    if words[0] == "cd":
        os.chdir(words[1])
        return ""
    assert words[0] == "servoscope", f"{where}: {words[0]} is no command that a page may run"
    done = run(*words[1:])
    assert done.code in RAN, f"{where}: {' '.join(words)}: {done.err}"
    return done.out
