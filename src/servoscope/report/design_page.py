"""A study before deployment as one self-contained HTML page, and its tables, which a terminal prints too."""

from __future__ import annotations

from pathlib import Path

from servoscope.core.messages import count_words, say, translate
from servoscope.design import BaselineStudy, DesignStudy
from servoscope.report.format_values import (
    DASH,
    format_change,
    format_clock_time,
    format_number,
    format_percent,
)
from servoscope.report.page import ResultTable, render_page, write_page

MAX_STD_SHOWN = 10.0  # standard deviation from which a number says nothing


def write_design_page(path: str | Path, study: DesignStudy) -> None:
    """Write the page on a study; nothing half-written stays behind.

    Raises OutputError if the file cannot be written.
    """
    write_page(path, render_design_page(study))


def render_design_page(study: DesignStudy) -> str:
    """Return the page that `write_design_page` writes; it needs nothing from outside, no script and no network."""
    from servoscope.report import design_figures  # late: matplotlib takes half a second to import
    from servoscope.report.plotting import render_svg

    u, y = format_number(study.noise_u_std, 3), format_number(study.noise_y_std, 3)
    after = format_clock_time(study.after_s, 0)
    return render_page(
        "design.html",
        title=f"{study.loop}: {translate('before deployment')}",
        kind="healthy",
        study=study,
        size=(
            say("report.design.reference", reference=study.reference, after=after),
            say("report.design.noise", u=u, y=y),
            say("report.design.false_alarms", count=study.false_alarms_per_year),
        ),
        radii=render_svg(design_figures.plot_radii(study), "f0"),
        precision=render_svg(design_figures.plot_size_precision(study), "f1"),
        faults=faults_table(study),
        limits=limits_table(study),
        cosines=cosines_table(study),
        mimics=mimics_table(study, described=True),
    )


def faults_table(study: DesignStudy) -> ResultTable:
    """Return from which size on each fault is detected and named, in both directions."""
    rows = []
    for fault in study.faults.values():
        for direction, side in (("up", fault.up), ("down", fault.down)):
            sizes = (side.detectable, side.first_isolable, side.bound)
            again = ", ".join(
                f"{format_change(low)} to {format_change(high) if high else 'the end'}"
                for low, high in side.unclear[1:]
            )
            name = f"{translate(fault.name)} {translate(direction)}", fault.parameter
            rows.append((*name, *map(format_change, sizes), side.nearest, again or DASH))
    head = ("Change", "Parameter", "Detected from", "Named from", "Linear bound", "Else taken for", "Unclear again")
    return ResultTable(head, rows, words=2)


def learned_table(study: BaselineStudy) -> ResultTable:
    """Return from which size on each fault is detected and named, by a baseline alone."""

    def size(change: float | None) -> str:
        return format_percent(change) if change is not None and change < MAX_STD_SHOWN else translate("never")

    rows = [
        (name, fault.parameter, size(fault.detectable), size(fault.isolable), fault.nearest)
        for name, fault in study.faults.items()
    ]
    return ResultTable(("Change", "Parameter", "Detected from", "Named from", "Else taken for"), rows, words=2)


def limits_table(study: DesignStudy) -> ResultTable:
    """Return from which size on the loop no longer does its work, in both directions of each fault."""
    rows = [
        (
            f"{translate(fault.name)} {translate(direction)}",
            *(translate("never") if x is None else f"{x:g}" for x in (side.tracking, side.stability)),
        )
        for fault in study.faults.values()
        for direction, side in (("up", fault.up), ("down", fault.down))
    ]
    return ResultTable(("Change, as a ratio to healthy", "Tracking lost at", "Stability lost at"), rows)


def cosines_table(study: DesignStudy | BaselineStudy) -> ResultTable:
    """Return how alike small changes look, each against each."""
    names = tuple(study.faults)
    rows = [(name, *(f"{study.cosines[name][other]:.3f}".replace("-", "−") for other in names)) for name in names]
    return ResultTable(("Alike (cosine)", *names), rows)


def mimics_table(study: DesignStudy, *, described: bool = False) -> ResultTable:
    """Return the changes that are no fault of the list, in words where `described`, and the fault each looks like."""

    def amount(value: float | None, unit: str) -> str:
        if value is None:
            return translate("never")
        return format_percent(value) if unit == "relative" else count_words(f"{value:.2g}", "sample")

    rows: list[tuple[str, ...]] = [
        (
            f"{mimic.words} ({mimic.name})" if described else mimic.name,
            mimic.imitates,
            format_number(mimic.cosines[mimic.imitates], 3),
            amount(mimic.amount, mimic.unit),
            format_change(mimic.looks_like),
            amount(mimic.told_apart, mimic.unit),
        )
        for mimic in study.mimics
    ]
    head = ("Not in the list", "Is most like", "Cosine", "So much", "Looks like", "Told apart from")
    return ResultTable(head, rows, words=2)


def format_std(value: float | None) -> str:
    """Return a relative standard deviation, as far as it says anything."""
    return f"{100.0 * value:.3g} %" if value is not None and value < MAX_STD_SHOWN else DASH
