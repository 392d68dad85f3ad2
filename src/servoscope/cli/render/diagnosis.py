"""How a document looks in a terminal: the headline with what to do, what else it could be, statistics on request."""

from __future__ import annotations

import io

from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from servoscope.cli.render.results import (
    COLOURS,
    INDENT,
    create_console,
    print_facts,
    print_notes,
    print_result_table,
    print_title,
)
from servoscope.core.messages import say, translate
from servoscope.diagnosis.result import Diagnosis
from servoscope.report.diagnosis_document import diagnosis_document
from servoscope.report.document import EVIDENCE, HEADLINE, Document, Facts, Notes, Section, with_pictures
from servoscope.report.format_values import format_duration
from servoscope.report.page import ResultTable

MAX_TEXT_WIDTH = 100  # of what `print` of a diagnosis shows


def diagnosis_text(d: Diagnosis) -> str:
    """Return the first part of what is printed: the verdict, what to check, since when, how large, how sure."""
    out = create_console(file=io.StringIO(), width=MAX_TEXT_WIDTH, color_system=None, force_jupyter=False)
    with out.capture() as printed:
        print_diagnosis(out, d, HEADLINE)
    return "\n".join(line.rstrip() for line in printed.get().splitlines())


def print_diagnosis(out: Console, d: Diagnosis, depth: int = EVIDENCE) -> None:
    """Print a verdict, what to check and what it rests on, down to a level of the document."""
    size = f": {format_duration(d.duration_s)}, {d.samples} {translate('samples')}"
    print_title(out, d.recording, size if d.began is None else f"{size}, {say('cli.dates', zone=d.zone or 'local')}")
    print_document(out, diagnosis_document(d), COLOURS[d.verdict], depth)
    if d.reasons and depth == EVIDENCE:
        out.print(Padding(Text(say("cli.folded"), style="dim"), INDENT, expand=False))


def print_document(out: Console, document: Document, colour: str, depth: int) -> None:
    """Print the sections of a document without its pictures, down to a level."""
    first, *others = with_pictures(document)
    out.print(Padding(Text(first.title[:1].upper() + first.title[1:], style=f"bold {colour}"), INDENT, expand=False))
    # what to do comes before the figures that it rests on
    for section in (*(s for s in others if s.level == HEADLINE), first._replace(title="")):
        _print_section(out, section)
    for section in others:
        if HEADLINE < section.level <= depth:
            _print_section(out, section)


def _print_section(out: Console, section: Section) -> None:
    if section.title:
        out.print(f"  {translate(section.title)}:")
    for part in section.body:
        if isinstance(part, Facts):
            print_facts(out, [(translate(f.name).lower(), "; ".join([f.value, *f.lines])) for f in part.facts])
        elif isinstance(part, Notes):
            print_notes(out, part.texts, "blue", "-")
        elif isinstance(part, ResultTable):
            print_result_table(out, part)
