"""A diagnosis as one self-contained HTML page: the verdict in words, the pictures behind it, tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from html import escape
from importlib.resources import files
from pathlib import Path

import numpy as np

from servoscope.diagnosis import UNKNOWN, Diagnosis, Trace
from servoscope.loop import Loop
from servoscope.output import atomic_write
from servoscope.recording import Recording
from servoscope.report.grounds import beside, mimics, why
from servoscope.report.sheets import candidates, numbers, section, settings, warnings
from servoscope.report.wording import (
    clock_time,
    count,
    factors,
    meaning,
    number,
    probability,
    quantity,
    size_of,
    symbol,
    time_decimals,
    with_symbols,
)

__all__ = ["framed", "page", "write"]

UNLIKELY = 0.05  # a candidate below this probability is not in the headline
POLICY = "default-src 'none'; style-src 'unsafe-inline'"  # the page could not load anything if it wanted to
CUT = 'fill="none" stroke="var(--panel)" stroke-width="2.4"'
KINDS = {
    "fault": ("Fault", f'<path d="M12 2 23 21.5H1Z"/><path {CUT} d="M12 9v6M12 17.4v1.6"/>'),
    "healthy": ("Healthy", f'<circle cx="12" cy="12" r="11"/><path {CUT} d="m6.5 12.5 3.8 3.8 7.2-8"/>'),
    "undetermined": ("Undetermined", f'<circle cx="12" cy="12" r="11"/><path {CUT} d="M6 12h12"/>'),
}

Fact = tuple[str, str, str]  # name, large, small


def write(
    path: str | Path,
    diagnosis: Diagnosis,
    trace: Trace,
    recording: Recording,
    loop: Loop,
    provenance: Mapping[str, str],
) -> None:
    """Write the report on one recording; nothing half-written stays behind.

    Parameters
    ----------
    path
        The HTML file.
    diagnosis, trace, recording, loop
        What is reported, and on what.
    provenance
        Lines that say where the result comes from, for example the baseline's file and hash, in order.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    content = page(diagnosis, trace, recording, loop, provenance)
    # A file name that is no valid text must not stop the report on the file.
    atomic_write(path, content.encode("utf-8", errors="replace"))


def page(diagnosis: Diagnosis, trace: Trace, recording: Recording, loop: Loop, provenance: Mapping[str, str]) -> str:
    """Return the page that `write` writes; it needs nothing from outside, no script and no network."""
    words = {fault.name: fault.words for fault in loop.plant.faults}
    sections = (
        _header(diagnosis, loop),
        _verdict(diagnosis, trace, words),
        why(diagnosis),
        candidates(diagnosis, words),
        beside(diagnosis, _drawing(diagnosis)),
        mimics(diagnosis, words),
        _pictures(diagnosis, trace, recording, loop),
        numbers(diagnosis, loop),
        warnings(diagnosis),
        settings(loop, provenance),
    )
    title = f"{KINDS[diagnosis.verdict][0]}: {diagnosis.recording}"
    return framed(title, diagnosis.verdict, sections)


def framed(title: str, kind: str, sections: Iterable[str]) -> str:
    """Return a page with sections of HTML, empty ones left out, in the look of the style sheet.

    Parameters
    ----------
    title
        Of the window.
    kind
        Class of the page, which gives its tone: ``fault``, ``healthy`` or ``undetermined``.
    sections
        HTML.
    """
    folder = files("servoscope.report")
    style = "".join(folder.joinpath(name).read_text(encoding="utf-8") for name in ("palette.css", "report.css"))
    lines = (
        "<!DOCTYPE html>",
        '<html lang="en">',
        "<head>",
        '<meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(title)}</title>",
        f"<style>\n{style}</style>",
        "</head>",
        f'<body>\n<main class="{kind}">',
        *filter(None, sections),
        "</main>\n</body>\n</html>\n",
    )
    return "\n".join(lines)


def _header(diagnosis: Diagnosis, loop: Loop) -> str:
    told = len(diagnosis.warnings)
    watched = [
        f"{count(diagnosis.samples)} samples at {quantity(loop.sample_rate)} Hz",
        clock_time(diagnosis.duration_s),
        *([f"{told} warning{'s' * (told > 1)}"] if told else []),
    ]
    on = "" if loop.name == Loop.model_fields["name"].default else f" on {escape(loop.name)}"
    name = f"<strong>{escape(diagnosis.recording)}</strong>{on}"
    return f"<header><span>{name}</span><span>{', '.join(watched)}</span></header>"


def _verdict(diagnosis: Diagnosis, trace: Trace, words: Mapping[str, str]) -> str:
    kind, icon = KINDS[diagnosis.verdict]
    # What the words of a fault say in brackets, for example what it cannot be told from.
    notes = []
    for fault in diagnosis.faults:
        what, _, aside = words.get(fault.name, "").rstrip(")").partition(" (")
        # What "more" of something means says nothing of less.
        if aside and (fault.ratio > 1.0 or not what.startswith("more")):
            notes.append(f'<p class="note">{with_symbols(what[:1].upper() + what[1:])}: {with_symbols(aside)}.</p>')
    facts = _fault_facts(diagnosis) if diagnosis.verdict == "fault" else _quiet_facts(diagnosis, trace)
    lines = (
        '<div class="verdict">',
        f'<p class="kind"><svg viewBox="0 0 24 24" aria-hidden="true">{icon}</svg>{kind}</p>',
        f"<h1>{escape(_headline(diagnosis, words))}</h1>",
        f'<p class="summary">{escape(diagnosis.summary)}</p>',
        *notes,
        '<dl class="facts">',
        *(
            f'<div><dt>{name}</dt><dd><b class="big">{large}</b><span class="more">{small}</span></dd></div>'
            for name, large, small in facts
        ),
        "</dl>\n</div>",
    )
    return "\n".join(lines)


