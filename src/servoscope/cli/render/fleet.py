"""How a fleet looks in a terminal: what is common, who is ill, what could not be examined."""

from __future__ import annotations

from rich.console import Console
from rich.text import Text

from servoscope.cli.render.results import COLOURS, print_facts, print_notes, print_table
from servoscope.core.messages import count_words, say, translate, translate_range
from servoscope.core.number_format import format_ratios
from servoscope.fleet import Fleet
from servoscope.fleet.report import describe_discoveries, headline
from servoscope.report.format_values import DASH, format_probability

MAX_ASSETS_SHOWN = 20
MIN_PROBABILITY_SHOWN = 0.05  # probability of a common cause that is worth its line


def print_fleet(out: Console, f: Fleet) -> None:
    """Print what a fleet's results say."""
    colour = COLOURS["fault" if f.count("fault") or f.accepted else "healthy"]
    out.print(Text.assemble((count_words(len(f.assets), "asset"), "bold"), ": ", (headline(f), f"bold {colour}")))
    if told := describe_discoveries(f):
        out.print(told, soft_wrap=True)
    states = ("healthy", "fault", "common cause", "undetermined", "failed")
    print_facts(out, [(state, str(f.count(state))) for state in states if f.count(state)])
    shared = [
        (cause, since)
        for cause, since in zip(f.causes, f.since, strict=True)
        if cause.probability > MIN_PROBABILITY_SHOWN
    ]
    if shared:
        rows = []
        for cause, since in shared:
            size, low, high = format_ratios(cause.ratio, *cause.interval)
            what = (f"{cause.key} {cause.group}", f"{len(cause.members)}", f"{cause.parameter} x {size}")
            rows.append(
                (*what, translate_range(f"{low} to {high}"), since or DASH, format_probability(cause.probability))
            )
        print_table(out, ("common cause", "assets", "change", "95 %", "since", "probability"), rows)
    ill = [asset for asset in f.assets if asset.state not in ("healthy", "failed")]
    if ill:
        own = [
            (
                summary.asset,
                summary.day,
                translate(summary.state),
                format_probability(summary.probability),
                summary.said,
            )
            for summary in ill[:MAX_ASSETS_SHOWN]
        ]
        print_table(out, ("asset", "day", "state", "own", ""), own, words=5)
    if len(ill) > MAX_ASSETS_SHOWN:
        print_notes(out, [say("cli.more_ill", count=len(ill) - MAX_ASSETS_SHOWN)])
    lost = [f"{asset} {day}: {why}" for asset, day, why in f.failed]
    lost += [say("fleet.unlearned", name=name, reason=why) for name, why in f.unlearned.items()]
    print_notes(out, lost[:MAX_ASSETS_SHOWN])
