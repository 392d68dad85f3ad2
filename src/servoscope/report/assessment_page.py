"""An assessment as one self-contained HTML page, and its tables, which a terminal prints too."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from servoscope.assessment.assess import Assessment
from servoscope.core.messages import say, translate
from servoscope.report.format_values import DASH, format_duration, format_percent
from servoscope.report.page import ResultTable, render_page, write_page

KINDS = {"good": "healthy", "cannot tell": "undetermined"}  # classes of report.css


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
        title=f"{assessment.recording}: {assessment.verdict}",
        kind=KINDS.get(assessment.verdict, "fault"),
        assessment=assessment,
        size=assessment_size(assessment),
        facts=list(facts(assessment)),
        causes=cause_table(assessment),
        indices=index_table(assessment),
        figures=[(name, render_svg(figure, f"f{i}")) for i, (name, figure) in enumerate(plot_assessment(assessment))],
    )


def assessment_size(a: Assessment) -> str:
    """Return how long the log is."""
    samples = say("report.samples", samples=a.samples, rate=f"{a.sample_rate_hz:.6g}")
    return f"{format_duration(a.samples / a.sample_rate_hz)}, {samples}"


def facts(a: Assessment) -> Iterator[tuple[str, str]]:
    """Yield sizes with their names, those that the log gives."""
    if a.stiction_percent is not None:
        yield "apparent stiction", say("assess.of_travel", size=a.stiction_percent)
    if a.backlash_percent is not None:
        yield "apparent backlash", say("assess.of_travel", size=a.backlash_percent)
    if a.period_s is not None and a.oscillates:
        yield "period", format_duration(a.period_s)
        yield "regularity", f"{a.regularity:.2g}"
        yield "share of the error's variance", format_percent(a.oscillation_share)
    if a.gain_margin is not None:
        yield "gain margin as seen", f"{a.gain_margin:.2g}"
    if a.performance is not None:
        yield "Harris index", f"{a.performance:.2f}"


def cause_table(a: Assessment) -> ResultTable:
    """Return the probability of each cause, the likeliest first."""
    ordered = sorted(a.probabilities.items(), key=lambda pair: -pair[1])
    return ResultTable(("Cause", "Probability"), [(translate(cause), f"{p:.2f}") for cause, p in ordered if p >= 0.005])


def index_table(a: Assessment) -> ResultTable:
    """Return the textbook indices and the log-likelihoods of the competing models."""
    return ResultTable(("Index", "Value"), [(translate(name), f"{value:.3f}") for name, value in a.indices.items()])


def ranking_table(ranked: Sequence[Assessment]) -> ResultTable:
    """Return one row per loop: verdict, probability, size, period and what to do."""
    rows = [
        (
            a.recording,
            a.verdict,
            f"{a.probability:.2f}",
            DASH if a.period_s is None or not a.oscillates else format_duration(a.period_s),
            DASH if a.performance is None else f"{a.performance:.2f}",
            str(a.reason),
        )
        for a in ranked
    ]
    return ResultTable(("Log", "Verdict", "Probability", "Period", "Harris index", "Reason"), rows, 2)
