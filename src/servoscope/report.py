"""A diagnosis as one self-contained HTML page: the verdict in words, the pictures behind it, tables, settings."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from servoscope.diagnosis import UNKNOWN, Diagnosis, FoundFault, Trace
from servoscope.loop import Loop
from servoscope.output import atomic_write
from servoscope.recording import Recording
from servoscope.sheets import candidates, numbers, section, settings, warnings
from servoscope.wording import clock_time, meaning, number, probability, quantity, size_of, symbol, time_decimals, units

__all__ = ["page", "write"]

UNLIKELY = 0.05  # a candidate below this probability is not in the headline
POLICY = "default-src 'none'; style-src 'unsafe-inline'"
KINDS = {
    "fault": (
        "Fault",
        '<path d="M12 2 23 21.5H1Z"/><path d="M12 9v6M12 17.4v1.6" stroke="var(--panel)" stroke-width="2.2"/>',
    ),
    "healthy": (
        "Healthy",
        '<circle cx="12" cy="12" r="11"/><path d="m6.5 12.5 3.8 3.8 7.2-8" fill="none" stroke="var(--panel)" stroke-width="2.4"/>',
    ),
    "undetermined": (
        "Undetermined",
        '<circle cx="12" cy="12" r="11"/><path d="M6 12h12" stroke="var(--panel)" stroke-width="2.6"/>',
    ),
}


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
    # Names that are no text, like those of undecodable files, must not stop a report.
    atomic_write(path, content.encode("utf-8", errors="replace"))


def page(
    diagnosis: Diagnosis, trace: Trace, recording: Recording, loop: Loop, provenance: Mapping[str, str]
) -> str:
    """Return the page that `write` writes; it needs nothing from outside, no script and no network."""
    words = {fault.name: fault.words for fault in loop.plant.faults}
    body = "\n".join(
        (
            _header(diagnosis, loop),
            _verdict(diagnosis, trace, words),
            candidates(diagnosis, words),
            _pictures(diagnosis, trace, recording, loop),
            numbers(diagnosis, loop),
            warnings(diagnosis),
            settings(loop, provenance),
        )
    )
    style = files("servoscope").joinpath("report.css").read_text(encoding="utf-8")
    title = f"{KINDS[diagnosis.verdict][0]}: {diagnosis.recording}"
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n"
        f'<body>\n<main class="{diagnosis.verdict}">\n{body}\n</main>\n</body>\n</html>\n'
    )


def _header(diagnosis: Diagnosis, loop: Loop) -> str:
    return (
        f"<header><span><strong>{escape(diagnosis.recording)}</strong> on {escape(loop.name)}</span>"
        f"<span>{diagnosis.samples} samples, {clock_time(diagnosis.duration_s)}, at {quantity(loop.sample_rate)} Hz"
        "</span></header>"
    )


def _verdict(diagnosis: Diagnosis, trace: Trace, words: Mapping[str, str]) -> str:
    kind, icon = KINDS[diagnosis.verdict]
    notes = [words.get(fault.name, "").partition(" (")[2].rstrip(")") for fault in diagnosis.faults]
    note = "".join(
        f'<p class="note">{_with_symbols(text)}.</p>'
        for text in notes
        if text and text not in diagnosis.summary
    )
    facts = _fault_facts(diagnosis) if diagnosis.verdict == "fault" else _quiet_facts(diagnosis, trace)
    return (
        f'<div class="verdict">\n<p class="kind"><svg viewBox="0 0 24 24" fill="currentColor" aria-hidden="true">'
        f"{icon}</svg>{kind}</p>\n<h1>{_headline(diagnosis, words)}</h1>\n"
        f'<p class="summary">{escape(diagnosis.summary)}</p>{note}\n<dl class="facts">'
        + "".join(
            f'<div><dt>{name}</dt><dd><span class="big">{big}</span><span class="more">{more}</span></dd></div>'
            for name, big, more in facts
        )
        + "</dl>\n</div>"
    )


def _headline(diagnosis: Diagnosis, words: Mapping[str, str]) -> str:
    if diagnosis.verdict == "healthy":
        return "No change from the healthy baseline"
    if diagnosis.verdict == "undetermined":
        return "This recording cannot tell"
    if diagnosis.faults:
        names = " and ".join(meaning(fault.name, words) for fault in diagnosis.faults)
        return escape(names[0].upper() + names[1:])
    if diagnosis.candidates and diagnosis.candidates[0].name == UNKNOWN:
        return "The actuator has changed, in a way that no known fault explains"
    likely = [
        meaning(c.name, words)
        for c in diagnosis.candidates
        if c.name != UNKNOWN and c.probability >= UNLIKELY
    ]
    if len(likely) > 1:
        return escape(f"The actuator has changed: {' or '.join(likely)}")
    return "The actuator has changed; which fault it is remains open"


def _with_symbols(text: str) -> str:
    return re.sub(r"\b[A-Za-z]{1,2}_\w{1,3}\b", lambda found: symbol(found[0]), escape(text))


def _fault_facts(diagnosis: Diagnosis) -> Iterable[tuple[str, str, str]]:
    since, detected = diagnosis.onset_s, diagnosis.detected_at_s
    more = f"detected at {clock_time(detected)}" if detected is not None else ""
    if since is not None:
        low, high = moments(since[0], since[2])
        interval = f"95 %: {low} to {high} s"
        yield "Since when", clock_time(since[1]), f"{interval}{'<br>' if more else ''}{more}"
    elif detected is not None:
        yield "Detected", clock_time(detected), ""
    for fault in diagnosis.faults:
        size, low, high = size_of(fault.ratio, *fault.interval)
        yield "How large", f"{symbol(fault.parameter)} {size}", f"95 %: {low} to {high}"
    if diagnosis.faults:
        yield "How sure", probability(diagnosis.probability), "that it is this fault and no other"
    elif diagnosis.candidates:
        best = diagnosis.candidates[0]
        more = (
            f"for {escape(best.name)}; 95.0 % would name the fault"
            if best.name != UNKNOWN
            else "that no known fault explains it"
        )
        yield "How sure", probability(best.probability), more


def _quiet_facts(diagnosis: Diagnosis, trace: Trace) -> Iterable[tuple[str, str, str]]:
    value = trace.statistic[trace.ready & np.isfinite(trace.statistic)]
    yield "Watched", clock_time(diagnosis.duration_s), f"{value.size} evaluations"
    if value.size:
        top = float(value.max())
        share = f"{100.0 * top / trace.threshold:.0f} % of the threshold of {number(trace.threshold, 3)}"
        yield "Largest statistic T²", number(top, 3), share
    count = len(diagnosis.warnings)
    yield "Warnings", str(count) if count else "none", "listed below" if count else "about this recording"


def _pictures(diagnosis: Diagnosis, trace: Trace, recording: Recording, loop: Loop) -> str:
    from servoscope import canvas, figures  # late: matplotlib takes half a second to import

        drawn = (
        (
            "Change over time",
            "One number for the distance from healthy. Above the dashed line, chance is no longer an explanation:"
            f" a healthy loop gets there {_budget(loop)}.",
            figures.statistic(trace, diagnosis),
        ),
        (
            "Signals",
            "Reference, output, tracking error and input as recorded. Grey bands are gaps, in which nothing was recorded.",
            figures.signals(recording, diagnosis, units=units(loop.plant.kind)),
        ),
        (
            "Inverse frequency response",
            "The input that the actuator asks for per unit of output, as a complex number at each monitored frequency."
            " The diamond is where a healthy actuator would be; a change shows where the ellipse of the estimate leaves"
            " it. Each panel has its own scales.",
            figures.ifrf(trace, diagnosis),
        ),
        (
            "Coefficients",
            "The estimated coefficients of the actuator's inverse, relative to what a healthy one would show under the"
            " same reference.",
            figures.coefficients(trace, diagnosis),
        ),
    )
    return "\n".join(
        section(name, why, f"<figure>{canvas.svg(figure, f'f{i}')}</figure>")
        for i, (name, why, figure) in enumerate(drawn)
    )


def _budget(loop: Loop) -> str:
    allowed = loop.monitor.false_alarms_per_year
    return "at most once a year" if allowed == 1.0 else f"at most {quantity(allowed)} times a year"


