"""Sizes of faults and coefficients over years: what is kept of them, how they are thinned, and how they are read.

A coefficient is stored every ten minutes, a fault's live size at each examination, and the sizes of every full
diagnosis. Of the last `DENSE_S` all of it is kept; before that the mean of each hour, before `HOURLY_S` that of each
day. The sizes of full diagnoses are never thinned.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cache
from typing import Any

import numpy as np
import sqlalchemy as sa

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import StoreError
from servoscope.core.settings_errors import suggest_name
from servoscope.prognosis.series import NORMAL_95, SizeSeries
from servoscope.service.store import tables
from servoscope.service.store.rows import CHECKS, NOTE, Row
from servoscope.service.store.store import Store

Series = FloatArray  # of a fault or coefficient: t, value, low, high, healthy, shape (5, N)
HOUR_S, DAY_S = 3600.0, 86400.0
DENSE_S, HOURLY_S = 7 * DAY_S, 60 * DAY_S
TIERS = ((DENSE_S, HOUR_S), (HOURLY_S, DAY_S))  # from which age on, into parts of which width
FAULT_KINDS = ("full", "live")


def thin_sizes(store: Store, asset: str, now: float, since: float | None = None) -> int:
    """Replace what is old by means over hours and days; return how many rows are gone.

    `now`: by the asset's clock; `since`: when it was done last, None: never. The errors of the values of a mean may be
    the same, so its interval is as wide as theirs.
    """
    gone = 0
    for age, width in TIERS:
        end = math.floor((now - age) / width) * width
        begin = -math.inf if since is None else math.floor((since - age) / width) * width
        mappings = store.fetch(_crowded_parts(width), {"of_asset": asset, "begin": begin, "end": end})
        spans = [{**row, "from_t": row["part"] * width, "to_t": (row["part"] + 1) * width} for row in mappings]
        store.replace_sizes(spans)
        gone += sum(row["rows"] - 1 for row in mappings)
    return gone


@cache  # to make the statement takes longer than to find that there is nothing
def _crowded_parts(width: float) -> sa.Select[Any]:
    """Return the query of the parts of an asset's sizes, `width` [s] each, that hold several rows, with their means."""
    table = tables.sizes
    of_asset = (table.c.asset == sa.bindparam("of_asset")) & (table.c.kind != "full")
    part = sa.cast(sa.func.floor(table.c.t / width), sa.BigInteger).label("part")
    means = [sa.func.avg(table.c[name]).label(name) for name in ("t", "value", "low", "high", "healthy")]
    return (
        sa.select(table.c.asset, table.c.kind, table.c.name, part, sa.func.count().label("rows"), *means)
        .where(of_asset & (table.c.t >= sa.bindparam("begin")) & (table.c.t < sa.bindparam("end")))
        .group_by(table.c.asset, table.c.kind, table.c.name, part)
        .having(sa.func.count() > 1)
    )


def read_series(
    store: Store,
    asset: str,
    span: tuple[float | None, float | None] = (None, None),
    kinds: Iterable[str] = (),
    name: str | None = None,
) -> dict[tuple[str, str], Series]:
    """Return an asset's series, or those of a name, by kind and name: t, value, low, high, healthy, shape (5, N).

    Raises StoreError if the store was made by an older version, and has none yet.
    """
    if not store.has_sizes:
        raise StoreError(f"{store.name}: has no sizes over time yet, servoscope run makes them of its diagnoses")
    table = tables.sizes
    columns = ("kind", "name", "t", "value", "low", "high", "healthy")
    query = sa.select(*(table.c[column] for column in columns)).where(
        table.c.asset == asset, *tables.within(table.c.t, span)
    )
    if name is not None:
        query = query.where(table.c.name == name)
    if chosen := tuple(kinds):
        query = query.where(table.c.kind.in_(chosen))
    numbers_by_series: dict[tuple[str, str], list[tuple[float, ...]]] = {}
    for kind, series_name, *numbers in store.fetch_tuples(query.order_by(table.c.t)):
        numbers_by_series.setdefault((kind, series_name), []).append(tuple(numbers))
    return {key: np.array(rows, dtype=np.float64).T for key, rows in numbers_by_series.items()}


