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
from servoscope.wording import (
    DASH,
    clock_time,
    moments,
    number,
    probability,
    quantity,
    ratios,
    signed_percent,
    size_of,
    symbol,
    with_std,
)

__all__ = ["page", "write"]

MOST_WARNINGS = 60
UNLIKELY = 0.05  # a candidate below this probability is not in the headline
UNITS = {"eha": ("m", "A")}  # of y and u, where the kind of plant fixes them
POLICY = "default-src 'none'; style-src 'unsafe-inline'"
KINDS = {
    "fault": ("Fault", '<path d="M12 2 23 21.5H1Z"/><path d="M12 9v6M12 17.4v1.6" stroke="var(--panel)" stroke-width="2.2"/>'),
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
            _candidates(diagnosis, words),
            _pictures(diagnosis, trace, recording, loop),
            _numbers(diagnosis, loop),
            _warnings(diagnosis),
            _settings(loop, provenance),
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
    note = "".join(f'<p class="note">{_with_symbols(text)}.</p>' for text in notes if text and text not in diagnosis.summary)
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
        names = " and ".join(_meaning(fault.name, words) for fault in diagnosis.faults)
        return escape(names[0].upper() + names[1:])
    if diagnosis.candidates and diagnosis.candidates[0].name == UNKNOWN:
        return "The actuator has changed, in a way that no known fault explains"
    likely = [_meaning(c.name, words) for c in diagnosis.candidates if c.name != UNKNOWN and c.probability >= UNLIKELY]
    if len(likely) > 1:
        return escape(f"The actuator has changed: {' or '.join(likely)}")
    return "The actuator has changed; which fault it is remains open"


def _meaning(name: str, words: Mapping[str, str]) -> str:
    if name == UNKNOWN:
        return "none of the known faults"
    return " and ".join(words.get(part, part).partition(" (")[0] for part in name.split("+"))


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
        more = f"for {escape(best.name)}; 95.0 % would name the fault" if best.name != UNKNOWN else "that no known fault explains it"
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


def _candidates(diagnosis: Diagnosis, words: Mapping[str, str]) -> str:
    if not diagnosis.candidates:
        return ""
    rows = []
    for i, candidate in enumerate(diagnosis.candidates):
        percent = 100.0 * min(max(candidate.probability, 0.0), 1.0)
        bar = f'<span class="bar"><i style="width:{percent:.1f}%"></i></span>{probability(candidate.probability)}'
        meaning = _meaning(candidate.name, words)
        name = escape(candidate.name) + (f"<br><small>{escape(meaning)}</small>" if meaning != candidate.name else "")
        sizes: Sequence[FoundFault | None] = candidate.faults or (None,)
        told = [(symbol(f.parameter), *ratios(f.ratio, *f.interval)) if f else None for f in sizes]
        size = "<br>".join(f"{each[0]} × {each[1]}" if each else DASH for each in told)
        interval = "<br>".join(f"{each[2]} to {each[3]}" if each else DASH for each in told)
        mark = ' class="first"' if i == 0 else ""
        rows.append(
            f'<tr{mark}><th scope="row">{name}</th><td class="n">{size}</td><td class="n">{interval}</td>'
            f'<td class="t p">{bar}</td></tr>'
        )
    head = ("Explanation", "*Size, relative to healthy", "*95 % interval", ".Probability")
    why = "What could explain the change, how large each explanation would have to be, and how probable it is."
    return _section("Candidates", why, _table(head, rows))


def _pictures(diagnosis: Diagnosis, trace: Trace, recording: Recording, loop: Loop) -> str:
    from servoscope import canvas, figures  # late: matplotlib takes half a second to import

    units = UNITS.get(loop.plant.kind, ("", ""))
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
            figures.signals(recording, diagnosis, units=units),
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
        _section(name, why, f"<figure>{canvas.svg(figure, f'f{i}')}</figure>")
        for i, (name, why, figure) in enumerate(drawn)
    )


def _budget(loop: Loop) -> str:
    allowed = loop.monitor.false_alarms_per_year
    return "at most once a year" if allowed == 1.0 else f"at most {quantity(allowed)} times a year"


