"""Pictures for a notebook or a script: one function for recordings, traces, baselines, inspections and diagnoses.

What a picture shows is data, a `Picture`, which matplotlib or plotly draws.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import singledispatch
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import FloatArray
from servoscope.detection.trace import Trace
from servoscope.diagnosis.result import Diagnosis
from servoscope.estimation.frequency_response import frequency_response
from servoscope.learning.inspection import Inspection
from servoscope.report.plotting import envelope
from servoscope.signals.recording import Recording

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from plotly.graph_objects import Figure

Z95 = 1.959963984540054  # a normal value is within so many standard deviations in 95 %
Thing = Recording | Trace | Baseline | Inspection | Diagnosis


@dataclass(frozen=True, eq=False)
class Line:
    """A line, or points; with its 95 % band along `low` and `high`, or half of the interval of each x."""

    x: FloatArray
    y: Any  # numbers, or names
    name: str = ""
    low: FloatArray | None = None
    high: FloatArray | None = None
    half_width: FloatArray | None = None
    marks: bool = False


@dataclass(frozen=True, eq=False)
class Panel:
    """One pair of axes, with a line at 1, across (`limit`) or upright (`healthy`)."""

    lines: list[Line]
    y_label: str = ""
    log_y: bool = False
    limit: bool = False
    healthy: bool = False


@dataclass(frozen=True, eq=False)
class Picture:
    """Panels one over the other, which share x."""

    x_label: str
    panels: list[Panel]
    title: str = ""
    log_x: bool = False


@overload
def plot(thing: Thing, backend: Literal["matplotlib"] = "matplotlib") -> tuple[Axes, ...]: ...
@overload
def plot(thing: Thing, backend: Literal["plotly"]) -> Figure: ...
def plot(thing: Thing, backend: Literal["matplotlib", "plotly"] = "matplotlib") -> Any:
    """Draw, in the user's own style; a notebook shows the figure by itself.

    Parameters
    ----------
    thing
        A recording: r and y, and u. A trace: the statistics over their limits, for a fleet one line per asset. A
        baseline: the Bode diagram of the healthy inverse, with its 95 % band. An inspection: the coherences at the
        monitored frequencies. A diagnosis: the coefficients over their healthy values, with 95 % intervals.
    backend
        What draws: ``"plotly"`` makes a figure that the reader can zoom into.

    Returns
    -------
    tuple of matplotlib.axes.Axes, or plotly.graph_objects.Figure
        Axes from top to bottom; ``.figure`` of one of them is the figure, ``savefig`` writes it.

    Raises TypeError for anything else, ImportError without plotly.

    Examples
    --------
    >>> upper, lower = plot(ss.read("friday.csv", "loop.toml"))
    >>> lower.get_ylabel()
    'u'
    >>> plot(ss.Baseline.load("baseline.json"), backend="plotly").layout.yaxis.title.text
    '|u/y|'
    """
    drawings = {"matplotlib": _draw_matplotlib, "plotly": _draw_plotly}
    if backend not in drawings:
        raise ValueError(f"backend is 'matplotlib' or 'plotly', not {backend!r}")
    return drawings[backend](_picture(thing))


def _draw_matplotlib(picture: Picture) -> tuple[Axes, ...]:
    import matplotlib.pyplot as plt

    _, rows = plt.subplots(len(picture.panels), sharex=True, layout="constrained", squeeze=False)
    for axes, panel in zip(rows[:, 0], picture.panels, strict=True):
        for line in panel.lines:
            if line.half_width is not None:
                axes.errorbar(line.x, line.y, xerr=line.half_width, fmt="o", label=line.name)
                continue
            axes.plot(line.x, line.y, marker="o" if line.marks else None, label=line.name)
            if line.low is not None and line.high is not None:
                axes.fill_between(line.x, line.low, line.high, alpha=0.3)
        if panel.limit:
            axes.axhline(1.0, color="black", linestyle="--", label="limit")
        if panel.healthy:
            axes.axvline(1.0, color="black", linestyle="--")
        axes.set_ylabel(panel.y_label)
        axes.set_xscale("log" if picture.log_x else "linear")
        if panel.log_y:
            axes.set_yscale("log")
        if any(line.name for line in panel.lines[1:]):
            axes.legend()
    rows[0, 0].set_title(picture.title)
    rows[-1, 0].set_xlabel(picture.x_label)
    return tuple(rows[:, 0])


def _draw_plotly(picture: Picture) -> Figure:
    try:
        from plotly.subplots import make_subplots
    except ImportError as error:
        raise ImportError("plotly is missing, pip install 'servoscope[notebook]'") from error
    figure = make_subplots(rows=len(picture.panels), cols=1, shared_xaxes=True, vertical_spacing=0.05)
    for row, panel in enumerate(picture.panels, 1):
        for line in panel.lines:
            style = {"name": line.name, "showlegend": bool(line.name), "row": row, "col": 1}
            if line.low is not None and line.high is not None:  # there and back
                x, y = (np.concatenate([a, b[::-1]]) for a, b in ((line.x, line.x), (line.low, line.high)))
                band = {"line_width": 0, "fill": "toself", "hoverinfo": "skip", "opacity": 0.3}
                figure.add_scatter(x=x, y=y, **style | band | {"name": "95 %", "mode": "lines", "showlegend": False})
            spread = {} if line.half_width is None else {"error_x": {"type": "data", "array": line.half_width}}
            mode = "markers" if spread else "lines+markers" if line.marks else "lines"
            figure.add_scatter(x=line.x, y=line.y, mode=mode, **spread, **style)
        if panel.limit:
            figure.add_hline(1.0, line_dash="dash", row=row, col=1)
        if panel.healthy:
            figure.add_vline(1.0, line_dash="dash", row=row, col=1)
        figure.update_yaxes(title_text=panel.y_label, type="log" if panel.log_y else None, row=row, col=1)
    figure.update_xaxes(type="log" if picture.log_x else None)
    figure.update_xaxes(title_text=picture.x_label, row=len(picture.panels), col=1)
    return figure.update_layout(title_text=picture.title)


@singledispatch
def _picture(thing: object) -> Picture:
    kinds = "a Recording, a Trace, a Baseline, an Inspection or a Diagnosis"
    raise TypeError(f"a plot is made of {kinds}, not of {type(thing).__name__}")


@_picture.register(Recording)
def _recording(thing: Recording) -> Picture:
    r, y, u = (Line(*envelope(thing.t, getattr(thing, name), thing.restart), name) for name in "ryu")
    return Picture("time [s]", [Panel([r, y]), Panel([u], "u")], title=thing.name)


@_picture.register(Trace)
def _trace(thing: Trace) -> Picture:
    lines = []
    for statistic in thing.statistics:
        shown = np.where(thing.ready & (statistic.value > 0.0), statistic.value / statistic.limit, np.nan)
        if np.isfinite(shown).any():
            names = [statistic.name] if shown.ndim == 1 else [f"{statistic.name} of {i}" for i in range(len(shown))]
            lines += [Line(thing.t, y, name) for y, name in zip(np.atleast_2d(shown), names, strict=True)]
    return Picture("time [s]", [Panel(lines, "statistic over its limit", log_y=True, limit=True)])


@_picture.register(Baseline)
def _baseline(thing: Baseline) -> Picture:
    highest = thing.loop.cutoff
    f = np.geomspace(0.01 * highest, highest, 200)
    response = frequency_response(thing.pipeline().bank, f, np.array(thing.theta), thing.covariance_array())
    H, C = response.H, response.covariance
    size = np.abs(H)
    # along H and across it: what changes the magnitude, and what changes the phase
    along = np.stack([H.real, H.imag], axis=-1) / size[:, None]
    across = np.stack([-H.imag, H.real], axis=-1) / size[:, None]
    relative, angle = (
        np.sqrt(np.maximum(np.einsum("fi,fij,fj->f", way, C, way), 0.0)) / size for way in (along, across)
    )
    phase, band = np.degrees(np.unwrap(np.angle(H))), np.degrees(Z95 * angle)
    magnitude = Line(f, size, low=size * np.exp(-Z95 * relative), high=size * np.exp(Z95 * relative))
    shift = Line(f, phase, low=phase - band, high=phase + band)
    panels = [Panel([magnitude], "|u/y|", log_y=True), Panel([shift], "phase [degrees]")]
    return Picture("frequency [Hz]", panels, log_x=True)


@_picture.register(Inspection)
def _inspection(thing: Inspection) -> Picture:
    f = np.array([frequency.frequency_hz for frequency in thing.frequencies])
    lines = []
    for name in "uy":  # a coherence that could not be judged is left out
        values = [getattr(frequency, f"coherence_{name}") for frequency in thing.frequencies]
        lines.append(Line(f, np.array(values, dtype=np.float64), f"coherence r, {name}", marks=True))
    return Picture("frequency [Hz]", [Panel(lines)])


@_picture.register(Diagnosis)
def _diagnosis(thing: Diagnosis) -> Picture:
    shown = {name: parameter for name, parameter in thing.parameters.items() if parameter.nominal != 0.0}
    ratios = np.array([coefficient.value / coefficient.nominal for coefficient in shown.values()])
    spread = np.array([Z95 * coefficient.std / abs(coefficient.nominal) for coefficient in shown.values()])
    panel = Panel([Line(ratios, list(shown), half_width=spread)], healthy=True)
    title = f"{thing.recording}: {thing.verdict}"
    return Picture("estimate over what a healthy loop would show", [panel], title=title)
