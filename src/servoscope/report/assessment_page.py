"""An assessment as one self-contained HTML page, and its tables, which a terminal prints too."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from servoscope.assessment.assess import Assessment
from servoscope.core.messages import say, translate
from servoscope.report.format_values import DASH, format_duration
from servoscope.report.page import ResultTable, render_page, write_page

KINDS = {"nothing conspicuous": "healthy", "cannot tell": "undetermined"}  # classes of report.css


def write_assessment_page(path: str | Path, assessment: Assessment) -> None:
    """Write the page on an assessment; nothing half-written stays behind.

    Raises OutputError if the file cannot be written.
    """
    write_page(path, render_assessment_page(assessment))


def render_assessment_page(assessment: Assessment) -> str:
    """Return the page that `write_assessment_page` writes; it needs nothing from outside, no script and no network."""
    from servoscope.report.assessment_figures import plot_assessment  # late: matplotlib takes half a second to import
    from servoscope.report.plotting import render_svg

    return render_page(
        "assessment.html",
        title=f"{assessment.recording}: {translate(assessment.verdict)}",
        kind=KINDS.get(assessment.verdict, "fault"),
        assessment=assessment,
        size=assessment_size(assessment),
        facts=fact_table(assessment),
        figures=[(name, render_svg(figure, f"f{i}")) for i, (name, figure) in enumerate(plot_assessment(assessment))],
    )


def assessment_size(a: Assessment) -> str:
    """Return how long the log is."""
    samples = say("report.samples", samples=a.samples, rate=f"{a.sample_rate_hz:.6g}")
    return f"{format_duration(a.samples / a.sample_rate_hz)}, {samples}"


def fact_table(a: Assessment) -> ResultTable:
    """Return one row per fact: value, what it was computed from, and who defined it."""
    rows = [
        (
            translate(fact.name),
            f"{fact.value:.3g} {fact.unit}".strip(),
            ", ".join(f"{translate(name)} {value:.3g}" for name, value in fact.evidence.items()) or DASH,
            fact.source or DASH,
        )
        for fact in a.facts
    ]
    return ResultTable(("Fact", "Value", "Evidence", "Source"), rows, 3)


def ranking_table(ranked: Sequence[Assessment]) -> ResultTable:
    """Return one row per loop: verdict, period, and the facts that rank it."""

    def percent(a: Assessment, *names: str) -> str:
        worst = max(a.value(name, -1.0) for name in names)
        return DASH if worst < 0.0 else f"{worst:.0f} %"

    rows = [
        (
            a.recording,
            a.verdict,
            format_duration(a.value("oscillation")) if a.value("oscillation") else DASH,
            percent(a, "tracking error"),
            percent(a, "u at its upper limit", "u at its lower limit"),
            percent(a, "frozen y"),
        )
        for a in ranked
    ]
    return ResultTable(("Log", "Verdict", "Period", "Error", "At limit", "Frozen"), rows, 1)
