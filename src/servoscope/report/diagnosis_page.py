"""A diagnosis as one self-contained HTML page: the verdict in words, the figures behind it, tables."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from servoscope.baseline.baseline import Baseline
from servoscope.core.messages import say, translate
from servoscope.detection.trace import Trace
from servoscope.diagnosis.diagnose import diagnose_with_trace
from servoscope.diagnosis.motion_signature import MotionSignature, SignatureWidth, compare_signatures
from servoscope.diagnosis.result import Diagnosis
from servoscope.models.loop import Loop
from servoscope.report import diagnosis_figures as figures
from servoscope.report.change_figure import plot_change, shows_change
from servoscope.report.diagnosis_document import LABELS, DiagnosisContext, diagnosis_document
from servoscope.report.document import DETAILS, HEADLINE, Section, to_html
from servoscope.report.format_values import DASH, format_clock_time, format_count, format_quantity, format_with_std
from servoscope.report.page import ResultTable, render_page, write_page
from servoscope.report.plain_values import provenance
from servoscope.report.plots import plot
from servoscope.report.plotting import render_svg
from servoscope.signals import Recording
from servoscope.signals.readers import as_recording
from servoscope.signals.readers.frames import Source

CELL_DPI = 60  # of the picture in a notebook


def write_diagnosis_page(
    path: str | Path,
    diagnosis: Diagnosis,
    trace: Trace,
    recording: Recording,
    loop: Loop,
    provenance: Mapping[str, str],
) -> None:
    """Write the report on one recording; nothing half-written stays behind.

    `provenance`: lines that say where the result comes from, for example the baseline's file and hash, in order.
    Raises OutputError if the file cannot be written.
    """
    write_page(path, render_diagnosis_page(diagnosis, trace, recording, loop, provenance))


def write_report(path: str | Path, baseline: Baseline | str | Path, recording: Recording | Source) -> Diagnosis:
    """Diagnose a recording, write the report on it as one HTML page, and return the diagnosis.

    Parameters
    ----------
    path
        Page to write; nothing half-written stays behind.
    baseline, recording
        As for `diagnose`.

    Raises OutputError if the page cannot be written, and what `diagnose` raises.

    Examples
    --------
    >>> write_report("friday.html", "baseline.json", "friday.csv").verdict
    'fault'
    """
    learned = Baseline.of(baseline)
    judged = as_recording(recording, learned.loop)
    diagnosis, trace = diagnose_with_trace(learned, judged)
    used = learned.at(diagnosis.point) if diagnosis.point else learned
    file = "not from a file" if isinstance(baseline, Baseline) else str(baseline)
    write_diagnosis_page(path, diagnosis, trace, judged, used.loop, provenance(used, file, judged.name))
    return diagnosis


def render_diagnosis_page(
    diagnosis: Diagnosis, trace: Trace, recording: Recording, loop: Loop, provenance: Mapping[str, str]
) -> str:
    """Return the page that `write_diagnosis_page` writes; it needs nothing from outside, no script and no network."""
    signatures = compare_signatures(recording, loop, diagnosis.onset_s[1] if diagnosis.onset_s else None)
    context = DiagnosisContext(
        words={fault.name: fault.words for fault in loop.plant.all_faults},
        units=loop.plant.units,
        coefficient_units=dict(zip(loop.plant.names, loop.plant.coefficient_units, strict=True)),
        trace=trace,
        false_alarms_per_year=loop.monitor.false_alarms_per_year,
        widths=tuple(_widths(*signatures, loop.plant.units)),
    )
    drawn = _figures(diagnosis, trace, recording, loop, signatures)
    pictures = {name: render_svg(figure, name) for name, figure in drawn}
    return to_html(
        (*diagnosis_document(diagnosis, context), _settings(loop, provenance)),
        pictures,
        title=f"{translate(LABELS[diagnosis.verdict])}: {diagnosis.recording}",
        kind=diagnosis.verdict,
        label=LABELS[diagnosis.verdict],
        name=diagnosis.recording,
        about="" if loop.name == Loop.model_fields["name"].default else f"{translate('on')} {loop.name}",
        size=_recording_size(diagnosis, loop),
    )


def render_diagnosis_cell(diagnosis: Diagnosis) -> str:
    """Return what a notebook shows of a diagnosis: its verdict, what to check, its sizes, and a picture of them."""
    sections = [section.drawn() for section in diagnosis_document(diagnosis) if section.level == HEADLINE]
    picture = ""
    if diagnosis.parameters:
        import matplotlib.pyplot as plt  # late: it takes half a second to import

        file = io.BytesIO()
        figure: Any = plot(diagnosis)[0].figure
        figure.savefig(file, format="png", dpi=CELL_DPI)
        plt.close(figure)
        picture = base64.b64encode(file.getvalue()).decode()
    return render_page(
        "notebook.html", d=diagnosis, label=LABELS[diagnosis.verdict], sections=sections, picture=picture
    )


def _recording_size(diagnosis: Diagnosis, loop: Loop) -> list[str]:
    samples, rate = format_count(diagnosis.samples), format_quantity(loop.sample_rate)
    size = [say("report.samples", samples=samples, rate=rate), format_clock_time(diagnosis.duration_s)]
    count = len(diagnosis.warnings)
    return [*size, say("report.warnings", count=count)] if count else size


def _figures(
    diagnosis: Diagnosis,
    trace: Trace,
    recording: Recording,
    loop: Loop,
    signatures: tuple[MotionSignature | None, MotionSignature | None],
) -> Iterator[tuple[str, Figure]]:
    """Yield the pictures of the document by name."""
    yield "statistic", figures.plot_statistic(trace, diagnosis)
    yield "signals", figures.plot_signals(recording, diagnosis, units=loop.plant.units)
    yield "ifrf", figures.plot_ifrf(trace, diagnosis)
    yield "coefficients", figures.plot_coefficients(trace, diagnosis, units=loop.plant.coefficient_units)
    sizes = figures.plot_fault_sizes(diagnosis)
    if sizes is not None:
        yield "sizes", sizes
    before, after = signatures
    if diagnosis.verdict == "fault":
        units, own = loop.plant.units, tuple(loop.plant.coefficient_units)
        yield "change", plot_change(trace, diagnosis, before, after, units=units, coefficient_units=own)
    if after is not None and not (diagnosis.verdict == "fault" and shows_change(before, after)):
        yield "signature", figures.plot_signature(before, after, units=loop.plant.units)


def _widths(
    before: MotionSignature | None, after: MotionSignature | None, units: tuple[str, str]
) -> Iterator[ResultTable]:
    """Yield how far apart both directions are at rest, before the onset and after it."""

    def width(signature: MotionSignature | None, field: str) -> str:
        measured: SignatureWidth | None = getattr(signature, field, None)
        if measured is None:
            return DASH
        return " ± ".join(format_with_std(measured.value, 1.96 * measured.std))

    rows = [
        (translate(name), width(before, field), width(after, field), unit)
        for name, field, unit in (
            ("Friction band", "friction_band", units[1]),
            ("Lost motion", "lost_motion", units[0]),
        )
        if getattr(after, field, None) is not None
    ]
    if rows:
        table = ResultTable(("Width at rest", "Before", "After", "Unit"), rows)
        yield table if units[1] else table.without("Unit")


def _settings(loop: Loop, provenance: Mapping[str, str]) -> Section:
    """Return the settings that a result came about with, table by table of the loop file."""
    sections: dict[str, Mapping[str, Any]] = {"Where this comes from": provenance}
    settings = loop.to_dict()
    sections["Loop"] = {key: value for key, value in settings.items() if not isinstance(value, Mapping)}
    sections |= {f"[{key}]": value for key, value in settings.items() if isinstance(value, Mapping)}
    tables = [
        ResultTable(
            (name, "Value"), [(str(k), _format_setting(x)) for k, x in entries.items() if x is not None], words=2
        )
        for name, entries in sections.items()
    ]
    return Section(
        "Settings",
        tuple(tables),
        DETAILS,
        "Everything that is needed to get the same result again: the loop file and the baseline.",
    )


def _format_setting(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return format_quantity(value)
    if isinstance(value, Mapping):
        return ", ".join(f"{key} = {_format_setting(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_format_setting, value)) or "none"
    return str(value)
