"""Assessments in a terminal: one log in full, several as a ranking with groups that share a period."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from servoscope.assessment.assess import Assessment
from servoscope.cli.render.results import INDENT, print_notes, print_result_table, print_title
from servoscope.core.messages import say, translate
from servoscope.report.assessment_page import assessment_size, fact_table, ranking_table
from servoscope.report.format_values import DASH
from servoscope.report.loop_ranking import group_by_period
from servoscope.report.page import ResultTable


def print_assessment(out: Console, a: Assessment) -> None:
    """Print the verdict and its reason, the facts, and what to do."""
    print_title(out, a.recording, f": {assessment_size(a)}")
    colour = {"nothing conspicuous": "green", "cannot tell": "yellow"}.get(a.verdict, "red")
    head = translate(a.verdict)
    words = f"{head[:1].upper()}{head[1:]}: {a.reason}"
    out.print(Padding(Text(words, style=f"bold {colour}"), INDENT, expand=False))
    if a.facts:
        print_result_table(out, fact_table(a).without("Source"))
    print_notes(out, [a.advice], "green", "-")


def print_ranking(out: Console, ranked: Sequence[Assessment]) -> None:
    """Print the worst loops first, and which of them oscillate together."""
    table = ranking_table(ranked)
    rows = [
        (log, DASH if verdict == "nothing conspicuous" else translate(verdict), *others)
        for log, verdict, *others in table.rows
    ]
    print_result_table(out, ResultTable(table.head, rows, table.words))
    for group in group_by_period(ranked):
        names = [a.recording for a in group]
        print_notes(out, [say("assess.group", names=names, period=group[0].value("oscillation"), source=names[0])])