def _headline(diagnosis: Diagnosis, words: Mapping[str, str]) -> str:
    if diagnosis.verdict == "healthy":
        return "No change from the healthy baseline"
    if diagnosis.verdict == "undetermined":
        return "This recording cannot tell"
    if diagnosis.faults:
        names = " and ".join(meaning(fault.name, words, fault.ratio) for fault in diagnosis.faults)
        return names[:1].upper() + names[1:]
    if diagnosis.candidates and diagnosis.candidates[0].name == UNKNOWN:
        return "The actuator has changed, in a way that no known fault explains"
    several = [c for c in diagnosis.candidates if c.name != UNKNOWN and c.probability >= UNLIKELY]
    if len(several) > 1 and all(len(c.faults) > 1 for c in several):
        return "The actuator has changed in two ways at once; which ones remains open"
    likely = [c.name for c in several]
    if len(likely) > 1:
        return f"The actuator has changed: {' or '.join(meaning(name, words) for name in likely)}"
    return "The actuator has changed; which fault it is remains open"


def _fault_facts(diagnosis: Diagnosis) -> Iterator[Fact]:
    since, detected = diagnosis.onset_s, diagnosis.detected_at_s
    decimals = time_decimals(since[2] - since[0]) if since is not None else 1
    seen = f"detected at {clock_time(detected, decimals)}" if detected is not None else ""
    if since is not None:
        interval = f"95 %: {clock_time(since[0], decimals)} to {clock_time(since[2], decimals)}"
        yield "Since when", clock_time(since[1], decimals), f"{interval}<br>{seen}"
    elif seen:
        yield "Since when", "not known", seen
    for fault in diagnosis.faults:
        told = factors if fault.learned else size_of
        size, low, high = told(fault.ratio, *fault.interval)
        yield "How large", f"{symbol(fault.parameter)} {size.replace(' ', '&nbsp;')}", f"95 %: {low} to {high}"
    if diagnosis.faults:
        among = ", and pairs of them" if diagnosis.refit is not None else ""
        yield "How sure", probability(diagnosis.probability), f"among the faults that this plant knows{among}"
    elif diagnosis.candidates:
        best = diagnosis.candidates[0]
        small = f"for {escape(best.name)}: too little to name it"
        if best.name == UNKNOWN:
            small = "that no known fault explains it"
        yield "How sure", probability(best.probability), small


def _quiet_facts(diagnosis: Diagnosis, trace: Trace) -> Iterator[Fact]:
    value = trace.statistic[trace.ready & np.isfinite(trace.statistic)]
    yield "Watched", clock_time(diagnosis.duration_s), f"{count(value.size)} evaluations"
    if value.size:
        top = float(value.max())
        limit = float(np.max(trace.threshold))
        share = f"{100.0 * top / limit:.0f} % of the threshold of {number(limit, 3)}"
        yield "Largest statistic T²", number(top, 3), share
    told = len(diagnosis.warnings)
    yield "Warnings", str(told) if told else "none", "listed below" if told else "about this recording"


def _drawing(diagnosis: Diagnosis) -> str:
    from servoscope.report import canvas, comparison  # late: matplotlib takes half a second to import

    figure = comparison.sizes(diagnosis)
    return f'<figure aria-label="Sizes">{canvas.svg(figure, "sizes")}</figure>' if figure is not None else ""


def _pictures(diagnosis: Diagnosis, trace: Trace, recording: Recording, loop: Loop) -> str:
    from servoscope.report import canvas, figures  # late: matplotlib takes half a second to import

    allowed = loop.monitor.false_alarms_per_year
    budget = "at most once a year" if allowed == 1.0 else f"at most {quantity(allowed)} times a year"
    drawn = (
        (
            "Change over time",
            "Distance from healthy: T², which sees any change, and the sequential test, which is faster for changes"
            " that it was told to expect. Above the dashed line, chance is no longer an explanation: a healthy loop"
            f" gets there by design {budget}, if the noise stays as learned.",
            figures.statistic(trace, diagnosis),
        ),
        (
            "Signals",
            "Reference, output, tracking error and input as recorded. Grey bands are gaps, in which nothing"
            " was recorded.",
            figures.signals(recording, diagnosis, units=loop.plant.units),
        ),
        (
            "Inverse frequency response",
            "The input that the actuator asks for per unit of output, as a complex number at each monitored"
            " frequency. The diamond is where a healthy actuator would be; a change shows where the ellipse"
            " of the estimate leaves it. Each panel has its own scales.",
            figures.ifrf(trace, diagnosis),
        ),
        (
            "Coefficients",
            "The estimated coefficients of the actuator's inverse, relative to what a healthy one would show"
            " under the same reference; as a difference where that is nearly zero.",
            figures.coefficients(trace, diagnosis, units=loop.plant.coefficient_units),
        ),
    )
    return "\n".join(
        section(name, why, f'<figure aria-label="{name}">{canvas.svg(figure, f"f{i}")}</figure>')
        for i, (name, why, figure) in enumerate(drawn)
    )
