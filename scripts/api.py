#!/usr/bin/env python3
"""Writes docs/reference/api.md from the docstrings of the public names: a page that is readable without being rendered.

scripts/api.py            print the page
scripts/api.py --write    write it; a test compares
"""

from __future__ import annotations

import functools
import inspect
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import servoscope

PAGE = Path(__file__).resolve().parent.parent / "docs" / "reference" / "api.md"
SECTIONS = ("Parameters", "Returns", "Raises", "Examples")
ORDER = (
    "init", "read", "read_parts", "Recording", "Loop", "inspect", "learn", "relearn", "Baseline", "diagnose",
    "Diagnosis", "Monitor", "Trace", "plot", "write_report", "NoveltyDetector", "simulate", "design_study", "reproduce",
)  # fmt: skip
INTRODUCTION = """# Python, in detail

What the docstrings say; `help(servoscope.read)` shows the same. All public names in short: [Python](python.md). The
examples run in the folder that `servoscope tutorial` makes, after the steps of the [tutorial](../tutorial.md); tests
run them there.
"""


def formatted(doc: str) -> str:
    """Return a docstring in the format of numpydoc as Markdown: entries as lists, examples as code."""
    parts = re.split(rf"^({'|'.join(SECTIONS)})\n-+\n", doc, flags=re.M)
    lines = [parts[0].strip()]
    for heading, body in zip(parts[1::2], parts[2::2], strict=True):
        if heading == "Examples":
            lines.append(f"**{heading}**\n\n```pycon\n{body.strip()}\n```")
            continue
        # an entry begins at the margin, and its text is indented below it
        entries = re.findall(r"^(\S.*)\n((?:[ ]{4}.*(?:\n|\Z))*)", body + "\n", flags=re.M)
        listed = [f"- `{name}`: {' '.join(text.split())}" if text else f"\n{name}" for name, text in entries]
        lines.append(f"**{heading}**\n\n" + "\n".join(listed))
    return "\n\n".join(lines)


def signature(name: str, thing: object) -> str:
    """Return a call without annotations: ``learn(loop, recordings, *, compare=None)``."""
    found = inspect.signature(thing)  # type: ignore[arg-type]
    plain = [each.replace(annotation=each.empty) for each in found.parameters.values() if each.name != "self"]
    text = name + str(found.replace(parameters=plain, return_annotation=found.empty))
    return re.sub(r"=<[^,]*(?=[,)])", "=...", text)  # a function has no text of its own


def members(name: str, thing: type) -> Iterator[str]:
    """Yield a section for each documented method, and one line for each property."""
    own = {key: value for key, value in vars(thing).items() if not key.startswith("_") and inspect.getdoc(value)}
    facts = [key for key, value in own.items() if isinstance(value, property | functools.cached_property)]
    if facts:
        yield "\n".join(f"- `.{key}`: {' '.join((inspect.getdoc(own[key]) or '').split())}" for key in facts)
    for key in own:
        method = getattr(thing, key)
        if callable(method):
            yield f"### `{signature(f'{name}.{key}', method)}`\n\n{formatted(inspect.getdoc(method) or '')}"


def render() -> str:
    """Return the page."""
    parts = [INTRODUCTION.strip()]
    for name in ORDER:
        thing = getattr(servoscope, name)
        call = name if inspect.isclass(thing) and name != "Monitor" else signature(name, thing)
        parts.append(f"## `{call}`\n\n{formatted(inspect.getdoc(thing) or '')}")
        if inspect.isclass(thing):
            parts += members(name, thing)
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    if "--write" in sys.argv[1:]:
        PAGE.write_text(render(), encoding="utf-8")
    else:
        print(render(), end="")
