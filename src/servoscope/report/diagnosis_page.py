"""A diagnosis as one self-contained HTML page: the verdict in words, the figures behind it, tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.core.messages import clock_of, format_moment, translate
from servoscope.detection.trace import Trace
from servoscope.diagnosis.checks import checks_of_fault
from servoscope.diagnosis.diagnose import diagnose_with_trace
from servoscope.diagnosis.ml_refit import MAX_SIZE_DISTANCE, size_distance_std
from servoscope.diagnosis.motion_signature import SignatureWidth, compare_signatures
from servoscope.diagnosis.result import Diagnosis, RefitSummary, ResponsePoint
from servoscope.isolation.candidate import UNKNOWN, Candidate, FaultEstimate
from servoscope.models.loop import Loop
from servoscope.report.format_values import (
    describe_candidate,
    describe_fault,
    format_clock_time,
    format_count,
    format_number,
    format_probability,
    format_quantity,
    format_signed_percent,
    format_size,
    format_with_std,
    time_decimals,
)
from servoscope.report.page import render_page, say, write_page
from servoscope.report.plain_values import provenance
from servoscope.signals import Recording
from servoscope.signals.readers import as_recording
from servoscope.signals.readers.frames import Source

MIN_PROBABILITY_IN_HEADLINE = 0.05  # a candidate below this probability is not in the headline
LABELS = {"fault": "Fault", "healthy": "Healthy", "undetermined": "Undetermined"}


class Fact(NamedTuple):
    """What a verdict shows at a glance: a name, what is read first, lines below it, and the parameter it is of."""

    name: str
    large: str
    lines: tuple[str, ...] = ()
    parameter: str = ""


def write_diagnosis_page(
    path: str | Path,
    diagnosis: Diagnosis,
    trace: Trace,
    recording: Recording,
    loop: Loop,
    provenance: Mapping[str, str],
) -> None:
    """Write the report on one recording; nothing half-written stays behind.

    `provenance`: lines that say where the result comes from, for example the baseline's file and hash, in order.
    Raises OutputError if the file cannot be written.
    """
    write_page(path, render_diagnosis_page(diagnosis, trace, recording, loop, provenance))


def write_report(path: str | Path, baseline: Baseline | str | Path, recording: Recording | Source) -> Diagnosis:
    """Diagnose a recording, write the report on it as one HTML page, and return the diagnosis.

    Parameters
    ----------
    path
        Page to write; nothing half-written stays behind.
    baseline, recording
        As for `diagnose`.

    Raises OutputError if the page cannot be written, and what `diagnose` raises.

    Examples
    --------
    >>> write_report("friday.html", "baseline.json", "friday.csv").verdict
    'fault'
    """
    learned = Baseline.of(baseline)
    judged = as_recording(recording, learned.loop)
    diagnosis, trace = diagnose_with_trace(learned, judged)
    used = learned.at(diagnosis.point) if diagnosis.point else learned
    file = "not from a file" if isinstance(baseline, Baseline) else str(baseline)
    write_diagnosis_page(path, diagnosis, trace, judged, used.loop, provenance(used, file, judged.name))
    return diagnosis


def render_diagnosis_page(
    diagnosis: Diagnosis, trace: Trace, recording: Recording, loop: Loop, provenance: Mapping[str, str]
) -> str:
    """Return the page that `write_diagnosis_page` writes; it needs nothing from outside, no script and no network."""
    words = {fault.name: fault.words for fault in loop.plant.all_faults}
    label, refit = LABELS[diagnosis.verdict], diagnosis.refit
    return render_page(
        "diagnosis.html",
        title=f"{translate(label)}: {diagnosis.recording}",
        kind=diagnosis.verdict,
        label=label,
        diagnosis=diagnosis,
        refit=refit,
        about="" if loop.name == Loop.model_fields["name"].default else f"{translate('on')} {loop.name}",
        size=_recording_size(diagnosis, loop),
        headline=_headline(diagnosis, words),
        notes=list(_fault_notes(diagnosis, words)),
        checks=list(_checks(diagnosis, loop, words)),
        facts=list(_fault_facts(diagnosis) if diagnosis.verdict == "fault" else _no_fault_facts(diagnosis, trace)),
        meaning=lambda candidate: describe_candidate(candidate, words),
        agreement=_agreement(diagnosis.candidates[0], refit.recursive[0]) if refit is not None else "",
        sizes=list(_sizes(diagnosis.candidates[0], refit)) if refit is not None else [],
        **_figures(diagnosis, trace, recording, loop),
        **_signature(diagnosis, recording, loop),
        units=loop.plant.units,
        coefficient_units=dict(zip(loop.plant.names, loop.plant.coefficient_units, strict=True)),
        responses=[(point.frequency_hz, _response_cells(point)) for point in diagnosis.ifrf],
        settings=list(_settings(loop, provenance)),
    )


def _recording_size(diagnosis: Diagnosis, loop: Loop) -> list[str]:
    samples, rate = format_count(diagnosis.samples), format_quantity(loop.sample_rate)
    size = [say("report.samples", samples=samples, rate=rate), format_clock_time(diagnosis.duration_s)]
    count = len(diagnosis.warnings)
    return [*size, say("report.warnings", count=count)] if count else size


def _fault_notes(diagnosis: Diagnosis, words: Mapping[str, str]) -> Iterator[str]:
    """Yield what the words of the faults say in brackets, for example what a fault cannot be told from."""
    for fault in diagnosis.faults:
        what, _, aside = words.get(fault.name, "").rstrip(")").partition(" (")
        # What "more" of something means says nothing of less.
        if aside and (fault.ratio > 1.0 or not what.startswith("more")):
            yield say("report.aside", fault=what, aside=aside)


def _headline(diagnosis: Diagnosis, words: Mapping[str, str]) -> str:
    if diagnosis.verdict != "fault":
        return say(f"report.headline.{diagnosis.verdict}")
    if diagnosis.faults:
        return say("report.headline.faults", faults=[describe_fault(fault, words) for fault in diagnosis.faults])
    if diagnosis.candidates and diagnosis.candidates[0].name == UNKNOWN:
        return say("report.headline.unknown")
    likely = [c for c in diagnosis.candidates if c.name != UNKNOWN and c.probability >= MIN_PROBABILITY_IN_HEADLINE]
    if len(likely) < 2:
        return say("report.headline.open")
    if all(len(candidate.faults) > 1 for candidate in likely):
        return say("report.headline.pairs")
    return say("report.headline.several", faults=[describe_candidate(each, words) for each in likely])


def _fault_facts(diagnosis: Diagnosis) -> Iterator[Fact]:
    onset, detected = diagnosis.onset_s, diagnosis.detected_at_s
    decimals = time_decimals(onset[2] - onset[0]) if onset is not None else 1
    seen = () if detected is None else (say("report.detected", time=format_clock_time(detected, decimals)),)
    if onset is not None:
        low, likely, high = (format_clock_time(time, decimals) for time in onset)
        if diagnosis.began is not None:
            with clock_of(diagnosis.began):
                likely = format_moment(onset[1])
        yield Fact("Since when", likely, (say("report.interval", low=low, high=high), *seen))
    elif seen:
        yield Fact("Since when", "not known", seen)
    for fault in diagnosis.faults:
        size, low, high = format_size(fault.ratio, *fault.interval, factor=fault.learned)
        interval = say("report.interval", low=low, high=high)
        yield Fact("How large", size.replace(" ", "\N{NO-BREAK SPACE}"), (interval,), fault.parameter)
    if diagnosis.faults:
        among = "report.among_pairs" if diagnosis.refit is not None else "report.among"
        yield Fact("How sure", format_probability(diagnosis.probability), (say(among),))
    elif diagnosis.candidates:
        best = diagnosis.candidates[0]
        what = say("report.unexplained") if best.name == UNKNOWN else say("report.too_little", fault=best.name)
        yield Fact("How sure", format_probability(best.probability), (what,))


def _no_fault_facts(diagnosis: Diagnosis, trace: Trace) -> Iterator[Fact]:
    value = trace.statistic[trace.ready & np.isfinite(trace.statistic)]
    evaluations = say("report.evaluations", count=format_count(value.size))
    yield Fact("Watched", format_clock_time(diagnosis.duration_s), (evaluations,))
    if value.size:
        largest, limit = float(value.max()), float(np.max(trace.threshold))
        share = say("report.of_threshold", percent=100.0 * largest / limit, limit=format_number(limit, 3))
        yield Fact("Largest statistic T²", format_number(largest, 3), (share,))
    count = len(diagnosis.warnings)
    yield Fact("Warnings", str(count or "none"), ("listed below" if count else "about this recording",))


def _checks(diagnosis: Diagnosis, loop: Loop, words: Mapping[str, str]) -> Iterator[str]:
    """Yield what to look at on the machine, the likeliest first."""
    if diagnosis.verdict != "fault":
        return
    for candidate in (each for each in diagnosis.candidates if each.probability >= MIN_PROBABILITY_IN_HEADLINE):
        odds = format_probability(candidate.probability)
        for fault in candidate.faults:
            what, places = describe_fault(fault, words), [str(each) for each in checks_of_fault(loop, fault.name)]
            for place in places or [say("report.check.other")]:
                yield say("report.check.candidate", fault=what, place=place, probability=odds)
        if candidate.name == UNKNOWN:
            yield say("report.check.unknown", probability=odds)
    if diagnosis.refit is not None and diagnosis.refit.mimics:
        yield say("report.check.alike", causes=[translate(mimic.words) for mimic in diagnosis.refit.mimics])
    if diagnosis.warnings:
        yield say("report.check.warnings", count=len(diagnosis.warnings))


def _agreement(best: Candidate, other: Candidate) -> str:
    """Return whether the refit and the recursion, each with its best candidate, say the same."""
    if best.name == other.name == UNKNOWN:
        return say("report.agree.unknown")
    if best.name == other.name:
        agree = size_distance_std(best.faults[0], other.faults[0]) <= MAX_SIZE_DISTANCE
        return say("report.agree.sizes" if agree else "report.agree.name", fault=best.name)
    if len(best.faults) > 1:
        return say("report.agree.pair_unknown" if other.name == UNKNOWN else "report.agree.pair", other=other.name)
    return say("report.agree.not", refit=best.name, recursion=other.name)


def _sizes(best: Candidate, refit: RefitSummary) -> Iterator[tuple[FaultEstimate, FaultEstimate | None, float | None]]:
    """Yield each fault of the refit, the recursion's size of it, and how many standard deviations they are apart."""
    same = next((c for c in refit.recursive if c.name == best.name), None)
    for fault in best.faults:
        # The recursion's size means the same only where the fault is alone.
        other = same.faults[0] if same is not None and len(best.faults) == 1 else None
        yield fault, other, size_distance_std(fault, other) if other is not None else None


