"""Pictures for a notebook or a script: one function for recordings, traces, baselines, inspections and diagnoses."""

from __future__ import annotations

from functools import singledispatch
from typing import TYPE_CHECKING, Any

import numpy as np

from servoscope.detection.baseline import Baseline
from servoscope.detection.result import Diagnosis
from servoscope.detection.trace import Trace
from servoscope.estimation.filter_bank import filter_cutoff
from servoscope.estimation.frequency_response import frequency_response
from servoscope.learning.inspection import Inspection
from servoscope.report.plotting import envelope
from servoscope.signals.recording import Recording

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Z95 = 1.959963984540054  # a normal value is within so many standard deviations in 95 %


def plot(thing: Recording | Trace | Baseline | Inspection | Diagnosis) -> tuple[Axes, ...]:
    """Draw with matplotlib, in the user's own style; a notebook shows the figure by itself.

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
    return _draw(thing)


def _axes(rows: int, label: str) -> Any:
    import matplotlib.pyplot as plt

    _, axes = plt.subplots(rows, sharex=True, layout="constrained", squeeze=False)
    axes[-1, 0].set_xlabel(label)
    return tuple(axes[:, 0])


@singledispatch
def _draw(thing: object) -> tuple[Axes, ...]:
    kinds = "a Recording, a Trace, a Baseline, an Inspection or a Diagnosis"
    raise TypeError(f"a plot is made of {kinds}, not of {type(thing).__name__}")


@_draw.register(Recording)
def _recording(thing: Recording) -> tuple[Axes, ...]:
    upper, lower = _axes(2, "time [s]")
    upper.set_title(thing.name)
    for name, axes in (("r", upper), ("y", upper), ("u", lower)):
        axes.plot(*envelope(thing.t, getattr(thing, name), thing.restart), label=name)
    upper.legend()
    lower.set_ylabel("u")
    return upper, lower


@_draw.register(Trace)
def _trace(thing: Trace) -> tuple[Axes, ...]:
    (axes,) = _axes(1, "time [s]")
    for one in thing.statistics:
        shown = np.where(thing.ready & (one.value > 0.0), one.value / one.limit, np.nan)
        if np.isfinite(shown).any():
            for i, line in enumerate(np.atleast_2d(shown)):
                axes.plot(thing.t, line, label=one.name if shown.ndim == 1 else f"{one.name} of {i}")
    axes.axhline(1.0, color="black", linestyle="--", label="limit")
    axes.set_yscale("log")
    axes.set_ylabel("statistic over its limit")
    axes.legend()
    return (axes,)


@_draw.register(Baseline)
def _baseline(thing: Baseline) -> tuple[Axes, ...]:
    highest = filter_cutoff(thing.loop)
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
    upper, lower = _axes(2, "frequency [Hz]")
    upper.loglog(f, size)
    upper.fill_between(f, size * np.exp(-Z95 * relative), size * np.exp(Z95 * relative), alpha=0.3)
    upper.set_ylabel("|u/y|")
    phase, band = np.degrees(np.unwrap(np.angle(H))), np.degrees(Z95 * angle)
    lower.plot(f, phase)
    lower.fill_between(f, phase - band, phase + band, alpha=0.3)
    lower.set_ylabel("phase [degrees]")
    return upper, lower


@_draw.register(Inspection)
def _inspection(thing: Inspection) -> tuple[Axes, ...]:
    (axes,) = _axes(1, "frequency [Hz]")
    f = [one.frequency_hz for one in thing.frequencies]
    for name in "uy":  # a coherence that could not be judged is left out
        values = [getattr(one, f"coherence_{name}") for one in thing.frequencies]
        axes.plot(f, np.array(values, dtype=np.float64), marker="o", label=f"coherence r, {name}")
    axes.set_ylim(0.0, 1.05)
    axes.legend()
    return (axes,)


@_draw.register(Diagnosis)
def _diagnosis(thing: Diagnosis) -> tuple[Axes, ...]:
    (axes,) = _axes(1, "estimate over what a healthy loop would show")
    shown = {name: one for name, one in thing.parameters.items() if one.nominal != 0.0}
    ratios = [one.value / one.nominal for one in shown.values()]
    spread = [Z95 * one.std / abs(one.nominal) for one in shown.values()]
    axes.errorbar(ratios, list(shown), xerr=spread, fmt="o")
    axes.axvline(1.0, color="black", linestyle="--")
    axes.set_title(f"{thing.recording}: {thing.verdict}")
    return (axes,)
