"""A prognosis as a picture: the values, the limit, and when it will be reached."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure

from servoscope.prognosis.forecast import DAY_S, Prognosis
from servoscope.prognosis.series import NORMAL_95, SizeSeries
from servoscope.report.plotting import COLOURS, create_panels, plot_style, save_figure


def draw_trend(series: SizeSeries, trend: Prognosis) -> Figure:
    """Return the picture: values with their 95 % intervals, limit, and the interval of the time until it."""
    figure, axes = create_panels(3.2, width=7.2)
    days = series.t / DAY_S  # matplotlib counts days since 1970
    axes.errorbar(
        days,
        series.value,
        yerr=NORMAL_95 * series.std if series.std.any() else None,
        fmt="o",
        markersize=2.5,
        linewidth=0.8,
        color=COLOURS["ink"],
    )
    axes.axhline(trend.limit, color=COLOURS["alarm"], linewidth=1.0)
    if trend.outlook == "forecast" and trend.remaining_s is not None and trend.value is not None:
        low, middle, high = trend.remaining_s
        assert low is not None, "a forecast has an earlier end"
        # an open end is drawn to the right border, half the history away
        end = high if high is not None else max(2.0 * low, 0.5 * (trend.to_t - trend.from_t))
        axes.axvspan((trend.to_t + low) / DAY_S, (trend.to_t + end) / DAY_S, color=COLOURS["alarm"], alpha=0.15, lw=0)
        if middle is not None:
            way = np.array([trend.to_t, trend.to_t + middle]) / DAY_S
            axes.plot(way, [trend.value[1], trend.limit], "--", color=COLOURS["muted"])
    locator = AutoDateLocator()  # type: ignore[no-untyped-call]
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
    axes.set(ylabel=trend.name, title=trend.summary)
    return figure


def write_trend_figure(path: Path, series: SizeSeries, trend: Prognosis) -> None:
    """Write the picture; the suffix of the path is its format."""
    with plot_style():
        save_figure(draw_trend(series, trend), path)