def _figures(diagnosis: Diagnosis, trace: Trace, recording: Recording, loop: Loop) -> dict[str, Any]:
    from servoscope.report import diagnosis_figures as figures
    from servoscope.report.plotting import render_svg  # late: matplotlib takes half a second to import

    allowed = loop.monitor.false_alarms_per_year
    budget = "report.budget.once" if allowed == 1.0 else "report.budget.times"
    over_time = say("report.over_time", budget=say(budget, count=format_quantity(allowed)))
    drawn = (
        ("Change over time", over_time, figures.plot_statistic(trace, diagnosis)),
        ("Signals", say("report.signals"), figures.plot_signals(recording, diagnosis, units=loop.plant.units)),
        ("Inverse frequency response", say("report.ifrf"), figures.plot_ifrf(trace, diagnosis)),
        (
            "Coefficients",
            say("report.coefficients"),
            figures.plot_coefficients(trace, diagnosis, units=loop.plant.coefficient_units),
        ),
    )
    sizes = figures.plot_fault_sizes(diagnosis)
    return {
        "figures": [(name, lead, render_svg(figure, f"f{i}")) for i, (name, lead, figure) in enumerate(drawn)],
        "sizes_figure": render_svg(sizes, "sizes") if sizes is not None else "",
    }


def _signature(diagnosis: Diagnosis, recording: Recording, loop: Loop) -> dict[str, Any]:
    """Return the picture of the motion signature, and the rows of its table; both empty where there is none."""
    from servoscope.report.plotting import render_svg
    from servoscope.report.signature_figure import plot_signature

    before, after = compare_signatures(recording, loop, diagnosis.onset_s[1] if diagnosis.onset_s else None)
    if after is None:
        return {"signature_figure": "", "signature_rows": []}
    rows = [
        (name, [_width_text(getattr(each, field)) if each is not None else "–" for each in (before, after)], unit)
        for name, field, unit in (
            ("Friction band", "friction_band", loop.plant.units[1]),
            ("Lost motion", "lost_motion", loop.plant.units[0]),
        )
        if getattr(after, field) is not None
    ]
    figure = plot_signature(before, after, units=loop.plant.units)
    return {"signature_figure": render_svg(figure, "signature"), "signature_rows": rows}


