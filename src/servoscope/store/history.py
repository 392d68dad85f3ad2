"""What happened, asked of a store: diagnoses, alarms, audit, residuals, deliveries, over a time, of some assets."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa

from servoscope.store import tables
from servoscope.store.batch import Row
from servoscope.store.store import Store

__all__ = ["KINDS", "coarse", "dated", "history", "plain", "spread", "standing"]

KINDS: Mapping[str, tuple[sa.Table, str]] = {  # the table, and which of its columns is the time
    "diagnoses": (tables.diagnoses, "t"),
    "alarms": (tables.transitions, "t"),
    "audit": (tables.audit, "at"),
    "residuals": (tables.residuals, "t"),
    "deliveries": (tables.outbox, "created"),
}


def history(
    store: Store,
    kind: str,
    *,
    assets: Sequence[str] = (),
    span: tuple[float | None, float | None] = (None, None),
    last: int | None = None,
) -> list[Row]:
    """Return rows in the order of time.

    Parameters
    ----------
    store
        Asked.
    kind
        One of `KINDS`.
    assets
        Of these; empty: of all.
    span
        From, and before, a time [UTC s]; None: without bound.
    last
        Only that many, the newest.
    """
    table, clock = KINDS[kind]
    query = sa.select(table)
    if assets:
        of = table.c.asset if "asset" in table.c else table.c.event["asset"].as_string()  # of a delivery
        query = query.where(of.in_(assets))
    if span[0] is not None:
        query = query.where(table.c[clock] >= span[0])
    if span[1] is not None:
        query = query.where(table.c[clock] < span[1])
    ties = [column.desc() for column in table.primary_key]
    found = store.rows(query.order_by(table.c[clock].desc(), *ties).limit(last))
    return found[::-1]


def coarse(store: Store, asset: str, span: tuple[float, float], points: int) -> tuple[list[Row], int]:
    """Return an asset's residuals over a time at a resolution that can be drawn, and how many rows they stand for.

    The time from and before `span` [UTC s] is cut into `points` equal parts. Of each that has rows the one with the
    largest statistic is returned, with the largest level of the part: what was above a limit stays so.
    """
    table, (since, until) = tables.residuals, span
    width = (until - since) / points
    part = sa.cast(sa.func.floor((table.c.t - since) / width), sa.BigInteger).label("part")
    inside = (table.c.asset == asset) & (table.c.t >= since) & (table.c.t < until)
    ranked = sa.select(
        part,
        table.c.number,
        sa.func.max(table.c.level).over(partition_by=part).label("level"),
        sa.func.count().over(partition_by=part).label("rows"),
        sa.func.row_number().over(partition_by=part, order_by=(table.c.statistic.desc(), table.c.number)).label("rank"),
    ).where(inside)
    top = ranked.subquery()
    query = (
        sa.select(table.c.t, table.c.statistic, top.c.level, table.c.residual, top.c.rows)
        .join(top, (table.c.asset == asset) & (table.c.number == top.c.number))
        .where(top.c.rank == 1)
        .order_by(top.c.part)
    )
    rows = store.rows(query)
    return rows, sum(row["rows"] for row in rows)


def standing(store: Store, since: Mapping[str, float]) -> dict[str, Row]:
    """Return the last full diagnosis of each asset since a time [UTC s] that names a fault; the first if none does."""
    table, found = tables.diagnoses, {}
    for asset, begins in since.items():
        wanted = (table.c.asset == asset) & (table.c.grounds == "full") & (table.c.t >= begins)
        for row in store.rows(sa.select(table).where(wanted).order_by(table.c.t, table.c.number)):
            if row["document"].get("faults") or asset not in found:
                found[asset] = row
    return found


def dated(t: float, timespec: str = "seconds") -> str:
    """Return a time [UTC s] as date and time; as a number where a clock was set to what is in no calendar."""
    try:
        return datetime.fromtimestamp(t, UTC).replace(tzinfo=None).isoformat(" ", timespec)
    except (OverflowError, ValueError, OSError):
        return f"{t:.0f} s"


def plain(row: Row) -> dict[str, Any]:
    """Return a row with its times as text as well: ``time`` beside ``t``."""
    clock = next(row[name] for name in ("t", "at", "created") if name in row)
    date = dated(clock, "milliseconds")
    return {"time": date if date.endswith("s") else f"{date.replace(' ', 'T')}+00:00", **row}


def spread(rows: Sequence[Row]) -> dict[str, list[Any]]:
    """Return rows as columns for a table: residuals in columns of their own, documents as JSON text."""
    flat = [_flat(plain(row)) for row in rows]
    names = dict.fromkeys(name for row in flat for name in row)
    return {name: [row.get(name) for row in flat] for name in names}


def _flat(row: Mapping[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in row.items():
        if name == "residual":
            for f, real, imaginary, healthy in value:
                found |= {f"gamma_{f:g}Hz_real": real, f"gamma_{f:g}Hz_imag": imaginary, f"healthy_{f:g}Hz": healthy}
        else:
            found[name] = json.dumps(value) if isinstance(value, dict | list) else value
    return found
