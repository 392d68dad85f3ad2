"""How a store looks in a terminal: assets as they are now, and rows of history."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from servoscope.cli.terminal import COLOURS, span
from servoscope.store.history import dated

__all__ = ["alarm_rows", "page", "rows"]

OLD_S = 60.0
OUTCOME = 80  # characters that are shown of what a receiver said
WIDE = 110  # columns of a terminal, and 9 for each frequency

NE107 = {
    "good": "green",
    "maintenance_required": "blue",
    "out_of_specification": "yellow",
    "function_check": "yellow",
    "failure": "red",
}


def clock(t: float | None) -> str:
    """Return a time, UTC, to the second."""
    return "-" if t is None else dated(t)


def assets(statuses: Mapping[str, Mapping[str, Any]], width: int) -> Table:
    """Return a table of assets: verdict, since when, residuals, alarms; on a wide terminal more of each."""
    followed = {name: row for name, row in statuses.items() if not row["status"].get("service")}
    frequencies = sorted({f for row in followed.values() for f, *_ in row["status"].get("residual", ())})
    wide = width >= WIDE + 9 * len(frequencies)
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("asset", "verdict", "since (UTC)", *(("T²/limit", "test") if wide else ())):
        table.add_column(name, justify="right" if name in ("T²/limit", "test") else "left", no_wrap=True)
    for f in frequencies:
        table.add_column(f"γ {f:g} Hz", justify="right", no_wrap=True)
    table.add_column("alarms", overflow="fold")
    for name in ("NE 107", "last sample", "stored") if wide else ():
        table.add_column(name, no_wrap=True)
    now = time.time()
    for name, row in followed.items():
        status = row["status"]
        residual = {f: (real, imaginary, healthy) for f, real, imaginary, healthy in status.get("residual", ())}
        tests = number(status.get("statistic")), number(status.get("level"))
        ne107 = Text(status["ne107"].replace("_", " "), NE107.get(status["ne107"], ""))
        more = ne107, clock(status["counted"]["t"]), f"{span(round(max(0.0, now - row['at']), 1))} ago"
        table.add_row(
            name,
            Text(status["verdict"], COLOURS.get(status["verdict"], "")),
            clock(status["since"]),
            *(tests if wide else ()),
            *(share(residual.get(f)) for f in frequencies),
            standing(status["alarms"]),
            *(more if wide else ()),
        )
    return table


def services(statuses: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a line for each service that has something to say of itself."""
    lines = []
    for name, row in statuses.items():
        if not row["status"].get("service"):
            continue
        flood, alarms = row["status"]["flood"], standing(row["status"]["alarms"])
        told = [alarms] if alarms != "-" else []
        told += [f"flood since {clock(flood['since'])}, {flood['held']} held"] if flood["since"] is not None else []
        lines += [f"{name}: {', '.join(told)}"] if told else []
    return lines


def faults(statuses: Mapping[str, Mapping[str, Any]], diagnoses: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a line for each asset with a fault: what its full diagnosis says, or what is known until then."""
    lines = []
    for name, row in statuses.items():
        status, full = row["status"], diagnoses.get(name)
        if status.get("verdict") == "fault":
            known = full is not None and full["verdict"] == "fault"
            lines.append(f"{name}: {full['summary'] if known and full is not None else status['summary']}")
    return lines


def silence(statuses: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a line if what is shown is old: a table that stands still looks like machines that are well."""
    age = time.time() - max((row["at"] for row in statuses.values()), default=time.time())
    return [f"Nothing was stored for {span(round(age))}: does servoscope run still run?"] if age > OLD_S else []


def page(statuses: Mapping[str, Mapping[str, Any]], diagnoses: Mapping[str, Mapping[str, Any]], width: int) -> Group:
    """Return all of it."""
    return Group(assets(statuses, width), *faults(statuses, diagnoses), *services(statuses), *silence(statuses))


def standing(alarms: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the alarms that are not normal."""
    told = [f"{name} {one['state'].replace('_', ' ')}" for name, one in alarms.items() if one["state"] != "normal"]
    return ", ".join(told) or "-"


def number(value: float | None) -> str:
    """Return a number to three digits."""
    return "-" if value is None else f"{value:.3g}"


def share(residual: Sequence[float | None] | None) -> str:
    """Return a residual as a share of the healthy response."""
    if residual is None or None in residual or not residual[2]:
        return "-"
    real, imaginary, healthy = (float(part or 0.0) for part in residual)
    return f"{100.0 * math.hypot(real, imaginary) / healthy:.2g} %"


def alarm_rows(statuses: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the alarms that are not normal, one each."""
    return [
        {"asset": name, "alarm": alarm, **one}
        for name, row in statuses.items()
        for alarm, one in row["status"]["alarms"].items()
        if one["state"] != "normal"
    ]


def rows(found: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> Table:
    """Return a table of some columns of rows; times as dates."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in columns:
        table.add_column(
            name.replace("_", " "), overflow="fold", no_wrap=name in ("t", "at", "created", "due", "asset")
        )
    for row in found:
        table.add_row(*(_cell(name, _told(row) if name == "told" else row.get(name)) for name in columns))
    return table


def _told(row: Mapping[str, Any]) -> str:
    """Return what a delivery tells: asset, alarm and event, as far as it has them."""
    event = row["event"]
    words = (event.get("asset"), event.get("alarm"), str(event.get("event", "")).replace("_", " "))
    return " ".join(word for word in words if word)


def _cell(name: str, value: Any) -> str:
    if value is None:
        return "-"
    if name in ("t", "at", "created", "onset", "since", "due", "asked", "from", "until", "time"):
        return clock(value)
    if name == "outcome":
        return str(value) if len(value) <= OUTCOME else f"{value[: OUTCOME - 3]}..."
    if isinstance(value, Mapping):
        return ", ".join(f"{key.replace('_', ' ')}: {_cell(key, one)}" for key, one in value.items() if one != "")
    if name in ("state", "after", "what"):
        return str(value).replace("_", " ")
    return number(value) if isinstance(value, float) else str(value)
