"""A diagnosis as a document: what it is, since when and what to check; what else it could be; the statistics."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from servoscope.core.messages import clock_of, format_moment, message, render, say, translate
from servoscope.detection.trace import Trace
from servoscope.diagnosis.change_words import fault_label
from servoscope.diagnosis.ml_refit import MAX_SIZE_DISTANCE, size_distance_std
from servoscope.diagnosis.result import Diagnosis, FaultInterval, Mimic, RefitSummary, ResponsePoint, sum_up
from servoscope.isolation.candidate import UNKNOWN, Candidate, FaultEstimate
from servoscope.report.document import (
    DETAILS,
    EVIDENCE,
    HEADLINE,
    Document,
    Fact,
    Facts,
    Notes,
    Part,
    PicturePart,
    Section,
)
from servoscope.report.format_values import (
    DASH,
    describe_candidate,
    format_clock_time,
    format_count,
    format_number,
    format_probability,
    format_quantity,
    format_ratios,
    format_signed_percent,
    format_size,
    format_with_std,
    pair_correlation,
    parameter_label,
    time_decimals,
)
from servoscope.report.page import ResultTable

MIN_PROBABILITY_SHOWN = 0.01  # probability below which a candidate has no line
MIN_PROBABILITY_LIKELY = 0.05  # probability from which a candidate counts in sentences
MAX_WARNINGS = 60
HEALTHY_KEYS = "diagnosis.healthy", "diagnosis.healthy_limits"
LABELS = {"fault": "Fault", "suspect": "Suspect", "healthy": "Healthy", "undetermined": "Undetermined"}


class DiagnosisContext(NamedTuple):
    """What a diagnosis does not know itself.

    `words`: by name, what a fault means; `units`: of y and u; `coefficient_units`: by coefficient; `checks`: what to
    check, where somebody has said it after the diagnosis; `began`: when its time is zero [UTC s], None on the clock of
    a recording; `onset`: of the fault, by an earlier diagnosis [UTC s]; `trace`: its evaluations;
    `false_alarms_per_year`: that the limits allow.
    """

    words: Mapping[str, str] = {}
    units: tuple[str, str] = ("", "")
    coefficient_units: Mapping[str, str] = {}
    checks: Sequence[str] | None = None
    began: float | None = None
    onset: float | None = None
    trace: Trace | None = None
    false_alarms_per_year: float | None = None
    dated: bool = False  # whether the recording has dates of its own
    widths: tuple[ResultTable, ...] = ()  # beside the motion signature

    def moment(self, t: float, decimals: int = 1) -> str:
        """Return a time of the recording, as a date where it has one."""
        if self.began is not None:
            return say("report.date", t=self.began + t)
        return format_moment(t) if self.dated else format_clock_time(t, decimals)


def diagnosis_document(d: Diagnosis, context: DiagnosisContext | None = None) -> Document:
    """Return the sections of a diagnosis."""
    known = context or DiagnosisContext()
    if known.began is not None or d.began is None:
        return _sections(d, known)
    with clock_of(d.began):
        return _sections(d, known._replace(dated=True))


def _sections(d: Diagnosis, known: DiagnosisContext) -> Document:
    sections = (
        _headline(d, known),
        Section("What to check", tuple(_checks(d, known)), HEADLINE),
        Section("What has changed", (PicturePart("change"),), EVIDENCE, say("report.change")),
        Section("When it was there", _timeline(d, known), EVIDENCE),
        Section("What else it could be", tuple(_explanations(d, known)), EVIDENCE, _other_causes(d)),
        Section("The arm and its joints", (PicturePart("arm"),), EVIDENCE, say("arm.page_joints")),
        Section("Signals", (PicturePart("signals"),), EVIDENCE, say("report.signals")),
        Section("Warnings", _warnings(d, known), EVIDENCE, "What the reader should know about the recording."),
        Section("Why", _reasons(d), DETAILS, _clock_note(known)),
        Section("Change over time", (PicturePart("statistic"), *_largest(known.trace)), DETAILS, _over_time(known)),
        Section(
            "Refit beside recursion",
            (*_refit(d), *((PicturePart("sizes"),) if d.refit else ())),
            DETAILS,
            _agreement(d),
        ),
        Section("Inverse frequency response", _responses(d, known), DETAILS, say("report.ifrf")),
        Section(
            "Coefficients", (PicturePart("coefficients"), *_coefficients(d, known)), DETAILS, say("report.coefficients")
        ),
        Section("Motion signature", (PicturePart("signature"), *known.widths), DETAILS, say("report.signature")),
    )
    return tuple(section for section in sections if section.body)


def _headline(d: Diagnosis, known: DiagnosisContext) -> Section:
    dated = d.headline if known.began is None else d.dated_headline(known.began, known.onset)
    if d.verdict == "fault":
        asides = (*_asides(d, known.words), *_two_faults(d))
        body: tuple[Part, ...] = (*((Notes(asides),) if asides else ()), Facts(tuple(_fault_facts(d, known))))
        return Section(render(dated), body, HEADLINE)
    watched = Fact("Watched", format_clock_time(d.duration_s), (say("report.count", samples=d.samples),))
    shown = _healthy_limits(d.headline.values) if d.headline.key in HEALTHY_KEYS else ()
    title = say("report.headline.healthy", point=d.headline.values["point"]) if shown else render(dated)
    return Section(title, (*((Notes(shown),) if shown else ()), Facts((watched,))), HEADLINE)


def _healthy_limits(values: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what a healthy recording would have shown, and what it would not."""
    texts = [say("report.shown", smallest=values["smallest"])]
    if values.get("unwatched"):
        texts.append(say("report.not_monitored", unwatched=values["unwatched"]))
    return tuple(texts)


