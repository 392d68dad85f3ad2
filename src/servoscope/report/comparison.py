"""The picture of a fault's sizes with their intervals, refit beside recursion, and two faults' joint region."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from servoscope.diagnosis import Candidate, Diagnosis, FoundFault
from servoscope.report.canvas import COLOURS, styled
from servoscope.report.wording import plain_symbol

__all__ = ["sizes"]

WIDTH = 9.0  # inches; the page scales pictures to its own width
JOINT = 5.991  # 95 % of chi-square with two degrees of freedom
MEASURED, HEALTHY, RULE = COLOURS["measured"], COLOURS["healthy"], COLOURS["rule"]


def sizes(diagnosis: Diagnosis) -> Figure | None:
    """Draw the sizes of the first candidate by refit and recursion, and the joint region of a pair.

    None where there is no refit, or no fault that explains the change.
    """
    if diagnosis.refit is None or not diagnosis.candidates[0].faults:
        return None
    best = diagnosis.candidates[0]
    if best.covariance is not None:
        return _pair(best)
    other = next((c for c in diagnosis.refit.recursive if c.name == best.name), None)
    return _single(best.faults[0], other.faults[0] if other is not None else None)


@styled()
def _single(one: FoundFault, other: FoundFault | None) -> Figure:
    figure = Figure(figsize=(WIDTH, 1.25 if other is not None else 1.0), layout="constrained")
    ax = figure.subplots()
    told = [("refit", one, MEASURED), *([("recursion", other, HEALTHY)] if other is not None else [])]
    for i, (_, fault, colour) in enumerate(told):
        _interval(ax, fault, -i, colour)
    ax.set_yticks([-i for i in range(len(told))], [name for name, _, _ in told])
    ax.set_ylim(0.6 - len(told), 0.6)
    ax.set_xlabel(f"{plain_symbol(one.parameter)}, relative to healthy")
    ax.grid(visible=True, axis="x", color=RULE, linewidth=0.6)
    return figure


@styled()
def _pair(best: Candidate) -> Figure:
    figure = Figure(figsize=(WIDTH, 2.6), layout="constrained")
    axes = figure.subplot_mosaic([["a", "both"], ["b", "both"]], width_ratios=[3, 2])
    for key, fault in zip("ab", best.faults, strict=True):
        ax = axes[key]
        _interval(ax, fault, 0.0, MEASURED)
        ax.set_yticks([0.0], ["refit"])
        ax.set_ylim(-1.0, 1.0)
        ax.set_xlabel(f"{plain_symbol(fault.parameter)}, relative to healthy")
        ax.grid(visible=True, axis="x", color=RULE, linewidth=0.6)
    _joint(axes["both"], best)
    return figure


def _interval(ax: Axes, fault: FoundFault, at: float, colour: str) -> None:
    low, high = fault.interval
    ax.plot([low, high], [at, at], color=colour, linewidth=3.0, alpha=0.45, solid_capstyle="butt")
    ax.plot([low, low, np.nan, high, high], [at - 0.18, at + 0.18, np.nan, at - 0.18, at + 0.18], color=colour)
    ax.plot(fault.ratio, at, "o", markersize=5.5, color=colour)
    ax.locator_params(axis="x", nbins=7)


def _joint(ax: Axes, best: Candidate) -> None:
    """Draw where both sizes are with 95 % probability."""
    one, other = best.faults
    angle = np.linspace(0.0, 2.0 * np.pi, 97)
    values, vectors = np.linalg.eigh(np.array(best.covariance))
    root = vectors * np.sqrt(np.maximum(values, 0.0) * JOINT)
    x, y = np.exp(np.log([[one.ratio], [other.ratio]]) + root @ np.array([np.cos(angle), np.sin(angle)]))
    ax.fill(x, y, facecolor=MEASURED, alpha=0.24, linewidth=0)
    ax.plot(x, y, color=MEASURED, linewidth=1.1)
    ax.plot(one.ratio, other.ratio, "o", markersize=5.5, color=MEASURED)
    ax.set_xlabel(plain_symbol(one.parameter))
    ax.set_ylabel(plain_symbol(other.parameter))
    ax.set_title("both at once, 95 %", loc="left", fontweight="bold")
    ax.locator_params(nbins=4)
    ax.grid(visible=True, color=RULE, linewidth=0.6)