def _numbers(diagnosis: Diagnosis, loop: Loop) -> str:
    of_y, of_u = UNITS.get(loop.plant.kind, ("", ""))
    powers = dict(zip(loop.plant.names, loop.plant.powers, strict=False))
    rows = []
    for name, p in diagnosis.parameters.items():
        value, std, nominal = with_std(p.value, p.std, p.nominal)
        change = signed_percent(p.value / p.nominal - 1.0) if p.nominal else DASH
        away = number((p.value - p.nominal) / p.std, 2) if p.std > 0.0 else DASH
        unit = _unit(of_u, of_y, powers.get(name)) if of_u else ""
        rows.append(_row(symbol(name), unit, value, std, nominal, change, away))
    head = ("Coefficient", "Unit", "*Estimate", "*Standard deviation", "*Healthy", "*Change", "*In standard deviations")
    first = _section("Coefficients at the end of the recording", "", _table(head, rows))
    rows = []
    for point in diagnosis.ifrf:
        H = complex(point.real, point.imag)
        healthy = complex(point.nominal_real, point.nominal_imag)
        re, re_std, re_healthy = with_std(point.real, point.real_std, point.nominal_real)
        im, im_std, im_healthy = with_std(point.imag, point.imag_std, point.nominal_imag)
        ratio = H / healthy if healthy else complex(np.nan)
        turn = number(float(np.degrees(np.angle(ratio))), 2)
        cells = (f"{re} ± {re_std}", re_healthy, f"{im} ± {im_std}", im_healthy, signed_percent(abs(ratio) - 1.0), turn)
        rows.append(_row(f"{quantity(point.frequency_hz)} Hz", None, *cells))
    head = ("Frequency", "*Real part", "*healthy", "*Imaginary part", "*healthy", "*Magnitude", "*Phase [°]")
    why = f"Real and imaginary parts{f' in {of_u}/{of_y}' if of_u else ''} with one standard deviation;"
    why += " magnitude and phase are changes from healthy."
    return first + "\n" + _section("Inverse frequency response at the end of the recording", why, _table(head, rows))


def _unit(of_u: str, of_y: str, power: int | None) -> str:
    if power is None:
        return of_u
    seconds = ("", " s", " s²", " s³", " s⁴")[power]
    return f"{of_u}{seconds}/{of_y}"


def _warnings(diagnosis: Diagnosis) -> str:
    if not diagnosis.warnings:
        return _section("Warnings", "None: no defects of the recording, no doubts about the result.", "")
    rows = []
    for w in diagnosis.warnings[:MOST_WARNINGS]:
        when = number(w.from_s) if w.from_s == w.to_s else f"{number(w.from_s)} to {number(w.to_s)}"
        rows.append(
            f'<tr><td class="t">{when}</td><th scope="row" class="t">{escape(w.kind)}</th>'
            f'<td class="n">{w.count}</td><td class="w">{escape(w.message)}</td></tr>'
        )
    more = len(diagnosis.warnings) - MOST_WARNINGS
    rest = f"<p>And {more} more.</p>" if more > 0 else ""
    why = "What the reader should know about the recording; nothing was interpolated."
    return _section("Warnings", why, _table(("Time [s]", "Kind", "*Rows", "What happened"), rows) + rest, "long")


def _settings(loop: Loop, provenance: Mapping[str, str]) -> str:
    settings = loop.to_dict()
    tables = [("Where this comes from", dict(provenance))]
    tables.append(("Loop", {k: v for k, v in settings.items() if not isinstance(v, Mapping)}))
    tables += [(f"[{k}]", v) for k, v in settings.items() if isinstance(v, Mapping)]
    blocks = []
    for name, table in tables:
        rows = [
            f'<tr><th scope="row"><span class="key">{escape(str(key))}</span></th><td>{_setting(value)}</td></tr>'
            for key, value in table.items()
            if value is not None
        ]
        blocks.append(f"<div><h3>{escape(name)}</h3><table><tbody>{''.join(rows)}</tbody></table></div>")
    why = "Everything that is needed to get the same result again: the loop file and the baseline."
    return _section("Settings", why, f'<div class="settings">{"".join(blocks)}</div>', "long")


def _setting(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return quantity(value)
    if isinstance(value, Mapping):
        return ", ".join(f"{escape(str(key))} = {_setting(each)}" for key, each in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_setting(each) for each in value) or "none"
    return escape(str(value))


def _section(title: str, why: str, content: str, kind: str = "whole") -> str:
    lead = f"\n<p>{why}</p>" if why else ""
    return f'<section class="{kind}">\n<h2>{title}</h2>{lead}\n{content}\n</section>'


def _row(name: str, words: str | None, *numbers: str) -> str:
    told = "" if words is None else f'<td class="t">{words}</td>'
    return f'<tr><th scope="row" class="t">{name}</th>{told}' + "".join(f'<td class="n">{x}</td>' for x in numbers) + "</tr>"


def _table(head: Iterable[str], rows: Iterable[str]) -> str:
    """Return a table; a heading with a leading asterisk stands over numbers, one with a full stop over bars."""
    classes = {"*": ' class="n"', ".": ' class="p"'}
    cells = "".join(f'<th scope="col"{classes.get(name[0], "")}>{name.lstrip("*.")}</th>' for name in head)
    return f'<div class="scroll"><table><thead><tr>{cells}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
