"""Figs. 2 and 4 to 8 of the paper, each drawn for its method and for this project's default; imported late."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from servoscope.estimation.filter_bank import nominal_theta
from servoscope.report.plotting import COLOURS, WIDTH, create_panels, plot_style, robust_range
from servoscope.research.paper import sensitivity
from servoscope.research.paper.conditions import (
    FAULT_AT,
    FAULT_NAMES,
    FREQUENCIES,
    PAPER,
    SIZES,
    TABLE_2,
    rig_loop,
    rig_plant,
)
from servoscope.research.paper.quartiles import MetricQuartiles
from servoscope.research.paper.table import Table2Residuals
from servoscope.research.paper.tracking import ifrf_targets, method_loop, tracking_traces

INK, MUTED, RULE = COLOURS["ink"], COLOURS["muted"], COLOURS["rule"]
FAULT_COLOURS = dict(zip(FAULT_NAMES.values(), ("#1f5fa8", "#c6501c", "#3b8c5a", "#8a5aa8"), strict=True))
METHOD_COLOURS = {"dfrls": COLOURS["healthy"], "akf": COLOURS["measured"], "default": COLOURS["measured"]}
NAMES = {"akf": "AKF", "dfrls": "DFRLS", "default": "default", "kf": "KF", "rls": "RLS"}
MARKERS = ("o", "s", "^", "D")
METHODS: Mapping[str, Sequence[str]] = {"paper": ("dfrls", "akf"), "default": ("default",)}


def _draw_zero_lines(ax: Axes) -> None:
    ax.axhline(0.0, color=RULE, linewidth=0.6, zorder=0)
    ax.axvline(0.0, color=RULE, linewidth=0.6, zorder=0)


@plot_style()
def figure_2() -> Figure:
    """Draw the sensitivities of G (upper) and H (lower) from 0.1 to 25 Hz; marks at 1, 10, 20 Hz."""
    figure, axes = create_panels(4.8, 2, 4)
    f = np.geomspace(0.1, 25.0, 400)
    rows = (("G", sensitivity.sensitivity_of_G), ("H", sensitivity.sensitivity_of_H))
    for row, (name, of) in zip(axes, rows, strict=True):
        lines, dots = of(rig_plant(), f), of(rig_plant(), FREQUENCIES)
        for ax, line, dot, (parameter, word) in zip(row, lines, dots, FAULT_NAMES.items(), strict=True):
            _draw_zero_lines(ax)
            ax.plot(line.real, line.imag, color=FAULT_COLOURS[word])
            for marker, z in zip(MARKERS, dot, strict=False):
                ax.plot(z.real, z.imag, marker, color=FAULT_COLOURS[word], markersize=4.0)
            ax.set_title(f"{name}: {parameter}, {word}")
    handles = [
        Line2D([], [], color=MUTED, marker=m, linestyle="", markersize=4.0, label=f"{f:g} Hz")
        for m, f in zip(MARKERS, FREQUENCIES, strict=False)
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    for name, row in zip("GH", axes, strict=True):
        row[0].set_ylabel(f"Im κ ∂{name}/∂κ")
    for ax in axes[1]:
        ax.set_xlabel("Re")
    return figure


@plot_style()
def figure_4(seed: int) -> Figure:
    """Draw reference and output of the healthy loop over 60 s."""
    recording = PAPER.simulate(rig_loop(), seed)
    figure, ax = create_panels(2.6)
    ax.plot(recording.t, 1e3 * recording.y, color=COLOURS["reference"], linewidth=2.2, label="output y")
    ax.plot(recording.t, 1e3 * recording.r, color=INK, linewidth=0.8, label="reference r")
    ax.set(xlabel="t [s]", ylabel="[mm]", xlim=(0.0, 60.0))
    figure.legend(loc="outside upper right", ncols=2)
    return figure


@plot_style()
def figure_5(seed: int, version: str) -> Figure:
    """Draw the coefficients over time on healthy data, started from zero, with their nominal values dashed."""
    methods = METHODS[version]
    figure, panels = create_panels(4.6, 2, 2, sharex=True)
    axes = panels.ravel()
    nominal = nominal_theta(method_loop(methods[-1]))
    for i, ax in enumerate(axes):
        for method in methods:
            healthy, _ = tracking_traces(method, seed)
            ax.plot(healthy.t, healthy.theta[:, i], color=METHOD_COLOURS[method], linewidth=1.0, label=NAMES[method])
        ax.axhline(nominal[i], color=COLOURS["alarm"], linewidth=0.9, linestyle="--", label="nominal")
        late = [tracking_traces(method, seed)[0].between(10.0, 60.0).theta[:, i] for method in methods]
        symbol = f"$c_{i}$" if version == "paper" else rf"$\theta_{i}$"
        ax.set(ylim=robust_range(np.concatenate(late), np.array([nominal[i]])), ylabel=symbol)
    for ax in axes[2:]:
        ax.set_xlabel("t [s]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=3)
    return figure


@plot_style()
def figure_6(seed: int, version: str) -> Figure:
    """Draw the iFRF at 1 Hz, p_s +40 % at 30 s: in the complex plane (a), and both parts over time (b)."""
    methods = METHODS[version]
    figure = Figure(figsize=(WIDTH, 3.8), layout="constrained")
    left, right = np.ravel(np.asarray(figure.subfigures(1, 2, width_ratios=[5, 6])))
    plane = left.subplots()
    axes = right.subplots(2, 1, sharex=True)
    star, square = (target[0] for target in ifrf_targets(methods[-1]))
    for method in methods:
        _, faulty = tracking_traces(method, seed)
        H = faulty.H[:, 0]
        plane.plot(H.real, H.imag, color=METHOD_COLOURS[method], linewidth=0.8, label=NAMES[method])
        for ax, part in zip(axes, (H.real, H.imag), strict=True):
            ax.plot(faulty.t, part, color=METHOD_COLOURS[method], linewidth=1.0)
    plane.plot(star.real, star.imag, "*", color=COLOURS["alarm"], markersize=11.0, label="nominal", linestyle="")
    plane.plot(square.real, square.imag, "s", color=INK, markersize=6.0, label="p_s +40 %", linestyle="")
    late = np.concatenate([tracking_traces(method, seed)[1].between(15.0, 60.0).H[:, 0] for method in methods])
    always = np.array([star, square])
    plane.set(xlim=robust_range(late.real, always.real), ylim=robust_range(late.imag, always.imag))
    plane.set(xlabel="Re H at 1 Hz [A/m]", ylabel="Im H at 1 Hz [A/m]", title="(a)")
    for ax, word in zip(axes, ("real", "imag"), strict=True):
        levels = getattr(star, word), getattr(square, word)
        ax.plot([0.0, FAULT_AT, FAULT_AT, 60.0], np.repeat(levels, 2), color=COLOURS["alarm"], linestyle="--", lw=0.9)
        ax.set(ylim=robust_range(getattr(late, word), np.array(levels)), ylabel="Re H" if word == "real" else "Im H")
    axes[0].set_title("(b)")
    axes[1].set_xlabel("t [s]")
    left.legend(*plane.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


@plot_style()
def figure_7(metrics: Table2Residuals) -> Figure:
    """Draw the residuals of Table 2 over the last 10 s: one row per frequency, one marker per size."""
    figure, axes = create_panels(8.4, 3, 2, width_ratios=[1, 1])
    pairs = (("pump", "leakage"), ("friction", "contamination"))
    for row, (i, f) in zip(axes, enumerate(FREQUENCIES), strict=True):
        healthy = metrics.healthy.between(50.0, 60.0).gamma[:, i]
        for ax, pair in zip(row, pairs, strict=True):
            _draw_zero_lines(ax)
            ax.plot(healthy.real, healthy.imag, ".", color=INK, markersize=2.0, zorder=3)
            for course, case in zip(metrics.cases, TABLE_2, strict=True):
                if case.fault in pair:
                    z = course.between(50.0, 60.0).gamma[::4, i]
                    marker = MARKERS[SIZES[case.parameter].index(case.ratio)]
                    ax.plot(z.real, z.imag, marker, color=FAULT_COLOURS[case.fault], markersize=3.0, alpha=0.6, mew=0.0)
            ax.set_title(f"{f:g} Hz: {pair[0]}, {pair[1]}")
        row[0].set_ylabel("Im γ [A/m]")
    for ax in axes[-1]:
        ax.set_xlabel("Re γ [A/m]")
    handles = [
        Line2D([], [], color=c, marker="o", linestyle="", markersize=4.0, label=w) for w, c in FAULT_COLOURS.items()
    ]
    handles.append(Line2D([], [], color=INK, marker=".", linestyle="", label="healthy"))
    handles += [
        Line2D([], [], color=MUTED, marker=m, linestyle="", markersize=4.0, label=f"size {i}")
        for i, m in enumerate(MARKERS, start=1)
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=9, columnspacing=0.9, handletextpad=0.2)
    return figure


@plot_style()
def figure_8(metrics: Mapping[str, Sequence[float]], version: str) -> Figure:
    """Draw coefficients of variation, parameters against iFRF, with quartiles where there are several seeds."""
    methods = METHODS[version]
    numbers = MetricQuartiles(metrics)
    figure, ax = create_panels(3.2, width=WIDTH * 0.7)
    columns = ["cv_theta", *(f"cv_H.{f:g}" for f in FREQUENCIES)]
    for j, method in enumerate(methods):
        keys = [f"{method}.{column}" for column in columns]
        middle = np.array([numbers(key) for key in keys])
        low, high = (np.array([numbers.used[key][side] for key in keys]) for side in (0, 2))
        x = np.arange(len(columns)) + 0.36 * (j - (len(methods) - 1) / 2.0)
        ax.bar(x, middle, 0.34, color=METHOD_COLOURS[method], label=NAMES[method])
        ax.errorbar(x, middle, [middle - low, high - middle], fmt="none", ecolor=INK, elinewidth=0.8, capsize=2.0)
    ax.set_xticks(range(len(columns)), ["parameters", *(f"iFRF, {f:g} Hz" for f in FREQUENCIES)])
    ax.set_ylabel("coefficient of variation")
    if len(methods) > 1:
        figure.legend(loc="outside upper right", ncols=2)
    return figure