def _asides(d: Diagnosis, words: Mapping[str, str]) -> Iterator[str]:
    """Yield what the words of the faults say in brackets, for example what a fault cannot be told from."""
    for fault in d.faults:
        what, _, aside = words.get(fault.name, "").rstrip(")").partition(" (")
        # What "more" of something means says nothing of less.
        if aside and (fault.ratio > 1.0 or not what.startswith("more")):
            yield say("report.aside", fault=what, aside=aside)


def _two_faults(d: Diagnosis) -> Iterator[str]:
    """Yield that two faults came at once where none is named and all that is likely is a pair."""
    likely = [c for c in d.candidates if c.name != UNKNOWN and c.probability >= MIN_PROBABILITY_LIKELY]
    if not d.faults and len(likely) > 1 and likely[0] is d.candidates[0] and all(len(c.faults) > 1 for c in likely):
        yield say("report.headline.pairs")


def _fault_facts(d: Diagnosis, known: DiagnosisContext) -> Iterator[Fact]:
    onset, detected = d.onset_s, d.detected_at_s
    decimals = time_decimals(onset[2] - onset[0]) if onset is not None else 1
    seen = () if detected is None else (say("report.detected", time=known.moment(detected, decimals)),)
    if known.onset is not None and known.began is not None and known.onset < known.began:
        yield Fact("Since when", say("report.date", t=known.onset), ("as an earlier diagnosis has it",))
    elif d.current.from_start:
        yield Fact("Since when", say("report.before", time=known.moment(0.0)), seen)
    elif onset is not None:
        low, likely, high = (known.moment(t, decimals) for t in onset)
        yield Fact("Since when", likely, (say("report.interval", low=low, high=high), *seen))
    elif seen:
        yield Fact("Since when", "not known", seen)
    yield from map(size_fact, d.faults)
    if d.faults:
        among = "report.among_pairs" if d.refit is not None else "report.among"
        yield Fact("How sure", format_probability(d.probability), (say(among),))
    elif d.candidates:
        best = d.candidates[0]
        what = say("report.unexplained") if best.name == UNKNOWN else say("report.too_little", fault=best.name)
        yield Fact("How sure", format_probability(best.probability), (what,))


