"""How a fleet looks in a terminal: what is common, who is ill, what could not be examined."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console
from rich.text import Text

from servoscope import digits
from servoscope.cli.terminal import COLOURS, facts, notes, table

if TYPE_CHECKING:
    from servoscope.fleet import Fleet

MOST_SHOWN = 20
LEAST_SHOWN = 0.05  # probability of a common cause that is worth its line


def fleet(out: Console, f: Fleet) -> None:
    """Print what a fleet's results say."""
    from servoscope.fleet.pages import headline
    from servoscope.report.wording import probability

    colour = COLOURS["fault" if f.count("fault") or f.accepted else "healthy"]
    out.print(Text.assemble((f"{len(f.assets)} assets", "bold"), ": ", (headline(f), f"bold {colour}")))
    states = ("healthy", "fault", "common cause", "undetermined", "failed")
    facts(out, [(state, str(f.count(state))) for state in states if f.count(state)])
    shared = [(cause, since) for cause, since in zip(f.causes, f.since, strict=True) if cause.probability > LEAST_SHOWN]
    if shared:
        rows = []
        for cause, since in shared:
            size, low, high = digits.ratios(cause.ratio, *cause.interval)
            what = (f"{cause.key} {cause.group}", f"{len(cause.members)}", f"{cause.parameter} x {size}")
            rows.append((*what, f"{low} to {high}", since or "-", probability(cause.probability)))
        table(out, ("common cause", "assets", "change", "95 %", "since", "probability"), rows)
    ill = [one for one in f.assets if one.state not in ("healthy", "failed")]
    if ill:
        told = [(one.asset, one.day, one.state, probability(one.probability), one.said) for one in ill[:MOST_SHOWN]]
        table(out, ("asset", "day", "state", "own", ""), told, words=5)
    more = [f"{len(ill) - MOST_SHOWN} more are ill, see the report"] if len(ill) > MOST_SHOWN else []
    notes(out, more)
    lost = [f"{asset} {day}: {why}" for asset, day, why in f.failed]
    lost += [f"{name}, not learned: {why}" for name, why in f.unlearned.items()]
    notes(out, lost[:MOST_SHOWN])
