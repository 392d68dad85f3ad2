"""An inspection as one self-contained HTML page, and its tables, which a terminal prints too."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from servoscope.core.messages import say, translate
from servoscope.learning.inspection import Inspection
from servoscope.models.loop import Loop
from servoscope.report.format_values import DASH, format_duration, format_percent
from servoscope.report.page import ResultTable, render_page, write_page
from servoscope.signals import Recording

KINDS = {"usable": "healthy", "usable with care": "care", "not usable": "fault"}  # classes of report.css


def write_inspection_page(path: str | Path, inspection: Inspection, recording: Recording) -> None:
    """Write the page on an inspection; nothing half-written stays behind.

    Raises OutputError if the file cannot be written.
    """
    write_page(path, render_inspection_page(inspection, recording))


def render_inspection_page(inspection: Inspection, recording: Recording) -> str:
    """Return the page that `write_inspection_page` writes; it needs nothing from outside, no script and no network."""
    from servoscope.report.inspection_figures import plot_inspection  # late: matplotlib takes half a second to import
    from servoscope.report.plotting import render_svg

    named = inspection.loop not in (None, Loop.model_fields["name"].default)
    model = "loop" if named else "loop_file" if inspection.loop is not None else "generic"
    return render_page(
        "inspection.html",
        title=f"{inspection.recording}: {translate(inspection.verdict)}",
        kind=KINDS[inspection.verdict],
        inspection=inspection,
        size=inspection_size(inspection),
        model=say(f"report.inspected.{model}", loop=inspection.loop),
        figures=[
            (name, render_svg(figure, f"f{i}"))
            for i, (name, figure) in enumerate(plot_inspection(inspection, recording))
        ],
        excitation=excitation_table(inspection),
        numbers=list(_numbers(inspection)),
    )


def inspection_size(inspection: Inspection) -> str:
    """Return how long the recording is."""
    s = inspection.sampling
    samples = say("report.samples", samples=s.samples, rate=f"{s.sample_rate_hz:.6g}")
    return f"{format_duration(s.duration_s)}, {samples}"


def stretches(inspection: Inspection) -> str:
    """Return how many runs and stretches without a gap the recording has."""
    s = inspection.sampling
    longest = format_duration(s.longest_stretch_s)
    return say("report.stretches", stretches=s.stretches, runs=s.runs, longest=longest, missing=s.missing_percent)


def excitation_table(inspection: Inspection) -> ResultTable:
    """Return what the recording says at each monitored frequency."""
    rows = [
        (
            f"{at.frequency_hz:g} Hz",
            *(f"{x:.3f}" if x is not None else DASH for x in (at.coherence_u, at.coherence_y)),
            f"{at.snr:.3g}" if at.snr is not None else DASH,
            format_percent(at.relative_std),
        )
        for at in inspection.frequencies
    ]
    return ResultTable(("Frequency", "Coherence r, u", "Coherence r, y", "Signal / noise", "iFRF std."), rows)


def _numbers(inspection: Inspection) -> Iterator[tuple[str, str]]:
    yield "sampling", stretches(inspection)
    if inspection.suggested_cutoff_hz is not None:
        yield "cutoff", say("report.cutoff", frequency=inspection.suggested_cutoff_hz)
    for q in inspection.quantisation:
        grid = say("report.no_grid") if q.step is None else say("report.grid", step=q.step, bits=q.effective_bits)
        yield f"resolution of {q.signal}", say("report.resolution", grid=grid, share=format_percent(q.repeated))
    for order in inspection.orders:
        model = say("report.stiffness" if order.stiffness else "report.order", n=order.order, friction=order.friction)
        yield say("report.inverse", model=model), say("report.explains", share=format_percent(order.explained))
    if inspection.fit is not None:
        for name, coefficient in inspection.fit.coefficients.items():
            yield name, say("report.coefficient", value=coefficient.value, std=coefficient.std)
        yield (
            "condition number",
            say("report.weakest", condition=inspection.fit.condition, weakest=inspection.fit.weakest),
        )
