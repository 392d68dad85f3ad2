"""Queries of the history: diagnoses, alarms, audit, residuals, deliveries, over a time, of some assets."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa

from servoscope.service.store import tables
from servoscope.service.store.rows import Row
from servoscope.service.store.store import Store

PART_MARGIN = 0.01  # of a part's width, by which its rows are looked for outside of it: times are rounded
HISTORY_KINDS: Mapping[str, tuple[sa.Table, str]] = {  # the table, and its column with the time
    "diagnoses": (tables.diagnoses, "t"),
    "alarms": (tables.transitions, "t"),
    "audit": (tables.audit, "at"),
    "residuals": (tables.residuals, "t"),
    "deliveries": (tables.outbox, "created"),
}


def query_history(
    store: Store,
    kind: str,
    *,
    assets: Sequence[str] = (),
    span: tuple[float | None, float | None] = (None, None),
    last: int | None = None,
) -> list[Row]:
    """Return rows in the order of time: of these assets, or all; from, and before, the times of `span` [UTC s].

    With `last` only the newest of them.
    """
    table, clock = HISTORY_KINDS[kind]
    query = sa.select(table).where(*tables.within(table.c[clock], span))
    if assets:
        of = table.c.asset if "asset" in table.c else table.c.event["asset"].as_string()  # of a delivery
        query = query.where(of.in_(assets))
    ties = [column.desc() for column in table.primary_key]
    return store.fetch(query.order_by(table.c[clock].desc(), *ties).limit(last))[::-1]


def query_downsampled(store: Store, asset: str, span: tuple[float, float], points: int) -> tuple[list[Row], int]:
    """Return an asset's residuals over a time at a resolution that can be drawn, and how many rows they represent.

    The time from and before `span` [UTC s] is cut into `points` equal parts. Of each that has rows the one with the
    largest statistic is returned, with the largest level of the part: what was above a limit remains so.
    """
    table, (since, until) = tables.residuals, span
    width = (until - since) / points

    def part_of(t: Any) -> Any:
        return sa.cast(sa.func.floor((t - since) / width), sa.BigInteger)

    parts = (
        sa.select(
            part_of(table.c.t).label("part"),
            sa.func.max(table.c.statistic).label("statistic"),
            sa.func.max(table.c.level).label("level"),
            sa.func.count().label("rows"),
        )
        .where((table.c.asset == asset) & (table.c.t >= since) & (table.c.t < until))
        .group_by(sa.text("part"))
        .subquery()
    )
    # which row that was is looked up by time: ranks of all rows would take three times as long
    begin = since + width * (parts.c.part - PART_MARGIN)
    is_there = (table.c.t >= begin) & (table.c.t < begin + width * (1.0 + 2.0 * PART_MARGIN))
    is_it = (part_of(table.c.t) == parts.c.part) & (table.c.statistic == parts.c.statistic)
    first = sa.func.min(table.c.number).label("number")
    top = (
        sa.select(parts.c.part, parts.c.level, parts.c.rows, first)
        .join_from(parts, table, (table.c.asset == asset) & is_there & is_it)
        .group_by(parts.c.part, parts.c.level, parts.c.rows)
        .subquery()
    )
    rows = store.fetch(
        sa.select(table.c.t, table.c.statistic, top.c.level, table.c.residual, top.c.rows)
        .join(top, (table.c.asset == asset) & (table.c.number == top.c.number))
        .order_by(top.c.part)
    )
    return rows, sum(row["rows"] for row in rows)


def format_time(t: float, timespec: str = "seconds") -> str:
    """Return a time [UTC s] as date and time; as a number where a wrong clock was outside of the calendar."""
    try:
        return datetime.fromtimestamp(t, UTC).replace(tzinfo=None).isoformat(" ", timespec)
    except (OverflowError, ValueError, OSError):
        return f"{t:.0f} s"


def with_time_text(row: Row) -> dict[str, Any]:
    """Return a row with its times as text as well: ``time`` beside ``t``."""
    clock = next(row[name] for name in ("t", "at", "created") if name in row)
    date = format_time(clock, "milliseconds")
    return {"time": date if date.endswith("s") else f"{date.replace(' ', 'T')}+00:00", **row}


def rows_to_columns(rows: Sequence[Row]) -> dict[str, list[Any]]:
    """Return rows as columns for a table: residuals in columns of their own, documents as JSON text."""
    flat = [_flatten_row(with_time_text(row)) for row in rows]
    names = dict.fromkeys(name for row in flat for name in row)
    return {name: [row.get(name) for row in flat] for name in names}


def _flatten_row(row: Mapping[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in row.items():
        if name == "residual":
            for f, real, imaginary, healthy in value:
                flat |= {f"gamma_{f:g}Hz_real": real, f"gamma_{f:g}Hz_imag": imaginary, f"healthy_{f:g}Hz": healthy}
        else:
            flat[name] = json.dumps(value) if isinstance(value, dict | list) else value
    return flat
