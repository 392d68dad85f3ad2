"""Pictures for a notebook or a script: one function for recordings, traces, baselines, inspections and diagnoses."""

from __future__ import annotations

from functools import singledispatch
from typing import TYPE_CHECKING, Any

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.detection.trace import Trace
from servoscope.diagnosis.result import Diagnosis
from servoscope.estimation.frequency_response import frequency_response
from servoscope.learning.inspection import Inspection
from servoscope.report.plotting import envelope
from servoscope.signals.recording import Recording

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Z95 = 1.959963984540054  # a normal value is within so many standard deviations in 95 %


@singledispatch
def plot(thing: Recording | Trace | Baseline | Inspection | Diagnosis) -> tuple[Axes, ...]:
    """Draw, in the user's own style; a notebook shows the figure by itself.

    Parameters
    ----------
    thing
        A recording: r and y, and u. A trace: the statistics over their limits, for a fleet one line per asset. A
        baseline: the Bode diagram of the healthy inverse, with its 95 % band. An inspection: the coherences at the
        monitored frequencies. A diagnosis: the coefficients over their healthy values, with 95 % intervals.

    Returns
    -------
    tuple of matplotlib.axes.Axes
        From top to bottom; ``.figure`` of one of them is the figure, ``savefig`` writes it.

    Raises TypeError for anything else.

    Examples
    --------
    >>> upper, lower = plot(ss.read("friday.csv", "loop.toml"))
    >>> lower.get_ylabel()
    'u'
    """
    kinds = "a Recording, a Trace, a Baseline, an Inspection or a Diagnosis"
    raise TypeError(f"a plot is made of {kinds}, not of {type(thing).__name__}")


def _axes(rows: int, x_label: str, title: str = "") -> Any:
    """Return pairs of axes, one over the other, which share x."""
    import matplotlib.pyplot as plt

    axes = plt.subplots(rows, sharex=True, layout="constrained", squeeze=False)[1][:, 0]
    axes[0].set_title(title)
    axes[-1].set_xlabel(x_label)
    return axes


@plot.register(Recording)
def _plot_recording(thing: Recording) -> tuple[Axes, ...]:
    upper, lower = _axes(2, "time [s]", thing.name)
    for name, axes in (("r", upper), ("y", upper), ("u", lower)):
        axes.plot(*envelope(thing.t, getattr(thing, name), thing.restart), label=name)
    upper.legend()
    lower.set_ylabel("u")
    return upper, lower


@plot.register(Trace)
def _plot_trace(thing: Trace) -> tuple[Axes, ...]:
    (axes,) = _axes(1, "time [s]")
    for statistic in thing.statistics:
        shown = np.where(thing.ready & (statistic.value > 0.0), statistic.value / statistic.limit, np.nan)
        if np.isfinite(shown).any():
            names = [statistic.name] if shown.ndim == 1 else [f"{statistic.name} of {i}" for i in range(len(shown))]
            axes.plot(thing.t, np.atleast_2d(shown).T, label=names)
    axes.axhline(1.0, color="black", linestyle="--", label="limit")
    axes.set_ylabel("statistic over its limit")
    axes.set_yscale("log")
    axes.legend()
    return (axes,)


@plot.register(Baseline)
def _plot_baseline(thing: Baseline) -> tuple[Axes, ...]:
    f = np.geomspace(0.01 * thing.loop.cutoff, thing.loop.cutoff, 200)
    response = frequency_response(thing.pipeline().bank, f, np.array(thing.theta), thing.covariance_array())
    H, C = response.H, response.covariance
    size, phase = np.abs(H), np.degrees(np.unwrap(np.angle(H)))
    # along H and across it: what changes the magnitude, and what changes the phase
    along = np.stack([H.real, H.imag], axis=-1) / size[:, None]
    across = np.stack([-H.imag, H.real], axis=-1) / size[:, None]
    relative, angle = (
        Z95 * np.sqrt(np.maximum(np.einsum("fi,fij,fj->f", way, C, way), 0.0)) / size for way in (along, across)
    )
    upper, lower = _axes(2, "frequency [Hz]")
    upper.plot(f, size)
    upper.fill_between(f, size * np.exp(-relative), size * np.exp(relative), alpha=0.3)
    upper.set_ylabel("|u/y|")
    upper.set_xscale("log")
    upper.set_yscale("log")
    lower.plot(f, phase)
    lower.fill_between(f, phase - np.degrees(angle), phase + np.degrees(angle), alpha=0.3)
    lower.set_ylabel("phase [degrees]")
    return upper, lower


@plot.register(Inspection)
def _plot_inspection(thing: Inspection) -> tuple[Axes, ...]:
    (axes,) = _axes(1, "frequency [Hz]")
    f = [frequency.frequency_hz for frequency in thing.frequencies]
    for name in "uy":  # a coherence that could not be judged is left out
        values = [getattr(frequency, f"coherence_{name}") for frequency in thing.frequencies]
        axes.plot(f, np.array(values, dtype=np.float64), marker="o", label=f"coherence r, {name}")
    axes.legend()
    return (axes,)


@plot.register(Diagnosis)
def _plot_diagnosis(thing: Diagnosis) -> tuple[Axes, ...]:
    shown = {name: parameter for name, parameter in thing.parameters.items() if parameter.nominal != 0.0}
    ratios = [coefficient.value / coefficient.nominal for coefficient in shown.values()]
    spread = [Z95 * coefficient.std / abs(coefficient.nominal) for coefficient in shown.values()]
    (axes,) = _axes(1, "estimate over what a healthy loop would show", f"{thing.recording}: {thing.verdict}")
    axes.errorbar(ratios, list(shown), xerr=spread, fmt="o")
    axes.axvline(1.0, color="black", linestyle="--")
    return (axes,)
