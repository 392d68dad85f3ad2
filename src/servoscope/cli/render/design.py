"""How a study before deployment looks in a terminal."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import Console

from servoscope.cli.render.results import print_facts, print_notes, print_result_table, print_table, print_title
from servoscope.core.messages import say
from servoscope.design import BaselineStudy, DesignStudy
from servoscope.design.result import DirectionStudy
from servoscope.report import design_page
from servoscope.report.format_values import format_change, format_duration


def print_study(out: Console, s: DesignStudy) -> None:
    """Print what can be detected and told apart, when the loop fails, and mimics."""
    after = format_duration(s.after_s)
    print_title(out, s.loop, ": " + say("report.design.reference", reference=s.reference, after=after))
    noise = say("cli.baseline.noise", u=s.noise_u_std, y=s.noise_y_std)
    print_facts(out, [("noise", noise), ("false alarms", say("cli.per_year", count=s.false_alarms_per_year))])
    _print_faults(out, s)
    _print_sizes(out, s)
    print_result_table(out, design_page.limits_table(s))
    out.print()
    if len(s.faults) > 1:
        print_result_table(out, design_page.cosines_table(s))
        out.print()
    print_result_table(out, design_page.mimics_table(s))


def print_learned_study(out: Console, s: BaselineStudy) -> None:
    """Print what a baseline alone says, and why not more."""
    print_title(out, s.loop, "")
    print_facts(out, [("false alarms", say("cli.per_year", count=s.false_alarms_per_year))])
    print_result_table(out, design_page.learned_table(s))
    out.print()
    if len(s.faults) > 1:
        print_result_table(out, design_page.cosines_table(s))
    print_notes(out, [say("report.design.learned", missing=s.missing)])


def _print_faults(out: Console, s: DesignStudy) -> None:
    # A terminal is narrow: spans that are unclear again are notes, parameters stand on the page.
    print_result_table(out, design_page.faults_table(s).without("Parameter", "Unclear again"))
    sides = [(f"{f.name} {d}", side) for f in s.faults.values() for d, side in (("up", f.up), ("down", f.down))]
    for name, side in sides:
        print_notes(out, _doubts(name, side))
    out.print()


def _doubts(name: str, side: DirectionStudy) -> Iterator[str]:
    """Yield where a fault looks like another one again."""
    for low, high in side.unclear[1:]:
        key = "report.design.unclear_on" if high is None else "report.design.unclear"
        yield say(key, fault=name, low=format_change(low), high=format_change(high))


def _print_sizes(out: Console, s: DesignStudy) -> None:
    first = next(iter(s.faults.values()))
    header = ("std. dev. of a size after", *(format_duration(size.seconds) for size in first.sizes))
    rows = [(fault.name, *(design_page.format_std(size.std) for size in fault.sizes)) for fault in s.faults.values()]
    print_table(out, header, rows)
    out.print()
