"""How a study before deployment looks in a terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console
from rich.text import Text

from servoscope.cli.terminal import facts, notes, percent, span, table
from servoscope.design.findings import SIZES
from servoscope.detection import POWER
from servoscope.report.wording import change

UNKNOWABLE = 10.0  # standard deviation from which a number says nothing

if TYPE_CHECKING:
    from servoscope.design import Study
    from servoscope.design.findings import Frequency


def study(out: Console, s: Study) -> None:
    """Print what can be detected and told apart, mimics, frequencies and dither."""
    out.print(Text.assemble((s.loop, "bold"), f": reference {s.reference}, {span(s.after_s)} after the onset"))
    facts(
        out,
        [
            ("noise", f"u {s.noise_u_std:.3g}, y {s.noise_y_std:.3g} (standard deviations)"),
            ("false alarms", f"{s.false_alarms_per_year:g} per year"),
        ],
    )
    _faults(out, s)
    _sizes(out, s)
    _confusion(out, s)
    _mimics(out, s)
    _frequencies(out, s)
    _dither(out, s)


def _faults(out: Console, s: Study) -> None:
    rows, late, doubts = [], [], []
    for fault in s.faults.values():
        for direction, side in (("up", fault.up), ("down", fault.down)):
            name = f"{fault.name} {direction}"
            first = (side.detectable, side.first_isolable, side.bound)
            rows.append((name, *(change(ratio) for ratio in first), side.nearest))
            if side.delays:
                late.append((name, *(f"{_seconds(each.half_s)}" for each in side.delays)))
            doubts += [
                f"{name}: {change(each.ratio)} is announced with {percent(each.probability)} only"
                for each in side.delays
                if each.probability < POWER
            ]
            doubts += [
                f"{name}: looks like another fault again from {change(low)}"
                + (f" to {change(high)}" if high is not None else " on")
                for low, high in side.unclear[1:]
            ]
    table(out, ("change", "detected from", "named from", "at best", "else taken for"), rows)
    notes(out, doubts)
    out.print()
    longest = max((len(row) for row in late), default=1)
    header = ("half are detected by, at", *(f"{k:g} x" for k in SIZES[: longest - 1]))
    table(out, header, [(*row, *[""] * (longest - len(row))) for row in late])
    out.print()


def _sizes(out: Console, s: Study) -> None:
    first = next(iter(s.faults.values()))
    header = ("std. dev. of a size after", *(span(each.seconds) for each in first.sizes))
    rows = [
        (f"{fault.name}{words}", *(_std(getattr(each, key)) for each in fault.sizes))
        for fault in s.faults.values()
        for key, words in (("alone_learned", ""), ("together_learned", ", all free"))
    ]
    table(out, header, rows)
    out.print()


def _confusion(out: Console, s: Study) -> None:
    names = list(s.faults)
    if len(names) > 1:
        rows = [(one, *(f"{s.cosines[one][other]:.3f}" for other in names)) for one in names]
        table(out, ("alike (cosine)", *names), rows)
        worst = ", ".join(f"{name} {share:+.2g}" for name, share in s.joint.confused.items() if abs(share) > 1e-3)
        facts(out, [("worst known", f"{worst} together ({s.joint.worst:.3g} times as badly as alone)")])
        out.print()


def _mimics(out: Console, s: Study) -> None:
    rows = []
    for each in s.mimics:
        amount = percent(each.amount) if each.unit == "relative" else f"{each.amount:g} samples"
        told = "never"
        if each.told_apart is not None:
            told = percent(each.told_apart) if each.unit == "relative" else f"{each.told_apart:.2g} samples"
        rows.append(
            (each.name, each.imitates, f"{each.cosines[each.imitates]:+.3f}", amount, change(each.looks_like), told)
        )
    table(out, ("not in the list", "is like", "cosine", "so much", "looks like", "told apart from"), rows, words=2)
    out.print()


def _frequencies(out: Console, s: Study) -> None:
    names = list(s.faults)

    def row(what: str, each: Frequency) -> tuple[str, ...]:
        shown = [each.apart[name] for name in names]
        return (what, f"{each.frequency_hz:g} Hz", *(_std(x) for x in shown))

    rows = [row("monitored", each) for each in s.frequencies.own] + [row("best", each) for each in s.frequencies.best]
    table(out, ("shown apart (std. dev.)", "frequency", *names), rows)
    facts(out, [("gain", f"{s.frequencies.gain:.3g} times as far apart with the best frequencies, on average")])
    out.print()


def _dither(out: Console, s: Study) -> None:
    rows = []
    for each in s.dither:
        name = f"{percent(each.share)} at {each.frequency_hz:g} Hz" if each.share else "none"
        rows.append((name, f"{each.extra_u_rms:.3g}", *(change(each.radius[fault]) for fault in s.faults)))
    table(out, ("sine on the reference", "adds to u (rms)", *(f"{name} from" for name in s.faults)), rows)


def _std(value: float | None) -> str:
    return f"{100.0 * value:.2g} %" if value is not None and value < UNKNOWABLE else "-"


def _seconds(value: float | None) -> str:
    return span(value) if value is not None else "-"