def size_fact(fault: FaultEstimate) -> Fact:
    """Return how large a fault is; an interval that holds both directions says so instead of one of them."""
    size, low, high = format_size(fault.ratio, *fault.interval, factor=fault.learned)
    name = parameter_label(fault.parameter)
    if fault.interval[0] <= 1.0 <= fault.interval[1] and not fault.learned:
        return Fact("How large", name, (say("report.size_uncertain", low=low, high=high),))
    value = f"{name} {size}".replace(" %", "\N{NO-BREAK SPACE}%").replace("× ", "×\N{NO-BREAK SPACE}")
    return Fact("How large", value, (say("report.interval", low=low, high=high),))


def _checks(d: Diagnosis, known: DiagnosisContext) -> Iterator[Part]:
    """Yield what to look at on the machine, the likeliest first."""
    if d.verdict != "fault":
        return
    texts = [str(check) for check in (d.checks if known.checks is None else known.checks)]
    unknown = next((c for c in d.candidates if c.name == UNKNOWN and c.probability >= MIN_PROBABILITY_LIKELY), None)
    if unknown is not None:
        texts.append(say("report.check.unknown", probability=format_probability(unknown.probability)))
    if d.warnings:
        texts.append(say("report.check.warnings", count=len(d.warnings)))
    if texts:
        yield Notes(tuple(text[:1].upper() + text[1:] if text[1:2] != "_" else text for text in texts), ordered=True)


def _timeline(d: Diagnosis, known: DiagnosisContext) -> tuple[ResultTable, ...]:
    """Return what was there from when to when, one row per interval, where there is more than "since"."""
    if d.current.end_interval_s is None and len(d.intervals) < 2:
        return ()
    rows = [
        (*_interval_ends(interval, known), _interval_sizes(interval), format_probability(interval.probability or 0.0))
        for interval in d.intervals
    ]
    return (ResultTable(("From", "To", "Fault", "Probability"), rows, words=3),)


def _interval_ends(interval: FaultInterval, known: DiagnosisContext) -> tuple[str, ...]:
    def when(t: tuple[float, float, float] | None) -> str:
        if t is None:
            return ""
        low, likely, high = (known.moment(x) for x in t)
        return say("report.moment", likely=likely, low=low, high=high)

    return tuple(map(when, (interval.onset_s, interval.end_interval_s)))


def _interval_sizes(interval: FaultInterval) -> str:
    sizes = (f"{translate(fault_label(f.name))} × {format_ratios(f.ratio, *f.interval)[0]}" for f in interval.faults)
    return "\n".join(sizes) or say("report.not_named")


def _explanations(d: Diagnosis, known: DiagnosisContext) -> Iterator[ResultTable]:
    shown = [c for i, c in enumerate(d.candidates) if c.probability >= MIN_PROBABILITY_SHOWN or not i]
    if shown:
        compare, labelled = len(shown) > 1 and any(c.misfit for c in shown), any(c.cosine is not None for c in shown)
        size = "Size, relative to healthy or labelled" if labelled else "Size, relative to healthy"
        head = ("Explanation", "Probability", size, "95 % interval", "Fits worse by", "Cosine")
        table = ResultTable(head, [_candidate_row(c, known) for c in shown])
        yield table.without(*(() if compare else ("Fits worse by",)), *(() if labelled else ("Cosine",)))
    if d.refit is not None and d.refit.mimics:
        yield ResultTable(("Cause outside the list of faults", "Size"), [_mimic_row(m) for m in d.refit.mimics])


def _candidate_row(c: Candidate, known: DiagnosisContext) -> tuple[str, ...]:
    name = " + ".join(translate(fault_label(name)) for name in c.names)
    meaning = describe_candidate(c, known.words)
    lines = [name, *([meaning] if meaning.replace(f" {translate('and')} ", " + ") != name else [])]
    if c.covariance is not None:
        lines.append(say("report.correlated", correlation=format_number(pair_correlation(c.covariance), 2)))
    several = len(c.faults) > 1 or any(fault.parameter != fault.name for fault in c.faults)
    sizes = [format_ratios(fault.ratio, *fault.interval) for fault in c.faults]
    named = [f"{parameter_label(f.parameter)} " if several else "" for f in c.faults]
    ratios = "\n".join(f"{label}× {size}" for label, (size, _, _) in zip(named, sizes, strict=True))
    intervals = "\n".join(say("report.range", low=low, high=high) for _, low, high in sizes)
    misfit = f"{format_number(math.sqrt(max(c.misfit, 0.0)), 3)} σ" if c.misfit else ""
    cosine = f"{c.cosine:.3f}" if c.cosine is not None else ""
    return "\n".join(lines), format_probability(c.probability), ratios or DASH, intervals or DASH, misfit, cosine


