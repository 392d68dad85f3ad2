"""How a store looks in a terminal: assets as they are now, and rows of history."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from servoscope.cli.render.results import COLOURS, build_table
from servoscope.core.messages import say, translate
from servoscope.core.number_format import format_rough
from servoscope.report.format_values import DASH, format_duration, plain_name
from servoscope.service.store.queries import format_time

if TYPE_CHECKING:
    from servoscope.service.commissioning import CommissioningRow


OLD_S = 60.0
TIME_COLUMNS = ("t", "at", "created", "onset", "since", "due", "asked", "from", "until", "time")
OUTCOME = 80  # characters that are shown of a receiver's answer
MIN_COLUMNS_OF_WIDE_TABLE = 110  # columns of a terminal, and 9 for each frequency

NE107 = {
    "good": "green",
    "maintenance_required": "blue",
    "out_of_specification": "yellow",
    "function_check": "yellow",
    "failure": "red",
}


def format_timestamp(t: float | None) -> str:
    """Return a time, UTC, to the second."""
    return DASH if t is None else format_time(t)


def asset_table(statuses: Mapping[str, Mapping[str, Any]], width: int) -> Table:
    """Return a table of assets: verdict, since when, residuals, alarms; on a wide terminal more of each."""
    followed = {name: row for name, row in statuses.items() if not row["status"].get("service")}
    frequencies = sorted({f for row in followed.values() for f, *_ in row["status"].get("residual", ())})
    wide = width >= MIN_COLUMNS_OF_WIDE_TABLE + 9 * len(frequencies)
    tests, extra = (("T²/limit", "test"), ("NE 107", "last sample", "stored")) if wide else ((), ())
    head = ("asset", "verdict", "since", *tests, *(f"γ {f:g} Hz" for f in frequencies), "alarms", *extra)
    rows, now = [], time.time()
    for name, row in followed.items():
        status = row["status"]
        residual = {f: (real, imaginary, healthy) for f, real, imaginary, healthy in status.get("residual", ())}
        ne107 = Text(translate(plain_name(status["ne107"])), NE107.get(status["ne107"], ""))
        age = format_duration(round(max(0.0, now - row["at"]), 1))
        cells = (
            Text(name),
            Text(translate(status["verdict"]), COLOURS.get(status["verdict"], "")),
            format_timestamp(status["since"]),
            *((_format_number(status.get("statistic")), _format_number(status.get("level"))) if wide else ()),
            *(format_relative_residual(residual.get(f)) for f in frequencies),
            format_alarms(status["alarms"]),
            *((ne107, format_timestamp(status["counted"]["t"]), say("cli.ago", duration=age)) if wide else ()),
        )
        rows.append(cells)
    return build_table(head, rows, unbroken={*head} - {"alarms"})


def commissioning_table(rows: Sequence[CommissioningRow]) -> Table:
    """Return how assets are heard, for somebody who has just connected them."""
    shown = []
    for row in rows:
        state, age = row.reception.state, row.age_s
        key = "cli.ago" if age >= 0.0 else "cli.ahead"
        when = DASH if math.isnan(age) else say(key, duration=format_duration(round(abs(age), 1)))
        rates = DASH if math.isnan(row.rate_hz) else f"{row.rate_hz:.4g}", f"{row.needed_hz:.4g}"
        heard = Text(translate(plain_name(state)), "green" if state == "followed" else "red")
        shown.append(
            (Text(row.asset), Text(row.source), heard, str(row.blocks), *rates, when, row.reception.why or DASH)
        )
    head = ("asset", "source", "heard", "blocks", "Hz", "needed", "newest sample", "what is wrong")
    return build_table(head, shown, unbroken=head[:-1])


def service_lines(statuses: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a line for each service that has alarms or a flood of them."""
    lines = []
    for name, row in statuses.items():
        if row["status"].get("service"):
            flood, alarms = row["status"]["flood"], format_alarms(row["status"]["alarms"])
            parts = [alarms] if alarms != DASH else []
            if flood["since"] is not None:
                parts.append(say("cli.flood", since=format_timestamp(flood["since"]), held=flood["held"]))
            lines += [f"{name}: {', '.join(parts)}"] if parts else []
    return lines


def fault_lines(statuses: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a line for each asset with a fault."""
    latest = {name: row["status"] for name, row in statuses.items()}
    return [f"{name}: {status['summary']}" for name, status in latest.items() if status.get("verdict") == "fault"]


def stale_store_lines(statuses: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a line if the store is no longer written: a table that does not change looks like healthy machines."""
    age = time.time() - max((row["at"] for row in statuses.values()), default=time.time())
    return [say("cli.stale_store", age=format_duration(round(age)))] if age > OLD_S else []


def status_page(statuses: Mapping[str, Mapping[str, Any]], width: int) -> Group:
    """Return the assets with what there is to say about them."""
    return Group(
        asset_table(statuses, width), *fault_lines(statuses), *service_lines(statuses), *stale_store_lines(statuses)
    )


def format_alarms(alarms: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the alarms that are not normal."""
    states = {name: alarm["state"] for name, alarm in alarms.items() if alarm["state"] != "normal"}
    return ", ".join(f"{translate(name)} {translate(plain_name(state))}" for name, state in states.items()) or DASH


def format_relative_residual(residual: Sequence[float | None] | None) -> str:
    """Return a residual as a share of the healthy response."""
    if residual is None or None in residual or not residual[2]:
        return DASH
    real, imaginary, healthy = (float(part or 0.0) for part in residual)
    return f"{format_rough(100.0 * math.hypot(real, imaginary) / healthy)} %"


def active_alarms(statuses: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the alarms that are not normal, one each."""
    return [
        {"asset": name, "alarm": alarm, **state}
        for name, row in statuses.items()
        for alarm, state in row["status"]["alarms"].items()
        if state["state"] != "normal"
    ]


def row_table(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> Table:
    """Return a table of some columns of rows; times as dates."""
    subjects = ({**row, "subject": _delivery_subject(row)} if "subject" in columns else row for row in rows)
    cells = [[_format_cell(name, row.get(name)) for name in columns] for row in subjects]
    unbroken = [plain_name(name) for name in columns if name in (*TIME_COLUMNS, "asset")]
    return build_table([plain_name(name) for name in columns], cells, unbroken=unbroken)


def _delivery_subject(row: Mapping[str, Any]) -> str:
    """Return the asset, the alarm and the event of a delivery, as far as it has them."""
    event = row["event"]
    words = (event.get("asset"), event.get("alarm"), plain_name(str(event.get("event", ""))))
    return " ".join(word for word in words if word)


def _format_number(value: float | None) -> str:
    return DASH if value is None else f"{value:.3g}"


def _format_cell(name: str, value: Any) -> str:
    if value is None:
        return DASH
    if name in TIME_COLUMNS and isinstance(value, int | float):  # "from" is the address in the audit of a login
        return format_timestamp(value)
    if name == "outcome":
        return str(value) if len(value) <= OUTCOME else f"{value[: OUTCOME - 3]}..."
    if isinstance(value, Mapping):
        return ", ".join(
            f"{plain_name(key)}: {_format_cell(key, nested)}" for key, nested in value.items() if nested != ""
        )
    if name in ("state", "after", "what", "verdict", "priority", "grounds"):
        return translate(plain_name(str(value)))
    return _format_number(value) if isinstance(value, float) else str(value)
