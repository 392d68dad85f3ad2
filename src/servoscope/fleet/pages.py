"""The report on a fleet as one HTML page: who is ill, what is common, what changed, what could not be examined."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from html import escape
from pathlib import Path

from servoscope.fleet.knowledge import COMMON, FAILED, Fleet, Known
from servoscope.fleet.rows import MICRO
from servoscope.output import atomic_write, make_folder
from servoscope.report.document import KINDS, framed
from servoscope.report.sheets import cell, section, table
from servoscope.report.wording import DASH, clock_time, count, probability, size_of, symbol

__all__ = ["headline", "page", "write_knowledge"]

MOST_ROWS = 300  # of a table: a page is read by people
MOST_DAYS = 60  # of the picture of days
LEAST = 1e9  # s since 1970 from which a time is a date, not a time since some start
TONES = {
    "healthy": "var(--measured)",
    "fault": "var(--alarm)",
    COMMON: "var(--ink)",
    "undetermined": "var(--reference)",
    FAILED: "none",
}


def write_knowledge(output: Path, fleet: Fleet, lake: str) -> None:
    """Write fleet.json and report.html into a folder; nothing half-written stays behind.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    make_folder(output)
    atomic_write(output / "fleet.json", json.dumps(fleet.to_dict(), indent=1, allow_nan=False).encode() + b"\n")
    atomic_write(output / "report.html", page(fleet, lake).encode("utf-8", errors="replace"))


def page(fleet: Fleet, lake: str) -> str:
    """Return report.html; it needs nothing from outside."""
    kind = "fault" if fleet.accepted or fleet.count("fault") else "healthy"
    sections = (_header(fleet, lake), _verdict(fleet, kind), _common(fleet), _ill(fleet), _changed(fleet), _days(fleet))
    return framed(f"Fleet: {lake}", kind, (*sections, _failed(fleet), _unlearned(fleet), _late(fleet)))


def _header(fleet: Fleet, lake: str) -> str:
    items = sum(len(days) for days in fleet.states.values())
    told = f"{count(len(fleet.assets))} assets, {count(items)} items"
    return f"<header><span><strong>{escape(lake)}</strong></span><span>{told}</span></header>"


def _verdict(fleet: Fleet, kind: str) -> str:
    title, icon = KINDS[kind]
    states = ("healthy", "fault", COMMON, "undetermined", FAILED)
    facts = [(state, n) for state in states if (n := fleet.count(state)) or state == "healthy"]
    lines = (
        '<div class="verdict">',
        f'<p class="kind"><svg viewBox="0 0 24 24" aria-hidden="true">{icon}</svg>{title}</p>',
        f"<h1>{escape(headline(fleet))}</h1>",
        '<p class="summary">Each asset on its last day. What a group shares is told once, as a common cause.</p>',
        '<dl class="facts">',
        *(f'<div><dt>{name.capitalize()}</dt><dd><b class="big">{count(n)}</b></dd></div>' for name, n in facts),
        "</dl>\n</div>",
    )
    return "\n".join(lines)


def headline(fleet: Fleet) -> str:
    """Return what there is to know first, as plain text."""
    ill, shared = fleet.count("fault"), len(fleet.accepted)
    parts = []
    if shared:
        named = ", ".join(f"{cause.key} {cause.group}" for cause in fleet.accepted[:3])
        parts.append(f"{shared} common cause{'s' * (shared > 1)} ({named}{', ...' * (shared > 3)})")
    if ill:
        parts.append(f"{ill} asset{'s' * (ill > 1)} ill by {'themselves' if ill > 1 else 'itself'}")
    return " and ".join(parts) if parts else "No asset has changed from its healthy baseline"


def _common(fleet: Fleet) -> str:
    rows = []
    for cause, since in zip(fleet.causes, fleet.since, strict=True):
        if cause.probability < 0.05:
            continue
        size, low, high = size_of(cause.ratio, *cause.interval)
        cells = (
            f'<th scope="row">{escape(cause.key)} {escape(cause.group)}</th>',
            cell(count(len(cause.members))),
            f"<td>{symbol(cause.parameter)} {size}<br><small>95 %: {low} to {high}</small></td>",
            cell(probability(cause.parameter_probability)),
            f"<td>{escape(since) or DASH}</td>",
            cell(probability(cause.probability)),
        )
        mark = ' class="first"' if cause in fleet.accepted else ""
        rows.append(f"<tr{mark}>{''.join(cells)}</tr>")
    if not rows:
        return section("Common causes", "None: no group of assets has changed together.", "")
    why = (
        "Groups whose assets changed together: the probability is that of one change that all members share, against"
        " faults of each for itself. From 95 % on it is named, and its members count as one fault."
    )
    head = ("Group", "*Assets", "What", "*This parameter", "Since", "*Probability")
    return section("Common causes", why, table(head, rows))


def _ill(fleet: Fleet) -> str:
    some = [one for one in fleet.assets if one.state not in ("healthy", FAILED)]
    if not some:
        return section("Who is ill", "Nobody: all assets that could be examined are healthy on their last day.", "")
    why = (
        "Assets that are not healthy on their last day, faults of their own first. Own: the probability that the asset"
        " has a fault of its own, whatever its group has."
    )
    head = ("Asset", "State", "What", "Since", "*Own", "Diagnosis")
    return section("Who is ill", why, table(head, map(_row, some[:MOST_ROWS])) + _more(len(some)), "long")


