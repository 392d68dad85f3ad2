"""How a diagnosis looks in a terminal: the verdict first, then when, what else, and why."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from servoscope import digits
from servoscope.cli.terminal import COLOURS, INDENT, facts, notes, span, table
from servoscope.diagnosis import Candidate, Diagnosis, Refit, Warning

MOST_WARNINGS = 12
LEAST_SHOWN = 0.01  # probability below which a candidate is not worth its line; why it was rejected is told


def diagnosis(out: Console, d: Diagnosis) -> None:
    """Print a verdict, what stands behind it, and the warnings."""
    out.print(Text.assemble((d.recording, "bold"), f": {span(d.duration_s)}, {d.samples} samples"))
    out.print(Padding(Text(d.summary, style=f"bold {COLOURS[d.verdict]}"), INDENT, expand=False))
    told = []
    if d.detected_at_s is not None:
        told.append(("detected", f"{d.detected_at_s:.4g} s"))
    if d.onset_s is not None:
        low, likely, high = d.onset_s
        told.append(("onset", f"{likely:.4g} s ({low:.4g} to {high:.4g} s, 95 %)"))
    if told:
        facts(out, told)
    _candidates(out, d.candidates)
    if d.explanation:
        out.print("  Why:")
        notes(out, d.explanation, "blue", "-")
    if d.refit is not None:
        facts(out, _refit(d.refit))
    _warnings(out, d.warnings)


def _refit(refit: Refit) -> list[tuple[str, str]]:
    """Return the lines on what the refit looked at, and on what the recursion says beside it."""
    from servoscope.report.wording import probability

    looked = f"{refit.from_s:.4g} to {refit.to_s:.4g} s, noise x {refit.noise:.3g}"
    first = refit.recursive[0]
    sizes = ["{} {} ({} to {})".format(f.parameter, *digits.ratios(f.ratio, *f.interval)) for f in first.faults]
    return [
        ("refit", f"{looked}, misfit {digits.short(refit.misfit)} (limit {digits.short(refit.limit)})"),
        ("recursion", ", ".join((first.name, probability(first.probability), *sizes))),
    ]


def _candidates(out: Console, candidates: Sequence[Candidate]) -> None:
    """Print the explanations that are worth a line; of a pair, one line per fault."""
    from servoscope.report.wording import probability

    shown = [c for i, c in enumerate(candidates) if c.probability >= LEAST_SHOWN or not i]
    rows = []
    for c in shown:
        told = [digits.ratios(fault.ratio, *fault.interval) for fault in c.faults]
        cells = (
            c.name.replace(" + ", "\n+ "),
            probability(c.probability),
            "\n".join(fault.parameter for fault in c.faults),
            "\n".join(ratio for ratio, _, _ in told),
            "\n".join(f"{low} to {high}" for _, low, high in told),
            f"{math.sqrt(c.misfit):.3g} σ" if c.misfit else "",
            f"{c.cosine:.3f}" if c.cosine is not None else "",
        )
        rows.append(cells)
    every = [fault for c in shown for fault in c.faults]
    empty = {i for i in (5, 6) if not any(row[i] for row in rows)}
    empty |= {2} if all(fault.name == fault.parameter for fault in every) else set()
    empty |= {3, 4} if not every else set()
    empty |= {5} if len(rows) == 1 else set()  # nothing listed to be compared with
    header = ("candidate", "probability", "parameter", "ratio", "95 % interval", "worse by", "cosine")
    columns = [i for i in range(len(header)) if i not in empty]
    if rows:
        table(out, [header[i] for i in columns], [[row[i] for i in columns] for row in rows])


def _warnings(out: Console, warnings: Sequence[Warning]) -> None:
    texts = []
    for w in warnings:
        if w.kind == "power":
            texts.append(w.message)
            continue
        when = f"at {w.from_s:.6g} s" if w.from_s == w.to_s else f"{w.from_s:.6g} to {w.to_s:.6g} s"
        texts.append(f"{when}: {w.message}")
    more = len(texts) - MOST_WARNINGS
    if more > 1:
        texts[MOST_WARNINGS:] = [f"and {more} more, all of them with --json"]
    notes(out, texts)
