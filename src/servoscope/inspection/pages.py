"""Figures of an inspection, and a self-contained page: words first, then plots."""

from __future__ import annotations

import base64
import html
import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from servoscope.inspection.inspecting import Inspection
from servoscope.inspection.levels import percent
from servoscope.loop import Loop
from servoscope.recording import Recording

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["figures_of", "page", "write"]

WIDTH, ROW = 10.0, 1.9  # inches
DOTS = 110  # per inch
COLOURS = {"r": "#6b7280", "u": "#b45309", "y": "#1d4ed8"}
SIGNS = {"usable": "#15803d", "usable with care": "#b45309", "not usable": "#b91c1c"}
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem;
       color: #111827; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2rem; }
.verdict { color: white; border-radius: .4rem; padding: .6rem 1rem; font-weight: 600; }
table { border-collapse: collapse; }
td, th { text-align: left; padding: .2rem 1rem .2rem 0; vertical-align: top; }
td.stop { color: #b91c1c; } td.care { color: #b45309; } td.note { color: #6b7280; }
img { max-width: 100%; } .small { color: #6b7280; font-size: .9rem; }
"""


def figures_of(inspection: Inspection, recording: Recording) -> list[tuple[str, Figure]]:
    """Draw signals, spectra with coherence, and the residual with its autocorrelation.

    Parameters
    ----------
    inspection
        As `servoscope.inspection.inspecting.inspect` returned it; read back from JSON it has only the signals to show.
    recording
        The recording that was inspected.

    Returns
    -------
    list of tuple
        Titles and matplotlib figures, which belong to no window.
    """
    figures = [("Signals", _signals(inspection, recording))]
    traces = inspection.traces
    if traces is not None and traces.spectra is not None:
        figures.append(("Spectra and coherence", _spectra(inspection)))
    if traces is not None and traces.used.any():
        figures.append(("Residual", _residual(inspection, recording)))
    return figures


def _figure(rows: int, *, share_time: bool) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, ROW * rows + 0.6), layout="constrained")
    axes = list(figure.subplots(rows, 1, sharex=share_time, squeeze=False)[:, 0])
    for axis in axes:
        axis.grid(alpha=0.3)
        axis.margins(x=0.01)
    return figure, axes


def _broken(recording: Recording, x: np.ndarray[tuple[int], np.dtype[np.float64]]) -> tuple[np.ndarray, np.ndarray]:
    """Return t and x with a NaN before each restart, so that lines end at gaps."""
    at = np.flatnonzero(recording.restart[1:]) + 1
    return np.insert(recording.t, at, np.nan), np.insert(x, at, np.nan)


def _signals(inspection: Inspection, recording: Recording) -> Figure:
    figure, (top, bottom) = _figure(2, share_time=True)
    for name in ("r", "y"):
        top.plot(*_broken(recording, getattr(recording, name)), color=COLOURS[name], lw=0.9, label=name)
    top.legend(loc="upper right")
    top.set_ylabel("r, y")
    bottom.plot(*_broken(recording, recording.u), color=COLOURS["u"], lw=0.9, label="u")
    limits = inspection.saturation
    for value in (limits.low, limits.high) if limits is not None else ():
        if value is not None:
            bottom.axhline(value, color="#b91c1c", lw=0.8, ls="--")
    if inspection.dead_zone is not None:
        bottom.axhspan(inspection.dead_zone.low, inspection.dead_zone.high, color="#b45309", alpha=0.12)
    for defect in recording.defects[:200]:
        if defect.kind not in ("clock", "jitter"):
            top.axvspan(defect.from_s, max(defect.to_s, defect.from_s + 1e-3), color="#b91c1c", alpha=0.25)
    bottom.set_ylabel("u")
    bottom.set_xlabel("time [s]")
    return figure


def _spectra(inspection: Inspection) -> Figure:
    figure, (top, bottom) = _figure(2, share_time=True)
    traces = inspection.traces
    s = traces.spectra if traces is not None else None
    if s is not None:
        for name, power in (("r", s.R), ("u", s.U), ("y", s.Y)):
            amplitude = np.sqrt(np.maximum(power, 1e-12 * max(float(power.max()), 1e-300)))
            top.loglog(s.f, amplitude / amplitude.max(), color=COLOURS[name], lw=1.0, label=name)
        bottom.semilogx(s.f, s.coherence_u, color=COLOURS["u"], lw=1.0, label="r to u")
        bottom.semilogx(s.f, s.coherence_y, color=COLOURS["y"], lw=1.0, label="r to y")
    for axis in (top, bottom):
        for at in inspection.frequencies:
            axis.axvline(at.frequency_hz, color="#111827", lw=0.8, ls=":")
        if inspection.band is not None:
            axis.axvspan(inspection.band.low_hz, inspection.band.high_hz, color="#15803d", alpha=0.08)
        axis.legend(loc="lower left")
    top.set_ylabel("amplitude density,\nrelative to its peak")
    bottom.set_ylabel("coherence")
    bottom.set_ylim(-0.02, 1.05)
    bottom.set_xlabel("frequency [Hz]; dotted: monitored, shaded: usable")
    return figure


def _residual(inspection: Inspection, recording: Recording) -> Figure:
    figure, (top, bottom) = _figure(2, share_time=False)
    traces = inspection.traces
    if traces is None:
        return figure
    v = np.where(traces.used, traces.v, np.nan)
    top.plot(*_broken(recording, v), color=COLOURS["u"], lw=0.8)
    top.set_ylabel("residual\n(filtered u)")
    top.set_xlabel("time [s]")
    bottom.plot(np.arange(traces.rho.size) / recording.sample_rate, traces.rho, color=COLOURS["y"], lw=1.0)
    bound = 2.0 / np.sqrt(max(int(traces.used.sum()), 1))
    bottom.axhspan(-bound, bound, color="#6b7280", alpha=0.2)
    bottom.set_ylabel("autocorrelation")
    bottom.set_xlabel("lag [s]; shaded: what white noise would show")
    return figure


def _rows(inspection: Inspection) -> list[tuple[str, str]]:
    s, fit = inspection.sampling, inspection.fit
    rows = [
        ("sampling", f"{s.samples} samples at {s.sample_rate_hz:g} Hz, {s.duration_s:.4g} s, {s.runs} runs"),
        (
            "gaps",
            f"{s.stretches - s.runs}; longest stretch without {s.longest_stretch_s:.4g} s,"
            f" {s.missing_percent:.2g} % missing",
        ),
    ]
    for q in inspection.quantisation:
        grid = "no grid visible" if q.step is None else f"steps of {q.step:.4g}, {q.effective_bits:.1f} bits"
        rows.append((f"resolution of {q.signal}", f"{grid}; {percent(q.repeated)} repeat the sample before"))
    for tried in inspection.orders:
        parts = f"order {tried.order}, friction {tried.friction}" + (", stiffness" if tried.stiffness else "")
        rows.append((f"generic inverse, {parts}", f"explains {percent(tried.explained)} of u"))
    if fit is not None:
        for name, coefficient in fit.coefficients.items():
            rows.append((name, f"{coefficient.value:.6g} (standard deviation {coefficient.std:.2g})"))
        rows.append(("condition number", f"{fit.condition:.3g}, weakest: {fit.weakest}"))
    for at in inspection.frequencies:
        spread = "" if at.relative_std is None else f", inverse response known to {percent(at.relative_std)}"
        seen = "too few periods to judge coherence" if at.snr is None else f"signal to noise {at.snr:.3g}"
        rows.append((f"{at.frequency_hz:g} Hz", f"{seen}{spread}"))
    return rows


def page(inspection: Inspection, recording: Recording) -> str:
    """Return the page as HTML that needs nothing else: no script, no network."""
    findings = "".join(
        f'<tr><td class="{f.severity}">{f.severity}</td><td>{_text(f.message)}</td></tr>' for f in inspection.findings
    )
    advice = "".join(f"<li>{_text(line)}</li>" for line in inspection.recommendations)
    numbers = "".join(f"<tr><td>{_text(name)}</td><td>{_text(value)}</td></tr>" for name, value in _rows(inspection))
    plots = "".join(
        f'<h2>{_text(title)}</h2><img alt="{_text(title)}" src="data:image/png;base64,{_png(figure)}">'
        for title, figure in figures_of(inspection, recording)
    )
    against = (
        "without a loop, by a generic inverse"
        if inspection.loop is None
        else "against its loop file"
        if inspection.loop == Loop.model_fields["name"].default
        else f"against the loop {_text(inspection.loop)}"
    )
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"<title>{_text(inspection.recording)}: {inspection.verdict}</title>"
        f"<style>{STYLE}</style></head><body>"
        f"<h1>Is {_text(inspection.recording)} usable?</h1>"
        f'<p class="verdict" style="background:{SIGNS[inspection.verdict]}">{_text(inspection.summary)}</p>'
        f'<p class="small">Inspected {against}.</p>'
        f"<h2>Reasons</h2><table>{findings}</table>"
        + (f"<h2>What to do</h2><ul>{advice}</ul>" if advice else "")
        + f"{plots}<h2>Numbers</h2><table>{numbers}</table></body></html>\n"
    )


def _text(x: object) -> str:
    return html.escape(str(x))


def _png(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DOTS)
    return base64.b64encode(buffer.getvalue()).decode("ascii")


def write(path: str | Path, inspection: Inspection, recording: Recording) -> None:
    """Write the page.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    from servoscope.output import atomic_write

    atomic_write(path, page(inspection, recording).encode("utf-8"))
