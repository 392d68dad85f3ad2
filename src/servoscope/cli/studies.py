"""How a study before deployment looks in a terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console
from rich.text import Text

from servoscope.cli.terminal import facts, notes, percent, span, table

if TYPE_CHECKING:
    from servoscope.design import Side, Study
    from servoscope.design.findings import Frequency

SAME = 0.995  # cosine from which two changes are called the same
DIRECTIONS = (("up", "more"), ("down", "less"))


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
    rows, doubts = [], []
    for fault in s.faults.values():
        for direction, _ in DIRECTIONS:
            side: Side = getattr(fault, direction)
            later = {d.ratio: d for d in side.delays}
            soon = [_seconds(d.half_s) for d in list(later.values())[:3:2]]
            rows.append(
                (
                    fault.name if direction == "up" else "",
                    fault.parameter if direction == "up" else "",
                    size(side.detectable),
                    *(soon + ["-", "-"])[:2],
                    size(side.first_isolable),
                    size(side.bound),
                    side.nearest,
                )
            )
            doubts += [
                f"{fault.name}: looks like {side.nearest or 'another fault'} again from {size(low)}"
                + (f" to {size(high)}" if high is not None else " on")
                for low, high in side.unclear[1:]
            ]
    header = ("fault", "parameter", "detected from", "half by", "twice that", "named from", "bound", "else taken for")
    table(out, header, rows, words=2)
    notes(out, doubts)
    out.print()


def _sizes(out: Console, s: Study) -> None:
    first = next(iter(s.faults.values()))
    header = ("std. dev. of a size after", *(span(each.seconds) for each in first.sizes))
    rows = [
        (f"{fault.name}{words}", *(percent(getattr(each, key)) for each in fault.sizes))
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
            (each.words, each.imitates, f"{each.cosines[each.imitates]:+.3f}", amount, f"x {each.looks_like:.4g}", told)
        )
    table(out, ("not in the list", "is most like", "cosine", "so much", "looks like", "told apart from"), rows, words=2)
    out.print()


def _frequencies(out: Console, s: Study) -> None:
    names = list(s.faults)

    def row(what: str, each: Frequency) -> tuple[str, ...]:
        shown = [each.apart[name] for name in names]
        return (what, f"{each.frequency_hz:g} Hz", *(percent(x) if x is not None and x < 10.0 else "-" for x in shown))

    rows = [row("monitored", each) for each in s.frequencies.own] + [row("best", each) for each in s.frequencies.best]
    table(out, ("shown apart (std. dev.)", "frequency", *names), rows)
    facts(out, [("gain", f"{s.frequencies.gain:.3g} times as far apart with the best frequencies, on average")])
    out.print()


def _dither(out: Console, s: Study) -> None:
    rows = []
    for each in s.dither:
        name = f"{percent(each.share)} at {each.frequency_hz:g} Hz" if each.share else "none"
        rows.append((name, f"{each.extra_u_rms:.3g}", *(size(each.radius[fault]) for fault in s.faults)))
    table(out, ("sine on the reference", "adds to u (rms)", *(f"{name} from" for name in s.faults)), rows)


def size(ratio: float | None) -> str:
    """Return a ratio as people say it: +2.5 %, or x 3.1 where it is far from one; none: never."""
    if ratio is None:
        return "never"
    if 0.5 < ratio < 2.0:
        return f"{100.0 * (ratio - 1.0):+.3g} %"
    return f"x {ratio:.3g}"


def _seconds(value: float | None) -> str:
    return span(value) if value is not None else "-"