def _mimic_row(mimic: Mimic) -> tuple[str, str]:
    cause, ratio = translate(mimic.words), mimic.unit == "ratio"
    size = f"× {format_number(mimic.value)}" if ratio else f"{format_number(mimic.value, 3)} {mimic.unit}"
    return cause[:1].upper() + cause[1:], size


def _other_causes(d: Diagnosis) -> str:
    if d.refit is None or not d.candidates:
        return ""
    unknown = d.candidates[0].name == UNKNOWN
    if d.refit.mimics:
        outside = "Outside the list of faults, this would explain what no fault does, the likeliest first."
        return outside if unknown else say("report.alike", fault=d.candidates[0].name)
    return say("report.none_explains" if unknown else "report.none_as_well")


def _warnings(d: Diagnosis, known: DiagnosisContext) -> tuple[Part, ...]:
    def when(low: float, high: float) -> str:
        return f"{low:.2f}" if low == high else say("report.range", low=f"{low:.2f}", high=f"{high:.2f}")

    warnings = sum_up(d.warnings)
    rows = [
        (when(w.from_s, w.to_s).replace("-", "−"), translate(fault_label(w.kind)), w.message, format_count(w.count))
        for w in warnings[:MAX_WARNINGS]
    ]
    surplus = len(warnings) - MAX_WARNINGS
    note = (Notes((say("report.more", count=format_count(surplus), where=None),)),) if surplus > 0 else ()
    return (ResultTable(("Time [s]", "Kind", "What happened", "Rows"), rows, words=3), *note) if rows else ()


def _reasons(d: Diagnosis) -> tuple[Notes, ...]:
    return (Notes(tuple(map(render, d.reasons))),) if d.reasons else ()


def _clock_note(known: DiagnosisContext) -> str:
    return "" if known.began is None else say("report.clock", t=known.began)


def _largest(trace: Trace | None) -> Iterator[Facts]:
    if trace is None:
        return
    value = trace.statistic[trace.ready & np.isfinite(trace.statistic)]
    if value.size:
        largest, limit = float(value.max()), float(np.max(trace.threshold))
        share = say("report.of_threshold", percent=100.0 * largest / limit, limit=format_number(limit, 3))
        counted = say("report.evaluations", count=format_count(value.size))
        yield Facts((Fact("Largest statistic T²", format_number(largest, 3), (share, counted)),))


def _over_time(known: DiagnosisContext) -> str:
    allowed, budget = known.false_alarms_per_year, None
    if allowed is not None:
        budget = message(f"report.budget.{'once' if allowed == 1.0 else 'times'}", count=format_quantity(allowed))
    return say("report.over_time", budget=budget)


def _refit(d: Diagnosis) -> Iterator[ResultTable]:
    refit = d.refit
    if refit is None:
        return
    best, other = d.candidates[0], refit.recursive[0]
    rows = [("Answer", _answer(best), _answer(other), "")]
    for fault, recursive, distance in _sizes(best, refit):
        apart = f"{format_number(distance, 2)} σ" if distance is not None else ""
        name = f"{parameter_label(fault.parameter)}, {translate('95 % interval')}"
        rows.append((name, _factor(fault), _factor(recursive) if recursive is not None else DASH, apart))
    decimals = 1 if refit.to_s - refit.from_s > 10 else 2
    span = say(
        "report.range", low=format_clock_time(refit.from_s, decimals), high=format_clock_time(refit.to_s, decimals)
    )
    misfit = f"{format_number(refit.misfit, 3)}, {format_number(refit.limit, 3)}"
    rows += [
        ("Data used", span, "the last memory of the estimator", ""),
        ("Noise, relative to the baseline's", f"× {format_number(refit.noise, 3)}", "", ""),
        ("Misfit, and the largest that noise leaves", misfit, "", ""),
    ]
    cells = [tuple(translate(cell) for cell in row) for row in rows]
    yield ResultTable(("What", "Refit", "Recursion", "Apart"), cells)


