"""The figures of an assessment: the log, y over u, the cycle; imported late."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from servoscope.assessment.assess import Assessment
from servoscope.assessment.log import Signals
from servoscope.report.format_values import time_axis_unit
from servoscope.report.plotting import COLOURS, WIDTH, create_panels, envelope, plot_style

ROW = 1.9  # inches
MAX_PERIODS = 12  # in the plot of y over u
SHADED = {  # facts whose place in the log is drawn
    "rest", "frozen y", "straight lines in y", "straight lines in u", "u does not react", "y rests while u moves on",
    "u at its upper limit", "u at its lower limit",
}  # fmt: skip
SHADE: dict[str, Any] = {"color": COLOURS["care"], "alpha": 0.15, "linewidth": 0.0}


def plot_assessment(assessment: Assessment) -> Iterator[tuple[str, Figure]]:
    """Yield the figures with their titles; none of an assessment read back from JSON."""
    signals = assessment.signals
    if signals is not None:
        yield "Log", _plot_log(assessment, signals)
        yield "y over u", _plot_orbit(assessment, signals)


@plot_style()
def _plot_log(assessment: Assessment, signals: Signals) -> Figure:
    figure, (top, bottom) = create_panels(2.0 * ROW + 0.6, 2, sharex=True)
    unit, factor = time_axis_unit(float(signals.t[-1] - signals.t[0]))
    t = (signals.t - signals.t[0]) / factor
    begins = np.zeros(t.size, np.bool_)
    for axis, x, name, colour in (
        (top, signals.r, "r", "healthy"),
        (top, signals.y, "y", "measured"),
        (bottom, signals.u, "u", "care"),
    ):
        if x is not None:
            axis.plot(*envelope(t, x, begins), color=COLOURS[colour], linewidth=0.9, label=name)
    for fact in assessment.facts:
        for begin, end in fact.spans if fact.name in SHADED else ():
            axis = top if fact.name in ("frozen y", "straight lines in y") else bottom
            axis.axvspan((begin - signals.t[0]) / factor, (end - signals.t[0]) / factor, **SHADE)
    for axis in (top, bottom):
        axis.legend(loc="upper right")
        axis.grid(visible=True, color=COLOURS["rule"], linewidth=0.6)
        axis.margins(x=0.01)
    bottom.set_xlabel(f"time [{unit}]")
    return figure


@plot_style()
def _plot_orbit(assessment: Assessment, signals: Signals) -> Figure:
    figure, axis = create_panels(WIDTH / 2.4, width=WIDTH / 2.0)
    shown = signals.t.size
    if period := assessment.value("oscillation"):
        shown = min(shown, int(MAX_PERIODS * period / signals.step) + 2)
    rows = slice((signals.t.size - shown) // 2, (signals.t.size + shown) // 2, max(shown // 5000, 1))
    axis.plot(signals.u[rows], signals.y[rows], color=COLOURS["measured"], linewidth=0.7)
    axis.grid(visible=True, color=COLOURS["rule"], linewidth=0.6)
    axis.set(xlabel="u", ylabel="y")
    return figure
