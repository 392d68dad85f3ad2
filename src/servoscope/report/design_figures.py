"""The figures of a study before deployment: radii, precision of sizes; imported late."""

from __future__ import annotations

import math

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from servoscope.design import DesignStudy
from servoscope.report.plotting import COLOURS, create_panels, plot_style

TONES = ("#1f5fa8", "#c6501c", "#7d8894", "#1c2530")  # one per fault, then again dashed
RULE = COLOURS["rule"]
MAX_STD_SHOWN = 30.0  # standard deviation that is worth showing


def format_log_ratio(value: float) -> str:
    """Return the logarithm of a ratio as a share, 0.4 %, or as a factor where it is large."""
    return f"{100.0 * value:.3g} %" if value < 0.7 else f"× {math.exp(min(value, 700.0)):.3g}"


@plot_style()
def plot_radii(study: DesignStudy) -> Figure:
    """Draw from which size on each fault is detected, and named; spans that are unclear as bars."""
    rows = [(f, d, getattr(f, d)) for f in study.faults.values() for d in ("up", "down")]
    figure, ax = create_panels(0.9 + 0.34 * len(rows))
    known = [
        abs(math.log(x)) for _, _, s in rows for x in (s.detectable, s.first_isolable, s.bound) if x not in (None, 1.0)
    ]
    low, high = min(known, default=0.01) / 3.0, max([*known, 1.0]) * 2.0
    for y, (_, _, side) in enumerate(rows):
        for begin, end in side.unclear:
            left = max(abs(math.log(begin)), low)
            right = abs(math.log(end)) if end is not None else high
            ax.barh(
                y,
                right - left,
                left=left,
                height=0.5,
                color=COLOURS["reference"],
                label="not named rightly" if not y else "",
            )
        for value, marker, colour, label in (
            (side.detectable, "o", COLOURS["alarm"], "detected from"),
            (side.bound, "|", COLOURS["ink"], "linear Cramér-Rao bound of the name"),
        ):
            if value not in (None, 1.0):
                ax.plot(abs(math.log(value)), y, marker, color=colour, markersize=7, label=label if not y else "")
    ax.set_yticks(range(len(rows)), [f"{f.name} {d}" for f, d, _ in rows])
    ax.invert_yaxis()
    ax.set(xscale="log", xlim=(low, high), xlabel="size of the change")
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: format_log_ratio(x)))
    _add_grid_and_legend(figure, ax)
    return figure


@plot_style()
def plot_size_precision(study: DesignStudy) -> Figure:
    """Draw how the standard deviation of each size falls with the seconds after the onset."""
    figure, ax = create_panels(3.2)
    for i, fault in enumerate(study.faults.values()):
        tone = TONES[i % len(TONES)]
        known = [(size.seconds, size.std) for size in fault.sizes if size.std is not None]
        if known:
            ax.plot(*zip(*known, strict=True), color=tone, marker=".", label=fault.name)
    ax.set(xscale="log", yscale="log", xlabel="time after the onset [s]", ylabel="standard deviation")
    ax.xaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{100.0 * x:g} %"))
    ax.set_ylim(top=min(ax.get_ylim()[1], MAX_STD_SHOWN))
    _add_grid_and_legend(figure, ax, columns=4)
    return figure


def _add_grid_and_legend(figure: Figure, ax: Axes, columns: int = 3) -> None:
    ax.grid(visible=True, color=RULE, linewidth=0.6)
    ax.set_axisbelow(True)
    handles, labels = ax.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside upper left", ncols=columns)