def _answer(c: Candidate) -> str:
    return f"{' + '.join(translate(fault_label(name)) for name in c.names)}, {format_probability(c.probability)}"


def _factor(fault: FaultEstimate) -> str:
    ratio, low, high = format_ratios(fault.ratio, *fault.interval)
    return f"× {ratio} ({say('report.range', low=low, high=high)})"


def _sizes(best: Candidate, refit: RefitSummary) -> Iterator[tuple[FaultEstimate, FaultEstimate | None, float | None]]:
    """Yield each fault of the refit, the recursion's size of it, and how many standard deviations they are apart."""
    same = next((c for c in refit.recursive if c.name == best.name), None)
    for fault in best.faults:
        # The recursion's size means the same only where the fault is alone.
        other = same.faults[0] if same is not None and len(best.faults) == 1 else None
        yield fault, other, size_distance_std(fault, other) if other is not None else None


def _agreement(d: Diagnosis) -> str:
    """Return whether the refit and the recursion, each with its best candidate, say the same."""
    if d.refit is None:
        return ""
    best, other = d.candidates[0], d.refit.recursive[0]
    if best.name == other.name == UNKNOWN:
        return say("report.agree.unknown")
    labels = {"refit": fault_label(best.name), "recursion": fault_label(other.name)}
    if best.name == other.name:
        agree = size_distance_std(best.faults[0], other.faults[0]) <= MAX_SIZE_DISTANCE
        return say("report.agree.sizes" if agree else "report.agree.name", fault=labels["refit"])
    if len(best.faults) > 1:
        key = "report.agree.pair_unknown" if other.name == UNKNOWN else "report.agree.pair"
        return say(key, other=labels["recursion"])
    return say("report.agree.not", **labels)


def _responses(d: Diagnosis, known: DiagnosisContext) -> tuple[Part, ...]:
    unit = f" [{known.units[1]}/{known.units[0]}]" if known.units[1] else ""
    head = ("Frequency", f"Real part{unit}", "healthy", f"Imaginary part{unit}", "healthy", "Magnitude", "Phase [°]")
    rows = [(f"{format_quantity(point.frequency_hz)} Hz", *_response_cells(point)) for point in d.ifrf]
    return PicturePart("ifrf"), *((ResultTable(head, rows),) if rows else ())


def _response_cells(point: ResponsePoint) -> tuple[str, ...]:
    """Return real and imaginary part, each beside its healthy value, and the change of magnitude and phase."""
    healthy = complex(point.nominal_real, point.nominal_imag)
    ratio = complex(point.real, point.imag) / healthy if healthy else complex(np.nan)
    real, real_std, real_healthy = format_with_std(point.real, point.real_std, point.nominal_real)
    imag, imag_std, imag_healthy = format_with_std(point.imag, point.imag_std, point.nominal_imag)
    change = format_signed_percent(abs(ratio) - 1.0), format_number(float(np.degrees(np.angle(ratio))), 2)
    return f"{real} ± {real_std}", real_healthy, f"{imag} ± {imag_std}", imag_healthy, *change


def _coefficients(d: Diagnosis, known: DiagnosisContext) -> tuple[ResultTable, ...]:
    head = ("Coefficient", "Unit", "Estimate", "Standard deviation", "Healthy", "Change", "In standard deviations")
    rows = [
        (
            parameter_label(name),
            known.coefficient_units.get(name, ""),
            *format_with_std(p.value, p.std, p.nominal),
            format_signed_percent(p.value / p.nominal - 1.0) if p.nominal else DASH,
            format_number((p.value - p.nominal) / p.std, 2) if p.std > 0.0 else DASH,
        )
        for name, p in d.parameters.items()
    ]
    table = ResultTable(head, rows, words=2)
    return ((table if known.units[1] else table.without("Unit")),) if rows else ()
