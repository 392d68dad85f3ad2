"""The diagnosis of an arm as one self-contained page: the verdict, the arm with its joints, torques over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from servoscope.arm.baseline import ArmBaseline
from servoscope.arm.diagnosis import ArmExamination
from servoscope.core.messages import say, translate
from servoscope.diagnosis.result import Diagnosis
from servoscope.report.diagnosis_document import LABELS, diagnosis_document
from servoscope.report.document import DETAILS, EVIDENCE, PicturePart, Section, to_html
from servoscope.report.format_values import format_clock_time
from servoscope.report.page import ResultTable, write_page
from servoscope.report.plotting import COLOURS, create_panels, plot_style, render_svg

WIDTH = 7.0  # inches


def write_arm_page(path: str | Path, diagnosis: Diagnosis, examination: ArmExamination, baseline: ArmBaseline) -> None:
    """Write the report on one recording of an arm; raises OutputError if the file cannot be written."""
    write_page(path, render_arm_page(diagnosis, examination, baseline))


def render_arm_page(diagnosis: Diagnosis, examination: ArmExamination, baseline: ArmBaseline) -> str:
    """Return the page; it needs nothing from outside, no script and no network."""
    torque = plot_torque(examination, baseline, diagnosis)
    drawn = {"arm": plot_arm(**examination.picture(baseline, diagnosis)), "torque": torque}
    recordings = ", ".join(source.name for source in baseline.sources)
    origin = ResultTable(
        ("Quantity", "Value"), [(translate("baseline"), baseline.hash), (translate("recordings"), recordings)], words=2
    )
    return to_html(
        (
            *diagnosis_document(diagnosis),
            Section("Torque from outside or unexplained", (PicturePart("torque"),), EVIDENCE, say("arm.page_torque")),
            Section("Where this comes from", (origin,), DETAILS),
        ),
        {name: render_svg(figure, name) for name, figure in drawn.items()},
        title=f"{translate(LABELS[diagnosis.verdict])}: {diagnosis.recording}",
        kind=diagnosis.verdict,
        label=LABELS[diagnosis.verdict],
        name=diagnosis.recording,
        about=f"{translate('on')} {baseline.loop.name}",
        size=[format_clock_time(diagnosis.duration_s)],
    )


@plot_style()
def plot_arm(
    names: Sequence[str], parents: Sequence[int], places: Sequence[Sequence[float]], odds: Sequence[float]
) -> Figure:
    """Draw the arm with its joints at these places [m], filled by their probability of a change."""
    figure, axes = create_panels(3.2, width=WIDTH, subplot_kw={"projection": "3d"})
    for j, place in enumerate(places):
        start = places[parents[j]] if parents[j] >= 0 else (0.0, 0.0, 0.0)
        axes.plot(*np.column_stack([start, place]), color=COLOURS["muted"], linewidth=3.0)
        fill = COLOURS["alarm"] if odds[j] >= 0.5 else COLOURS["care"] if odds[j] >= 0.05 else COLOURS["healthy"]
        axes.plot(*np.array(place)[:, None], "o", color=fill, markersize=7.0)
        axes.text(*place, f"  {names[j]}", fontsize=7.5)
    axes.set_axis_off()
    axes.set_aspect("equal")
    return figure


@plot_style()
def plot_torque(examination: ArmExamination, baseline: ArmBaseline, diagnosis: Diagnosis) -> Figure:
    """Draw what the healthy arm leaves of each joint's torque, with the limits of events and the onset."""
    names, t = baseline.model.arm.names, examination.signals.t
    figure, panels = create_panels(0.9 * len(names) + 0.5, len(names), width=WIDTH, sharex=True, squeeze=False)
    for j, axes in enumerate(panels[:, 0]):
        limit = baseline.event_limits[j] * baseline.noise[j]
        axes.plot(t, examination.outside[j], color=COLOURS["ink"], linewidth=0.8)
        for level in (-limit, limit):
            axes.axhline(level, color=COLOURS["muted"], linewidth=0.7, linestyle="--")
        for event in examination.events:
            axes.axvspan(event.from_s, event.to_s, color=COLOURS["care"], alpha=0.3, linewidth=0.0)
        if diagnosis.onset_s is not None:
            axes.axvline(diagnosis.onset_s[1], color=COLOURS["alarm"], linewidth=1.0)
        axes.set_title(f"{names[j]} [N m]", loc="left", fontsize=7.5)
    panels[-1, 0].set_xlabel("t [s]")
    return figure