def read_notes(store: Store, asset: str) -> list[Row]:
    """Return what people have noted about an asset, in the order of `t`: with `who`, `text` and `anew`."""
    table = tables.audit
    query = sa.select(table.c.who, table.c.document).where(table.c.asset == asset, table.c.what == NOTE)
    notes = [{"who": row["who"], **row["document"]} for row in store.fetch(query.order_by(table.c.id))]
    return sorted(notes, key=lambda note: float(note["t"]))


def read_new_notes(store: Store, after: int) -> list[Row]:
    """Return the audit's rows of notes behind a row, in their order: `id`, `asset`, `document`."""
    table = tables.audit
    query = sa.select(table.c.id, table.c.asset, table.c.document)
    return store.fetch(query.where(table.c.id > after, table.c.what == NOTE).order_by(table.c.id))


def read_checks(store: Store, asset: str) -> dict[str, Row]:
    """Return what people have written to be checked on an asset, by fault: `texts`, with `who` and `at`."""
    table = tables.audit
    query = sa.select(table.c.who, table.c.at, table.c.document).where(table.c.asset == asset, table.c.what == CHECKS)
    rows = store.fetch(query.order_by(table.c.id))
    return {row["document"]["fault"]: {**row["document"], "who": row["who"], "at": row["at"]} for row in rows}


def last_renewal(store: Store, asset: str) -> float | None:
    """Return since when an asset has been another one, as somebody noted ("pump replaced") [UTC s]; None: never."""
    return max((note["t"] for note in read_notes(store, asset) if note["anew"]), default=None)


def thin_columns(columns: Series, points: int) -> Series:
    """Return a series, shape (5, N), as at most `points` means over equal spans of time."""
    t = columns[0]
    if t.size <= points:
        return columns
    part = np.minimum((t - t[0]) / (t[-1] - t[0]) * points, points - 1).astype(np.int64)
    first = np.flatnonzero(np.diff(part, prepend=-1))
    return np.asarray(np.add.reduceat(columns, first, axis=1) / np.diff(first, append=t.size))


def query_sizes(store: Store, asset: str, name: str | None = None, since: float | None = None) -> SizeSeries:
    """Return the size of an asset's fault, or of a coefficient, over time, as a ratio to healthy.

    `name`: None if only one fault was ever named; `since`: [UTC s] what was found before is left out; None: what was
    found before the last note that the asset was renewed.

    Raises
    ------
    StoreError
        If no fault was named, another one, or several and `name` does not say which.
    """
    span = last_renewal(store, asset) if since is None else since, None
    # a year has five times as many rows; without one of that name, all names are needed for the error
    series = (name and read_series(store, asset, span, name=name)) or read_series(store, asset, span)
    faults = sorted({coefficient for kind, coefficient in series if kind in FAULT_KINDS})
    coefficients = sorted({coefficient for kind, coefficient in series if kind not in FAULT_KINDS})
    if name is None and len(faults) > 1:
        raise StoreError(f"{asset}: several faults were named, say which: --value {' or '.join(faults)}")
    if name is None and not faults:
        raise StoreError(f"{asset}: no fault was named in that time, so there is no size to follow")
    name = name or faults[0]
    kinds = FAULT_KINDS if name in faults else ("coefficient",)
    parts = [series[kind, name] for kind in kinds if (kind, name) in series]
    if not parts:
        raise StoreError(f"{asset}: a fault {name!r} was never named, {suggest_name(name, [*faults, *coefficients])}")
    t, value, low, high, healthy = np.concatenate(parts, axis=1)
    # where healthy is about zero, a ratio to it would say nothing
    scale = healthy if np.all(np.abs(healthy) > high - low) else np.ones_like(healthy)
    return SizeSeries.from_arrays(name, t, value / scale, (high - low) / (2.0 * NORMAL_95 * np.abs(scale)))
