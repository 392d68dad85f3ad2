"""The sections of a report that are tables: candidates, coefficients, iFRF, warnings, settings; HTML to put in."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from servoscope.diagnosis import Diagnosis, FoundFault
from servoscope.loop import Loop
from servoscope.wording import (
    DASH,
    meaning,
    number,
    probability,
    quantity,
    ratios,
    signed_percent,
    symbol,
    units,
    with_std,
)

__all__ = ["candidates", "numbers", "section", "settings", "warnings"]

MOST_WARNINGS = 60


def section(title: str, why: str, content: str, kind: str = "whole") -> str:
    lead = f"\n<p>{why}</p>" if why else ""
    return f'<section class="{kind}">\n<h2>{title}</h2>{lead}\n{content}\n</section>'


def candidates(diagnosis: Diagnosis, words: Mapping[str, str]) -> str:
    if not diagnosis.candidates:
        return ""
    rows = []
    for i, candidate in enumerate(diagnosis.candidates):
        percent = 100.0 * min(max(candidate.probability, 0.0), 1.0)
        bar = f'<span class="bar"><i style="width:{percent:.1f}%"></i></span>{probability(candidate.probability)}'
        means = meaning(candidate.name, words)
        name = escape(candidate.name) + (
            f"<br><small>{escape(means)}</small>" if means != candidate.name else ""
        )
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
    why = (
        "What could explain the change, how large each explanation would have to be, and how probable it is."
    )
    return section("Candidates", why, _table(head, rows))


def numbers(diagnosis: Diagnosis, loop: Loop) -> str:
    of_y, of_u = units(loop.plant.kind)
    powers = dict(zip(loop.plant.names, loop.plant.powers, strict=False))
    rows = []
    for name, p in diagnosis.parameters.items():
        value, std, nominal = with_std(p.value, p.std, p.nominal)
        change = signed_percent(p.value / p.nominal - 1.0) if p.nominal else DASH
        away = number((p.value - p.nominal) / p.std, 2) if p.std > 0.0 else DASH
        unit = _unit(of_u, of_y, powers.get(name)) if of_u else ""
        rows.append(_row(symbol(name), unit, value, std, nominal, change, away))
    head = (
        "Coefficient",
        "Unit",
        "*Estimate",
        "*Standard deviation",
        "*Healthy",
        "*Change",
        "*In standard deviations",
    )
    first = section("Coefficients at the end of the recording", "", _table(head, rows))
    rows = []
    for point in diagnosis.ifrf:
        H = complex(point.real, point.imag)
        healthy = complex(point.nominal_real, point.nominal_imag)
        re, re_std, re_healthy = with_std(point.real, point.real_std, point.nominal_real)
        im, im_std, im_healthy = with_std(point.imag, point.imag_std, point.nominal_imag)
        ratio = H / healthy if healthy else complex(np.nan)
        turn = number(float(np.degrees(np.angle(ratio))), 2)
        cells = (
            f"{re} ± {re_std}",
            re_healthy,
            f"{im} ± {im_std}",
            im_healthy,
            signed_percent(abs(ratio) - 1.0),
            turn,
        )
        rows.append(_row(f"{quantity(point.frequency_hz)} Hz", None, *cells))
    head = ("Frequency", "*Real part", "*healthy", "*Imaginary part", "*healthy", "*Magnitude", "*Phase [°]")
    why = f"Real and imaginary parts{f' in {of_u}/{of_y}' if of_u else ''} with one standard deviation;"
    why += " magnitude and phase are changes from healthy."
    return (
        first
        + "\n"
        + section("Inverse frequency response at the end of the recording", why, _table(head, rows))
    )


def _unit(of_u: str, of_y: str, power: int | None) -> str:
    if power is None:
        return of_u
    seconds = ("", " s", " s²", " s³", " s⁴")[power]
    return f"{of_u}{seconds}/{of_y}"


def warnings(diagnosis: Diagnosis) -> str:
    if not diagnosis.warnings:
        return section("Warnings", "None: no defects of the recording, no doubts about the result.", "")
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
    return section(
        "Warnings", why, _table(("Time [s]", "Kind", "*Rows", "What happened"), rows) + rest, "long"
    )


def settings(loop: Loop, provenance: Mapping[str, str]) -> str:
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


def _row(name: str, words: str | None, *numbers: str) -> str:
    told = "" if words is None else f'<td class="t">{words}</td>'
    return (
        f'<tr><th scope="row" class="t">{name}</th>{told}'
        + "".join(f'<td class="n">{x}</td>' for x in numbers)
        + "</tr>"
    )


def _table(head: Iterable[str], rows: Iterable[str]) -> str:
    """Return a table; a heading with a leading asterisk stands over numbers, one with a full stop over bars."""
    classes = {"*": ' class="n"', ".": ' class="p"'}
    cells = "".join(f'<th scope="col"{classes.get(name[0], "")}>{name.lstrip("*.")}</th>' for name in head)
    return f'<div class="scroll"><table><thead><tr>{cells}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
