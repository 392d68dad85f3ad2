"""How a store looks in a terminal: assets as they are now, and rows of history."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from rich.table import Table
from rich.text import Text

from servoscope.cli.terminal import COLOURS, span

__all__ = ["alarm_rows", "assets", "rows"]

NE107 = {
    "good": "green",
    "maintenance_required": "blue",
    "out_of_specification": "yellow",
    "function_check": "yellow",
    "failure": "red",
}


def clock(t: float | None) -> str:
    """Return a time, UTC, to the second."""
    return "-" if t is None else datetime.fromtimestamp(t, UTC).strftime("%Y-%m-%d %H:%M:%S")


def assets(statuses: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return a table of assets: verdict, since when, statistics over their limits, residuals, alarms."""
    services = {name: row for name, row in statuses.items() if row["status"].get("service")}
    followed = {name: row for name, row in statuses.items() if name not in services}
    frequencies = sorted({f for row in followed.values() for f, *_ in row["status"].get("residual", ())})
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("asset", "verdict", "since (UTC)", "T²/limit", "level"):
        table.add_column(name, justify="right" if name in ("T²/limit", "level") else "left", no_wrap=name != "verdict")
    for f in frequencies:
        table.add_column(f"|γ|/|H| {f:g} Hz", justify="right")
    for name in ("NE 107", "alarms", "last sample", "stored"):
        table.add_column(name)
    now = time.time()
    for name, row in followed.items():
        status = row["status"]
        residual = {f: (real, imaginary, healthy) for f, real, imaginary, healthy in status.get("residual", ())}
        table.add_row(
            name,
            Text(status["verdict"], COLOURS.get(status["verdict"], "")),
            clock(status["since"]),
            number(status.get("statistic")),
            number(status.get("level")),
            *(share(residual.get(f)) for f in frequencies),
            Text(status["ne107"].replace("_", " "), NE107.get(status["ne107"], "")),
            ", ".join(f"{alarm} {one['state'].replace('_', ' ')}" for alarm, one in status["alarms"].items()) or "-",
            clock(status["counted"]["t"]),
            f"{span(max(0.0, now - row['at']))} ago",
        )
    for name, row in services.items():
        flood, alarms = row["status"]["flood"], row["status"]["alarms"]
        told = [
            f"{alarm} {one['state'].replace('_', ' ')}" for alarm, one in alarms.items() if one["state"] != "normal"
        ]
        told += [f"flood since {clock(flood['since'])}, {flood['held']} held"] if flood["since"] is not None else []
        blanks = [""] * (len(table.columns) - 5)
        table.add_row(Text(name, "dim"), Text("service", "dim"), *blanks, ", ".join(told) or "-", "", "")
    return table


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
        table.add_column(name.replace("_", " "), overflow="fold", no_wrap=name in ("t", "at", "created", "asset"))
    for row in found:
        cells = [row.get(name) for name in columns]
        table.add_row(*(_cell(name, value) for name, value in zip(columns, cells, strict=True)))
    return table


def _cell(name: str, value: Any) -> str:
    if value is None:
        return "-"
    if name in ("t", "at", "created", "onset", "since", "due"):
        return clock(value)
    return number(value) if isinstance(value, float) else str(value)
