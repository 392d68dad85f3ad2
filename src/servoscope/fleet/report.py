"""The report on a fleet as one HTML page: who is ill, what is common, what changed, what could not be examined."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

from servoscope.core.files import atomic_write, make_folder
from servoscope.core.messages import Message, count_words, message, say, translate
from servoscope.fleet.rows import MICRO
from servoscope.fleet.summary import COMMON, FAILED, RATE, Fleet
from servoscope.report.format_values import DASH, format_clock_time, format_count, format_size
from servoscope.report.page import render_page, write_page

MAX_TABLE_ROWS = 300  # of a table: a page is read by people
MAX_NAMES, MAX_CAUSES = 20, 3  # in a sentence
MAX_DAYS = 60  # of the picture of days
MIN_PROBABILITY_SHOWN = 0.05  # probability of a common cause that is worth its row
MIN_EPOCH_S = 1e9  # s since 1970 from which a time is a date, not a time since some start
TONES = {
    "healthy": "var(--measured)",
    "fault": "var(--alarm)",
    "suspect": "var(--care)",
    COMMON: "var(--ink)",
    "undetermined": "var(--reference)",
    FAILED: "none",
}


def write_fleet_report(output: Path, fleet: Fleet, lake: str) -> None:
    """Write fleet.json and report.html into a folder; nothing half-written stays behind.

    Raises OutputError if a file cannot be written.
    """
    make_folder(output)
    atomic_write(output / "fleet.json", json.dumps(fleet.to_dict(), indent=1, allow_nan=False).encode() + b"\n")
    write_page(output / "report.html", render_fleet_page(fleet, lake))


def render_fleet_page(fleet: Fleet, lake: str) -> str:
    """Return report.html; it needs nothing from outside."""
    states = ("healthy", "fault", "suspect", COMMON, "undetermined", FAILED)
    late = sorted(fleet.late.items(), key=lambda pair: -pair[1])
    return render_page(
        "fleet.html",
        package="servoscope.fleet",
        title=f"{translate('Fleet')}: {lake}",
        kind="fault" if fleet.accepted or fleet.count("fault") else "healthy",
        lake=lake,
        fleet=fleet,
        facts=[
            count_words(format_count(len(fleet.assets)), "asset"),
            count_words(format_count(sum(map(len, fleet.states.values()))), "item"),
        ],
        headline=headline(fleet),
        discoveries=describe_discoveries(fleet),
        counts=[(state, n) for state in states if (n := fleet.count(state)) or state == "healthy"],
        causes=[
            (cause, since)
            for cause, since in zip(fleet.causes, fleet.since, strict=True)
            if cause.probability >= MIN_PROBABILITY_SHOWN
        ],
        ill=[asset for asset in fleet.assets if asset.state not in ("healthy", FAILED)],
        changed=[asset for asset in fleet.assets if asset.before is not None and asset.before != asset.state],
        days=sorted({day for some in fleet.states.values() for day in some})[-MAX_DAYS:],
        shown=[asset.asset for asset in fleet.assets][:MAX_TABLE_ROWS],
        late=[(asset, format_count(rows)) for asset, rows in late],
        most=MAX_TABLE_ROWS,
        tones=TONES,
        size=lambda fault: format_size(fault.ratio, *fault.interval),
        time=_format_time,
    )


def headline(fleet: Fleet) -> str:
    """Return what there is to know first, as plain text."""
    ill, shared = fleet.count("fault"), fleet.accepted
    parts = list[Message | str]()
    if shared:
        named = [f"{cause.key} {cause.group}" for cause in shared[:MAX_CAUSES]]
        parts.append(message("fleet.shared", causes=len(shared), named=named, more=_more(len(shared) > MAX_CAUSES)))
    if ill:
        parts.append(count_words(ill, "ill_asset"))
    return say("fleet.headline", parts=parts) if parts else say("fleet.unchanged")


def describe_discoveries(fleet: Fleet) -> str:
    """Return which assets have changed at the false discovery rate, as plain text; empty where none has."""
    names = fleet.discovered
    shown, surplus = names[:MAX_NAMES], _more(len(names) > MAX_NAMES)
    values = {"count": len(names), "assets": len(fleet.assets), "names": shown, "more": surplus, "rate": RATE}
    return say("fleet.discovered", **values) if names else ""


def _more(several: bool) -> Message | None:
    return message("fleet.more_names") if several else None


def _format_time(t_us: int | None) -> str:
    if t_us is None:
        return DASH
    seconds = t_us / MICRO
    return (
        f"{datetime.fromtimestamp(round(seconds), UTC):%Y-%m-%d %H:%M:%S}"
        if seconds > MIN_EPOCH_S
        else format_clock_time(seconds)
    )
