"""Followed assets: the fleet, one of them in detail, its history and its last signals."""

from __future__ import annotations

import time
from typing import Annotated

import sqlalchemy as sa
from fastapi import APIRouter, Query
from starlette.exceptions import HTTPException

from servoscope.store import Row, tables
from servoscope.store.history import coarse, history
from servoscope.web import telling
from servoscope.web.asked import OfFleet, OfHistory, OfRows, OfSignals
from servoscope.web.baselines import id_of_asset
from servoscope.web.context import Context, In, Plain, Viewer
from servoscope.web.hub import of_assets, of_services, sizes_of
from servoscope.web.said import AssetDetail, Fleet, ResidualHistory, Signals, Transitions
from servoscope.web.signals import last_signals

router = APIRouter(tags=["assets"])

DAY_S = 86400.0


def known(context: Context, asset: str) -> Row:
    """Return the newest checkpoint of an asset, without its state.

    Raises
    ------
    HTTPException
        404: if there is no such asset.
    """
    found = of_assets(context.store.statuses([asset]))
    if asset not in found:
        raise HTTPException(404, f"there is no asset {asset}")
    return found[asset]


def detail(context: Context, asset: str, row: Row) -> Plain:
    """Return all that is known of an asset now."""
    query = sa.select(tables.diagnoses).where(tables.diagnoses.c.asset == asset)
    newest = context.store.rows(query.order_by(tables.diagnoses.c.t.desc()).limit(1))
    found = sizes_of(context.store, {asset: row})
    return {
        **telling.detail_of(asset, row["at"], row["status"], found.get(asset, ())),
        "baseline": id_of_asset(context, asset),
        "diagnosis": telling.diagnosis_row(newest[0]) if newest else None,
    }


@router.get("/assets", response_model=Fleet)
def fleet(context: In, _: Viewer, query: Annotated[OfFleet, Query()]) -> Plain:
    """List the assets, the most urgent first."""
    statuses = context.store.statuses()
    followed = of_assets(statuses)
    sizes = sizes_of(context.store, followed)
    rows = [telling.asset_row(name, row["at"], row["status"], sizes.get(name, ())) for name, row in followed.items()]
    groups = sorted({row["group"] for row in rows if row["group"]})
    rows = [
        row
        for row in rows
        if query.search.casefold() in f"{row['asset']} {row['group']} {row['summary']}".casefold()
        and query.group in (None, row["group"])
        and query.verdict in (None, row["verdict"])
    ]
    services = [telling.service_row(name, row["status"]) for name, row in of_services(statuses).items()]
    return {"now": time.time(), "assets": telling.worst_first(rows), "groups": groups, "services": services}


@router.get("/assets/{asset}", response_model=AssetDetail)
def asset(context: In, _: Viewer, asset: str) -> Plain:
    """Tell all that is known of an asset now."""
    return detail(context, asset, known(context, asset))


@router.get("/assets/{asset}/history", response_model=ResidualHistory)
def residuals(context: In, _: Viewer, asset: str, query: Annotated[OfHistory, Query()]) -> Plain:
    """Tell its statistics and residuals over a time; of each of `points` equal parts of it, the largest."""
    until = query.until if query.until is not None else known(context, asset)["status"]["counted"]["t"]
    since = query.since if query.since is not None else until - DAY_S
    if not since < until:
        raise HTTPException(422, "from must be before to")
    rows, count = coarse(context.store, asset, (since, until), query.points)
    frequencies = sorted({f for row in rows for f, *_ in row["residual"]})
    by_row = [{f: rest for f, *rest in row["residual"]} for row in rows]
    nothing = [None, None, None]
    return {
        "asset": asset,
        "from": since,
        "to": until,
        "bucket_s": (until - since) / query.points,
        "rows": count,
        **{key: [row[key] for row in rows] for key in ("t", "statistic", "level")},
        "residuals": [
            {
                "frequency_hz": f,
                **{
                    key: [row.get(f, nothing)[i] for row in by_row] for i, key in enumerate(("real", "imag", "healthy"))
                },
            }
            for f in frequencies
        ],
    }


@router.get("/assets/{asset}/signals", response_model=Signals)
def signals(context: In, _: Viewer, asset: str, query: Annotated[OfSignals, Query()]) -> Plain:
    """Tell its last seconds, as measured."""
    row = known(context, asset)
    units = telling.units_of(row["status"].get("about", {}).get("units"))
    return {"asset": asset, "units": units, **last_signals(context.store, asset, query.seconds, query.points)}


@router.get("/assets/{asset}/alarms", response_model=Transitions)
def transitions(context: In, _: Viewer, asset: str, query: Annotated[OfRows, Query()]) -> Plain:
    """Tell what became of its alarms, the newest last."""
    known(context, asset)
    rows = history(context.store, "alarms", assets=[asset], span=(query.since, query.until), last=query.last)
    return {"transitions": [telling.transition(row) for row in rows]}
