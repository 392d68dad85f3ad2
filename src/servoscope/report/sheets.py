"""The sections of a report that are tables: candidates, coefficients, iFRF, warnings, settings; as HTML."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from servoscope.diagnosis import Diagnosis, FoundFault
from servoscope.loop import Loop
from servoscope.report.wording import (
    DASH,
    correlation,
    count,
    meaning,
    number,
    probability,
    quantity,
    ratios,
    signed_percent,
    symbol,
    with_std,
)

__all__ = ["candidates", "cell", "numbers", "section", "settings", "table", "warnings"]

MOST_WARNINGS = 60
LIKELY = 0.05  # probability from which it is told how the sizes of a pair hang together


def section(title: str, why: str, content: str, kind: str = "whole") -> str:
    """Return a section of the page.

    Parameters
    ----------
    title, why
        Its heading and a sentence on what it shows, as HTML.
    content
        HTML.
    kind
        CSS classes: ``whole`` stays on one page in print, ``long`` may not.
    """
    lead = f"\n<p>{why}</p>" if why else ""
    return f'<section class="{kind}">\n<h2>{title}</h2>{lead}\n{content}\n</section>'


def candidates(diagnosis: Diagnosis, words: Mapping[str, str]) -> str:
    """Return the table of explanations with sizes, intervals and probabilities; nothing where there are none.

    Parameters
    ----------
    diagnosis
        Whose candidates they are.
    words
        Name of a fault -> its words.
    """
    if not diagnosis.candidates:
        return ""
    rows = []
    compared = any(candidate.misfit for candidate in diagnosis.candidates)
    labelled = any(candidate.cosine is not None for candidate in diagnosis.candidates)
    for i, candidate in enumerate(diagnosis.candidates):
        width = 100.0 * min(max(candidate.probability, 0.0), 1.0)
        bar = f'<span class="bar"><i style="width:{width:.1f}%"></i></span>'
        means = meaning(candidate.name, words, candidate.faults[0].ratio if len(candidate.faults) == 1 else 1.0)
        plain = candidate.name.replace("_", " ")
        more = f"<br><small>{escape(means)}</small>" if means != plain.replace(" + ", " and ") else ""
        sizes: Sequence[FoundFault | None] = candidate.faults or (None,)
        told = [
            ("" if f.parameter == candidate.name else f"{symbol(f.parameter)} ", *ratios(f.ratio, *f.interval))
            if f
            else None
            for f in sizes
        ]
        worse = f"{number(float(np.sqrt(candidate.misfit)), 3)} σ" if candidate.misfit else ""
        if candidate.covariance is not None and candidate.probability >= LIKELY:
            more += f"<br><small>sizes correlated by {number(correlation(candidate.covariance), 2)}</small>"
        cells = (
            f'<th scope="row">{escape(plain)}{more}</th>',
            cell("<br>".join(f"{each[0]}× {each[1]}" if each else DASH for each in told)),
            cell("<br>".join(f"{each[2]} to {each[3]}" if each else DASH for each in told)),
            *([cell(worse)] if compared else []),
            f'<td class="t p">{bar}{probability(candidate.probability)}</td>',
        )
        mark = ' class="first"' if i == 0 else ""
        rows.append(f"<tr{mark}>{''.join(cells)}</tr>")
    head = (
        "Explanation",
        f"*Size, relative to {'healthy or labelled' if labelled else 'healthy'}",
        "*95 % interval",
        *(["*Fits worse by"] if compared else []),
        ".Probability",
    )
    why = "What could explain the change, how large each explanation would have to be, how probable it is."
    return section("Candidates", why, table(head, rows), "whole candidates")


def numbers(diagnosis: Diagnosis, loop: Loop) -> str:
    """Return the tables of coefficients and iFRF at the end of the recording, those that have rows."""
    first = _coefficients(diagnosis, loop) if diagnosis.parameters else ""
    second = _responses(diagnosis, loop) if diagnosis.ifrf else ""
    return f"{first}\n{second}"


def _coefficients(diagnosis: Diagnosis, loop: Loop) -> str:
    known = bool(loop.plant.units[1])
    units = dict(zip(loop.plant.names, loop.plant.coefficient_units, strict=True))
    rows = []
    for name, p in diagnosis.parameters.items():
        change = signed_percent(p.value / p.nominal - 1.0) if p.nominal else DASH
        away = number((p.value - p.nominal) / p.std, 2) if p.std > 0.0 else DASH
        unit = f'<td class="t">{units.get(name, "")}</td>' if known else ""
        cells = (*with_std(p.value, p.std, p.nominal), change, away)
        rows.append(f'<tr><th scope="row" class="t">{symbol(name)}</th>{unit}{"".join(map(cell, cells))}</tr>')
    head = ("*Estimate", "*Standard deviation", "*Healthy", "*Change", "*In standard deviations")
    first = ("Coefficient", "Unit") if known else ("Coefficient",)
    return section("Coefficients at the end of the recording", "", table((*first, *head), rows))


def _responses(diagnosis: Diagnosis, loop: Loop) -> str:
    of_y, of_u = loop.plant.units
    rows = []
    for point in diagnosis.ifrf:
        H = complex(point.real, point.imag)
        healthy = complex(point.nominal_real, point.nominal_imag)
        ratio = H / healthy if healthy else complex(np.nan)
        real, real_std, real_healthy = with_std(point.real, point.real_std, point.nominal_real)
        imag, imag_std, imag_healthy = with_std(point.imag, point.imag_std, point.nominal_imag)
        cells = (
            f"{real} ± {real_std}",
            real_healthy,
            f"{imag} ± {imag_std}",
            imag_healthy,
            signed_percent(abs(ratio) - 1.0),
            number(float(np.degrees(np.angle(ratio))), 2),
        )
        frequency = f"{quantity(point.frequency_hz)} Hz"
        rows.append(f'<tr><th scope="row" class="t">{frequency}</th>{"".join(map(cell, cells))}</tr>')
    head = ("Frequency", "*Real part", "*healthy", "*Imaginary part", "*healthy", "*Magnitude", "*Phase [°]")
    unit = f" in {of_u}/{of_y}" if of_u else ""
    why = f"Parts{unit} with one standard deviation; magnitude and phase are changes from healthy."
    return section("Inverse frequency response at the end of the recording", why, table(head, rows))


def warnings(diagnosis: Diagnosis) -> str:
    """Return what the reader should know about the recording, in the order of time."""
    if not diagnosis.warnings:
        return section("Warnings", "None: no defects of the recording, no doubts about the result.", "")
    rows = []
    for w in diagnosis.warnings[:MOST_WARNINGS]:
        when = f"{w.from_s:.2f}" if w.from_s == w.to_s else f"{w.from_s:.2f} to {w.to_s:.2f}"
        cells = (
            f'<td class="t">{when.replace("-", "−")}</td>',
            f'<th scope="row" class="t">{escape(w.kind)}</th>',
            cell(count(w.count)),
            f'<td class="w">{escape(w.message)}</td>',
        )
        rows.append(f"<tr>{''.join(cells)}</tr>")
    more = len(diagnosis.warnings) - MOST_WARNINGS
    rest = f"\n<p>And {more} more.</p>" if more > 0 else ""
    why = "What the reader should know about the recording. Nothing was interpolated."
    found = table(("Time [s]", "Kind", "*Rows", "What happened"), rows)
    return section("Warnings", why, found + rest, "long")


def settings(loop: Loop, provenance: Mapping[str, str]) -> str:
    """Return the settings that a result came about with, section by section of the loop file."""
    settings = loop.to_dict()
    tables: list[tuple[str, Mapping[str, Any]]] = [("Where this comes from", provenance)]
    tables.append(("Loop", {key: value for key, value in settings.items() if not isinstance(value, Mapping)}))
    tables += [(f"[{key}]", value) for key, value in settings.items() if isinstance(value, Mapping)]
    blocks = []
    for name, table in tables:
        rows = [
            f'<tr><th scope="row"><code>{escape(str(key))}</code></th><td>{_setting(value)}</td></tr>'
            for key, value in table.items()
            if value is not None
        ]
        blocks.append(f"<div><h3>{escape(name)}</h3><table><tbody>{''.join(rows)}</tbody></table></div>")
    why = "Everything that is needed to get the same result again: the loop file and the baseline."
    return section("Settings", why, f'<div class="settings">{"".join(blocks)}</div>', "long")


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


def cell(cell: str) -> str:
    """Return a cell that is a number."""
    return f'<td class="n">{cell}</td>'


def table(head: Iterable[str], rows: Iterable[str]) -> str:
    """Return a table; a heading with a leading asterisk stands over numbers, one with a dot over bars."""
    classes = {"*": ' class="n"', ".": ' class="p"'}
    cells = "".join(f'<th scope="col"{classes.get(name[0], "")}>{name.lstrip("*.")}</th>' for name in head)
    body = f"<table><thead><tr>{cells}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
    return f'<div class="scroll">{body}</div>'
