"""How a study before deployment looks in a terminal."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from rich.console import Console

from servoscope.cli.render.results import print_facts, print_notes, print_result_table, print_table, print_title
from servoscope.design.result import SIZES
from servoscope.detection.statistic import POWER
from servoscope.report import design_page
from servoscope.report.format_values import format_change, format_duration, format_number, format_percent
from servoscope.report.page import say

if TYPE_CHECKING:
    from servoscope.design import DesignStudy
    from servoscope.design.result import DirectionStudy


def print_study(out: Console, s: DesignStudy) -> None:
    """Print what can be detected and told apart, mimics, frequencies and dither."""
    after = format_duration(s.after_s)
    print_title(out, s.loop, ": " + say("report.design.reference", reference=s.reference, after=after))
    noise = say("cli.baseline.noise", u=s.noise_u_std, y=s.noise_y_std)
    print_facts(out, [("noise", noise), ("false alarms", f"{s.false_alarms_per_year:g} per year")])
    _print_faults(out, s)
    _print_sizes(out, s)
    print_result_table(out, design_page.limits_table(s))
    out.print()
    if len(s.faults) > 1:
        print_result_table(out, design_page.cosines_table(s))
        shares = [f"{name} {share:+.2g}" for name, share in s.joint.confused.items() if abs(share) > 1e-3]
        print_facts(out, [("worst known", say("report.design.worst", shares=shares, times=s.joint.worst))])
        out.print()
    print_result_table(out, design_page.mimics_table(s))
    out.print()
    print_result_table(out, design_page.frequencies_table(s))
    print_facts(out, [("gain", say("report.design.gain", gain=format_number(s.frequencies.gain, 3)))])
    out.print()
    print_result_table(out, design_page.dither_table(s))


def _print_faults(out: Console, s: DesignStudy) -> None:
    # A terminal is narrow: spans that are unclear again are notes, parameters stand on the page.
    print_result_table(out, design_page.faults_table(s).without("Parameter", "Unclear again"))
    sides = [(f"{f.name} {d}", side) for f in s.faults.values() for d, side in (("up", f.up), ("down", f.down))]
    for name, side in sides:
        print_notes(out, _doubts(name, side))
    out.print()
    delays = [(name, [format_duration(each.half_s) for each in side.delays]) for name, side in sides if side.delays]
    longest = max((len(times) for _, times in delays), default=0)
    header = ("half are detected by, at", *(f"{k:g} x" for k in SIZES[:longest]))
    print_table(out, header, [(name, *times, *[""] * (longest - len(times))) for name, times in delays])
    out.print()


def _doubts(name: str, side: DirectionStudy) -> Iterator[str]:
    """Yield where a fault is announced with too small a probability, and where it looks like another one again."""
    for each in side.delays:
        if each.probability < POWER:
            size, probability = format_change(each.ratio), format_percent(each.probability)
            yield say("report.design.announced", fault=name, size=size, probability=probability)
    for low, high in side.unclear[1:]:
        key = "report.design.unclear_on" if high is None else "report.design.unclear"
        yield say(key, fault=name, low=format_change(low), high=format_change(high))


def _print_sizes(out: Console, s: DesignStudy) -> None:
    first = next(iter(s.faults.values()))
    header = ("std. dev. of a size after", *(format_duration(each.seconds) for each in first.sizes))
    rows = [
        (f"{fault.name}{words}", *(design_page.format_std(getattr(each, key)) for each in fault.sizes))
        for fault in s.faults.values()
        for key, words in (("alone_learned", ""), ("together_learned", ", all free"))
    ]
    print_table(out, header, rows)
    out.print()