def _width_text(width: SignatureWidth) -> str:
    """Return a width with its 95 % interval's half width."""
    return " ± ".join(format_with_std(width.value, 1.96 * width.std))


def _response_cells(point: ResponsePoint) -> tuple[str, ...]:
    """Return real and imaginary part, each beside its healthy value, and the change of magnitude and phase."""
    healthy = complex(point.nominal_real, point.nominal_imag)
    ratio = complex(point.real, point.imag) / healthy if healthy else complex(np.nan)
    real, real_std, real_healthy = format_with_std(point.real, point.real_std, point.nominal_real)
    imag, imag_std, imag_healthy = format_with_std(point.imag, point.imag_std, point.nominal_imag)
    change = format_signed_percent(abs(ratio) - 1.0), format_number(float(np.degrees(np.angle(ratio))), 2)
    return f"{real} ± {real_std}", real_healthy, f"{imag} ± {imag_std}", imag_healthy, *change


def _settings(loop: Loop, provenance: Mapping[str, str]) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the settings that a result came about with, section by section of the loop file."""
    sections: dict[str, Mapping[str, Any]] = {"Where this comes from": provenance}
    settings = loop.to_dict()
    sections["Loop"] = {key: value for key, value in settings.items() if not isinstance(value, Mapping)}
    sections |= {f"[{key}]": value for key, value in settings.items() if isinstance(value, Mapping)}
    for name, entries in sections.items():
        yield name, {str(key): _format_setting(value) for key, value in entries.items() if value is not None}


def _format_setting(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return format_quantity(value)
    if isinstance(value, Mapping):
        return ", ".join(f"{key} = {_format_setting(each)}" for key, each in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_format_setting, value)) or "none"
    return str(value)
