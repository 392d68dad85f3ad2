"""What goes beyond the paper's figures: trade-offs, windup, stability, the fault-tolerant action; imported late."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from servoscope.report.plotting import COLOURS, WIDTH, create_panels, plot_style
from servoscope.research.paper import tolerance, tradeoff, windup
from servoscope.research.paper.conditions import FAULT_AT, OperatingConditions
from servoscope.research.paper.figures import NAMES
from servoscope.research.paper.quartiles import MetricQuartiles
from servoscope.research.paper.table import pole_magnitudes

COLOURS_OF = {"akf": COLOURS["measured"], "dfrls": COLOURS["alarm"], "kf": "#3b8c5a", "rls": COLOURS["healthy"]}
LINES_OF = {"akf": "-", "dfrls": "-", "kf": "--", "rls": ":"}
TITLES = {"": "last 10 s", ".motion": "in motion", ".rest": "at rest"}


@plot_style()
def draw_trade_off(metrics: Mapping[str, Sequence[float]]) -> Figure:
    """Draw CV over rise time, over the memory, for four estimators: whole period, in motion, at rest."""
    numbers = MetricQuartiles(metrics)
    figure, axes = create_panels(4.8, 2, 3, sharex=True, sharey="row")
    for row, (what, words) in zip(axes, (("cv_theta", "CV, parameters"), ("cv_H", "CV, iFRF at 1 Hz")), strict=True):
        for ax, (span, title) in zip(row, TITLES.items(), strict=True):
            for estimator in tradeoff.ESTIMATORS:
                x, y = (
                    [
                        numbers(f"{OperatingConditions()}|{estimator}|{column}|{memory:g}")
                        for memory in tradeoff.MEMORIES
                    ]
                    for column in ("rise", f"{what}{span}")
                )
                style = {"color": COLOURS_OF[estimator], "linestyle": LINES_OF[estimator], "label": NAMES[estimator]}
                ax.loglog(x, y, marker="o", markersize=3.0, **style)
            if what == "cv_theta":
                ax.set_title(title)
            else:
                ax.set_xlabel("rise time [s]")
            ax.minorticks_off()
            ax.set_xticks([1.0, 2.0, 5.0, 10.0, 20.0], ["1", "2", "5", "10", "20"])
        ticks = [0.05, 0.1, 0.2, 0.5]
        row[0].set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        row[0].set_ylabel(words)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=4)
    return figure


@plot_style()
def draw_conditions(metrics: Mapping[str, Sequence[float]]) -> Figure:
    """Draw each estimator's CV relative to the AKF's at equal rise time over operating conditions; below 1 it wins."""
    numbers = MetricQuartiles(metrics)
    figure, axes = create_panels(3.6, 1, 2, sharey=True)
    labels = [str(conditions) for conditions in tradeoff.CONDITIONS]
    places = np.arange(len(labels))[::-1]
    for ax, (what, words) in zip(axes, (("cv_theta", "parameters"), ("cv_H", "iFRF at 1 Hz")), strict=True):
        ax.axvline(1.0, color=COLOURS["measured"], linewidth=1.0)
        for estimator in tradeoff.ESTIMATORS[1:]:
            ratios = [1.0 / numbers(f"equal_rise.{what}.{estimator}|{label}") for label in labels]
            marker = {"dfrls": "o", "kf": "s", "rls": "^"}[estimator]
            ax.plot(ratios, places, marker, color=COLOURS_OF[estimator], markersize=4.5, label=NAMES[estimator])
        ax.set_yticks(places, labels)
        ax.set(xlabel="CV relative to the AKF, at equal rise time", title=words)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=3)
    return figure


@plot_style()
def draw_windup(seed: int) -> Figure:
    """Draw how P grows over ten minutes at rest."""
    figure, ax = create_panels(3.0, width=WIDTH * 0.7)
    for estimator in windup.ESTIMATORS:
        t, sizes = windup.covariance_at_rest(estimator, seed)
        style = {"color": COLOURS_OF[estimator], "linestyle": LINES_OF[estimator], "label": NAMES[estimator]}
        ax.semilogy(t, sizes, **style)
    ax.axvline(windup.MOTION_S, color=COLOURS["rule"], linewidth=0.8)
    ax.set(xlabel="t [s]; at rest from 30 s on", ylabel="largest eigenvalue of P, relative to P_d")
    figure.legend(loc="outside upper right", ncols=4)
    return figure


@plot_style()
def draw_poles() -> Figure:
    """Draw the magnitudes of all closed-loop poles with the healthy plant and with all of Table 2."""
    magnitudes_by_plant = pole_magnitudes()
    figure, ax = create_panels(3.6, width=WIDTH * 0.7)
    places = np.arange(len(magnitudes_by_plant))[::-1]
    for place, magnitudes in zip(places, magnitudes_by_plant.values(), strict=True):
        ax.plot(magnitudes, np.full(len(magnitudes), place), "o", color=COLOURS["measured"], markersize=4.0, alpha=0.7)
    ax.axvline(1.0, color=COLOURS["alarm"], linewidth=1.0)
    ax.set_yticks(places, list(magnitudes_by_plant))
    ax.set(xlabel="magnitude of the closed-loop poles; stable below 1", xlim=(-0.02, 1.05))
    return figure


@plot_style()
def draw_tolerance(seed: int) -> Figure:
    """Draw the rms tracking error of the last second, with and without rescheduled gains, for two faults."""
    figure, axes = create_panels(4.4, len(tolerance.CASES), 1, sharex=True)
    second = np.ones(100) / 100.0
    for ax, case in zip(axes, tolerance.CASES, strict=True):
        told = tolerance.evaluate_rescheduling(case, seed)
        for y, colour, words in (
            (told.y_without_action, COLOURS["alarm"], "without action"),
            (told.y_with_action, COLOURS["measured"], "gains rescheduled"),
        ):
            error = 1e3 * np.sqrt(np.convolve((told.r - y) ** 2, second)[: len(y)])
            ax.plot(told.t, error, color=colour, linewidth=1.1, label=words)
        ax.axvline(FAULT_AT, color=COLOURS["healthy"], linewidth=1.0)
        if told.at_s is not None:
            ax.axvline(told.at_s, color=COLOURS["measured"], linewidth=1.0, linestyle="--")
        ax.set(ylabel="rms of r − y [mm]", xlim=(20.0, 60.0), title=f"{case.fault}, {case}")
    axes[-1].set_xlabel("t [s]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    return figure