def _row(one: Known) -> str:
    what = DASH
    if one.ratio is not None and one.interval is not None:
        size, low, high = size_of(one.ratio, *one.interval)
        what = f"{symbol(one.parameter)} {size}<br><small>95 %: {low} to {high}</small>"
    groups = ", ".join(f"{key} {group}" for key, group in one.groups.items())
    cells = (
        f'<th scope="row">{escape(one.asset)}<br><small>{escape(groups)}</small></th>',
        f"<td>{escape(one.state)}<br><small>{escape(one.day)}</small></td>",
        f"<td>{what}</td>",
        f'<td class="t">{_time(one.since_us)}</td>',
        cell(probability(one.probability)),
        f"<td>{escape(one.said)}</td>",
    )
    return f"<tr>{''.join(cells)}</tr>"


def _changed(fleet: Fleet) -> str:
    some = [one for one in fleet.assets if one.before is not None and one.before != one.state]
    why = "Assets whose state is another than on the day before." if some else "No asset's state."
    rows = [
        f'<tr><th scope="row">{escape(one.asset)}</th><td>{escape(one.before or "")}</td>'
        f"<td>{escape(one.state)}</td><td>{escape(one.day)}</td></tr>"
        for one in some[:MOST_ROWS]
    ]
    content = table(("Asset", "Was", "Is", "On"), rows) + _more(len(some)) if some else ""
    return section("What changed", why, content, "long")


def _days(fleet: Fleet) -> str:
    """Return the picture of states by asset and day."""
    days = sorted({day for some in fleet.states.values() for day in some})[-MOST_DAYS:]
    shown = [one.asset for one in fleet.assets][:MOST_ROWS]
    if len(days) < 2:
        return ""
    width, height, left = 900 / len(days), 14, 160
    parts = []
    for i, asset in enumerate(shown):
        parts.append(f'<text x="{left - 8}" y="{i * height + 10}" text-anchor="end">{escape(asset[:24])}</text>')
        for j, day in enumerate(days):
            state = fleet.states[asset].get(day)
            if state is not None:
                line = ' stroke="var(--alarm)" stroke-dasharray="2 2"' if state == FAILED else ""
                box = f'x="{left + j * width + 1:.1f}" y="{i * height + 1}" width="{max(width - 2, 1):.1f}"'
                name = f"<title>{escape(asset)} {escape(day)}: {escape(state)}</title>"
                parts.append(f'<rect {box} height="{height - 3}" fill="{TONES[state]}"{line}>{name}</rect>')
    below = len(shown) * height + 14
    for at, anchor, day in ((left, "start", days[0]), (left + 900, "end", days[-1])):
        parts.append(f'<text x="{at}" y="{below}" text-anchor="{anchor}">{escape(day)}</text>')
    box = f'viewBox="0 0 {left + 900} {below + 6}" font-size="10" fill="currentColor"'
    why = (
        "Each row an asset, each column a day. Blue: healthy; orange: a fault of its own; dark: a common cause; grey:"
        " undetermined; dashed: could not be examined; nothing: no recording."
    )
    return section("Days", why, f'<figure aria-label="Days"><svg {box}>{"".join(parts)}</svg></figure>', "long")


def _failed(fleet: Fleet) -> str:
    if not fleet.failed:
        return section("Not examined", "Nothing: all items could be examined.", "")
    why = "Items that could not be examined; they cost nothing but themselves, and are tried again in the next run."
    rows = [
        f'<tr><th scope="row">{escape(asset)}</th><td class="t">{escape(day)}</td><td>{escape(error)}</td></tr>'
        for asset, day, error in fleet.failed[:MOST_ROWS]
    ]
    return section("Not examined", why, table(("Asset", "Day", "Why"), rows) + _more(len(fleet.failed)), "long")


def _unlearned(fleet: Fleet) -> str:
    if not fleet.unlearned:
        return ""
    rows = [
        f'<tr><th scope="row">{escape(name)}</th><td>{escape(error)}</td></tr>'
        for name, error in list(fleet.unlearned.items())[:MOST_ROWS]
    ]
    why = "Assets or groups without a baseline, or with healthy days that could not be used for it."
    return section("Not learned", why, table(("Asset or group", "Why"), rows) + _more(len(fleet.unlearned)), "long")


def _late(fleet: Fleet) -> str:
    if not fleet.late:
        return ""
    total = count(sum(fleet.late.values()))
    most = sorted(fleet.late.items(), key=lambda pair: -pair[1])[:MOST_ROWS]
    rows = [f'<tr><th scope="row">{escape(asset)}</th>{cell(count(n))}</tr>' for asset, n in most]
    why = f"{total} rows came after the watermark had passed them, and were left out."
    return section("Late rows", why, table(("Asset", "*Rows"), rows) + _more(len(fleet.late)), "long")


def _more(total: int) -> str:
    return f"\n<p>And {count(total - MOST_ROWS)} more, in diagnoses.parquet.</p>" if total > MOST_ROWS else ""


def _time(t_us: int | None) -> str:
    if t_us is None:
        return DASH
    seconds = t_us / MICRO
    return (
        f"{datetime.fromtimestamp(round(seconds), UTC):%Y-%m-%d %H:%M:%S}" if seconds > LEAST else clock_time(seconds)
    )
