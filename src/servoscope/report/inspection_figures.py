"""The figures of an inspection: signals, spectra with coherence, the residual; imported late."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from servoscope.learning.inspection import Inspection
from servoscope.learning.inspection.inspect import InspectionTraces
from servoscope.report.diagnosis_figures import plot_signals
from servoscope.report.format_values import time_axis_unit
from servoscope.report.plotting import COLOURS, create_panels, envelope, plot_style, robust_range, visible_spans
from servoscope.signals import Recording

ROW = 1.9  # inches
COLOUR_OF_SIGNAL = {"r": COLOURS["healthy"], "u": COLOURS["care"], "y": COLOURS["measured"]}
ALARM, MUTED = COLOURS["alarm"], COLOURS["muted"]


def plot_inspection(inspection: Inspection, recording: Recording) -> Iterator[tuple[str, Figure]]:
    """Yield the figures with their titles; of an inspection read back from JSON only the signals."""
    yield "Signals", _plot_signals(inspection, recording)
    traces = inspection.traces
    if traces is not None and traces.spectra is not None:
        yield "Spectra and coherence", _plot_spectra(inspection, traces)
    if traces is not None and traces.used.any():
        yield "Residual", _plot_residual(traces)


def _two_rows(*, share_x: bool) -> tuple[Figure, Axes, Axes]:
    figure, (top, bottom) = create_panels(2.0 * ROW + 0.6, 2, sharex=share_x)
    for axis in (top, bottom):
        axis.grid(visible=True, color=COLOURS["rule"], linewidth=0.6)
        axis.margins(x=0.01)
    return figure, top, bottom


@plot_style()
def _plot_signals(inspection: Inspection, recording: Recording) -> Figure:
    figure = plot_signals(recording)
    top, _, bottom = figure.axes
    unit, factor = time_axis_unit(recording.duration_s)
    limits = inspection.saturation
    for value in (limits.low, limits.high) if limits is not None else ():
        if value is not None:
            bottom.axhline(value, color=ALARM, linewidth=0.8, linestyle="--")
    if inspection.dead_zone is not None:
        bottom.axhspan(inspection.dead_zone.low, inspection.dead_zone.high, color=COLOUR_OF_SIGNAL["u"], alpha=0.12)
    shown = [defect for defect in recording.defects if defect.kind not in ("clock", "jitter")]
    low = np.array([defect.from_s for defect in shown]) / factor
    high = np.array([max(defect.to_s, defect.from_s + 1e-3) for defect in shown]) / factor
    for begin, end in visible_spans(recording.t / factor, low, high):
        top.axvspan(begin, end, color=ALARM, alpha=0.25)
    bottom.set_xlabel(f"time [{unit}]; red: defects")
    return figure


@plot_style()
def _plot_spectra(inspection: Inspection, traces: InspectionTraces) -> Figure:
    figure, top, bottom = _two_rows(share_x=True)
    s = traces.spectra
    if s is not None:
        for name, power in (("r", s.R), ("u", s.U), ("y", s.Y)):
            amplitude = np.sqrt(np.maximum(power, 1e-12 * max(float(power.max()), 1e-300)))
            top.loglog(s.f, amplitude / amplitude.max(), color=COLOUR_OF_SIGNAL[name], linewidth=1.0, label=name)
        bottom.semilogx(s.f, s.coherence_u, color=COLOUR_OF_SIGNAL["u"], linewidth=1.0, label="r to u")
        bottom.semilogx(s.f, s.coherence_y, color=COLOUR_OF_SIGNAL["y"], linewidth=1.0, label="r to y")
    for axis in (top, bottom):
        for monitored in inspection.frequencies:
            axis.axvline(monitored.frequency_hz, color=COLOURS["ink"], linewidth=0.8, linestyle=":")
        if inspection.band is not None:
            axis.axvspan(inspection.band.low_hz, inspection.band.high_hz, color=COLOUR_OF_SIGNAL["y"], alpha=0.08)
        axis.legend(loc="lower left")
    top.set_ylabel("amplitude density,\nrelative to its peak")
    words = "frequency [Hz]; dotted: monitored, shaded: usable"
    bottom.set(ylabel="coherence", ylim=(-0.02, 1.05), xlabel=words)
    return figure


@plot_style()
def _plot_residual(traces: InspectionTraces) -> Figure:
    recording = traces.recording
    figure, top, bottom = _two_rows(share_x=False)
    unit, factor = time_axis_unit(recording.duration_s)
    v = np.where(traces.used, traces.v, np.nan)
    top.plot(*envelope(recording.t / factor, v, recording.restart), color=COLOUR_OF_SIGNAL["u"], linewidth=0.8)
    top.set(ylim=robust_range(v, room=5.0), ylabel="residual\n(filtered u)", xlabel=f"time [{unit}]")
    bottom.plot(
        np.arange(traces.rho.size) / recording.sample_rate, traces.rho, color=COLOUR_OF_SIGNAL["y"], linewidth=1.0
    )
    bound = 2.0 / np.sqrt(max(int(traces.used.sum()), 1))
    bottom.axhspan(-bound, bound, color=MUTED, alpha=0.2)
    bottom.set(ylabel="autocorrelation", xlabel="lag [s]; shaded: what white noise would show")
    return figure
