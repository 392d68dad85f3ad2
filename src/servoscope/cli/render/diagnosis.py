"""How a diagnosis looks in a terminal: what it is, what to check, how sure; then why; the statistics on request."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence

from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from servoscope.cli.render.results import COLOURS, INDENT, print_facts, print_notes, print_table, print_title
from servoscope.core.messages import clock_of, format_moment, message, translate, translate_range
from servoscope.core.number_format import format_ratios, format_short
from servoscope.diagnosis.result import Diagnosis, DiagnosisWarning, FaultInterval, RefitSummary
from servoscope.isolation.candidate import Candidate
from servoscope.report.format_values import format_duration, format_probability
from servoscope.report.page import say

MAX_WARNINGS = 12
MAX_ALIKE = 3  # defects of one kind that are shown one by one
DEFECT_KINDS = ("gap", "nan", "repeat", "spike", "order", "text", "saturation")
# probability below which a candidate has no line; the explanation says why it was rejected
MIN_PROBABILITY_SHOWN = 0.01


def print_diagnosis(out: Console, d: Diagnosis, details: bool = False) -> None:
    """Print a verdict, what to check, what it rests on, and the warnings; with `details` the statistics too."""
    with clock_of(d.began):
        _print_diagnosis(out, d, details)


def _print_diagnosis(out: Console, d: Diagnosis, details: bool) -> None:
    size = f": {format_duration(d.duration_s)}, {d.samples} {translate('samples')}"
    print_title(out, d.recording, size if d.began is None else f"{size}, {say('cli.dates', zone=d.zone or 'local')}")
    out.print(Padding(Text(str(d.summary), style=f"bold {COLOURS[d.verdict]}"), INDENT, expand=False))
    facts = [("what to check", str(check)) for check in d.checks]
    if d.faults:
        facts.append(("how sure", format_probability(d.probability or 0.0)))
    if d.onset_s is not None:
        low, likely, high = d.onset_s
        at = f"{likely:.4g} s" if d.began is None else format_moment(likely)
        facts.append(("onset", f"{at} ({low:.4g} to {high:.4g} s, 95 %)"))
    if d.detected_at_s is not None:
        facts.append(("detected", f"{d.detected_at_s:.4g} s" if d.began is None else format_moment(d.detected_at_s)))
    if facts:
        print_facts(out, facts)
    if d.current.end_interval_s is not None or len(d.intervals) > 1:
        _print_timeline(out, d.intervals)
    if d.explanation:
        out.print(f"  {translate('Why')}:")
        print_notes(out, d.explanation, "blue", "-")
    shown = [c for i, c in enumerate(d.candidates) if c.probability >= MIN_PROBABILITY_SHOWN or not i]
    if details or len(shown) > 1:  # what else it could be concerns everybody
        _print_candidates(out, shown)
    if details and d.refit is not None:
        print_facts(out, _refit_facts(d.refit))
    _print_warnings(out, d.warnings)
    if d.candidates and not details:
        out.print(Padding(Text(say("cli.folded"), style="dim"), INDENT, expand=False))


def _print_timeline(out: Console, intervals: Sequence[FaultInterval]) -> None:
    """Print what was there from when to when, one line per interval."""
    rows = []
    for one in intervals:
        dates = (one.onset_s, one.end_interval_s)
        times = [f"{t[1]:.4g} s ({t[0]:.4g} to {t[2]:.4g})" if t is not None else "" for t in dates]
        sizes = "\n".join(f"{translate(f.name)} x {format_ratios(f.ratio, *f.interval)[0]}" for f in one.faults)
        rows.append((*times, sizes or say("cli.not_named"), format_probability(one.probability or 0.0)))
    print_table(out, ["from", "to", "fault", "probability"], rows)


def _refit_facts(refit: RefitSummary) -> Iterator[tuple[str, str]]:
    """Yield the lines on the data of the refit, and on what the recursion says beside it."""
    misfit, limit = format_short(refit.misfit), format_short(refit.limit)
    known = {"low": refit.from_s, "high": refit.to_s, "noise": refit.noise, "misfit": misfit, "limit": limit}
    yield "refit", say("cli.refit", **known)
    first = refit.recursive[0]
    sizes = ["{} {} ({} to {})".format(f.parameter, *format_ratios(f.ratio, *f.interval)) for f in first.faults]
    names = " + ".join(map(translate, first.names))
    yield "recursion", ", ".join((names, format_probability(first.probability), *sizes))


def _print_candidates(out: Console, shown: Sequence[Candidate]) -> None:
    """Print explanations; of a pair, one line per fault."""
    if not shown:
        return
    faults = [fault for c in shown for fault in c.faults]
    columns = {
        "candidate": ["\n+ ".join(map(translate, c.names)) for c in shown],
        "probability": [format_probability(c.probability) for c in shown],
    }
    if any(fault.name != fault.parameter for fault in faults):
        columns["parameter"] = ["\n".join(fault.parameter for fault in c.faults) for c in shown]
    if faults:
        sizes = [[format_ratios(fault.ratio, *fault.interval) for fault in c.faults] for c in shown]
        columns["ratio"] = ["\n".join(ratio for ratio, _, _ in each) for each in sizes]
        columns["95 % interval"] = ["\n".join(f"{low} to {high}" for _, low, high in each) for each in sizes]
    if len(shown) > 1 and any(c.misfit for c in shown):
        columns["worse by"] = [f"{math.sqrt(c.misfit):.3g} σ" if c.misfit else "" for c in shown]
    if any(c.cosine is not None for c in shown):
        columns["cosine"] = [f"{c.cosine:.3f}" if c.cosine is not None else "" for c in shown]
    print_table(out, list(columns), list(zip(*columns.values(), strict=True)))


def _print_warnings(out: Console, warnings: Sequence[DiagnosisWarning]) -> None:
    texts = []
    for w in _sum_up(warnings):
        when = f"{w.from_s:.6g} s" if w.from_s == w.to_s else translate_range(f"{w.from_s:.6g} to {w.to_s:.6g} s")
        # What the recording can show at all is no matter of time.
        texts.append(str(w.message) if w.kind == "power" else f"{when}: {w.message}")
    more = len(texts) - MAX_WARNINGS
    if more > 1:
        texts[MAX_WARNINGS:] = [say("cli.more_warnings", count=more)]
    print_notes(out, texts)


def _sum_up(warnings: Sequence[DiagnosisWarning]) -> list[DiagnosisWarning]:
    """Return warnings, defects of a kind that came more than MAX_ALIKE times as one."""
    kinds = Counter(warning.kind for warning in warnings if warning.kind in DEFECT_KINDS)
    summed: dict[str, DiagnosisWarning] = {}
    for number, warning in enumerate(warnings):
        if kinds[warning.kind] <= MAX_ALIKE:
            summed[str(number)] = warning
        elif warning.kind not in summed:
            alike = [each for each in warnings if each.kind == warning.kind]
            text = message("diagnosis.alike", first=warning.description, times=len(alike))
            count, to_s = sum(each.count for each in alike), max(each.to_s for each in alike)
            summed[warning.kind] = warning.model_copy(update={"description": text, "count": count, "to_s": to_s})
    return list(summed.values())
