"""Monitored assets: the fleet, one of them in detail, its history and its last signals."""

from __future__ import annotations

import functools
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Depends, HTTPException, Query, Request, Response

from servoscope.core.errors import BaselineError, LoopError, StoreError, StoreUnavailableError
from servoscope.core.messages import say
from servoscope.design.operating_limits import OperatingLimit, operating_limits
from servoscope.machines.kinds import load_cached
from servoscope.prognosis.forecast import prognose
from servoscope.report.downsample import signal_columns
from servoscope.service.asset_link import page_address, qr_code
from servoscope.service.assets.condition import asset_condition
from servoscope.service.assets.status import AssetStatus
from servoscope.service.sources.block import Block
from servoscope.service.store import Store
from servoscope.service.store.queries import query_downsampled, query_history
from servoscope.service.store.rows import CHECKS, NOTE
from servoscope.service.store.series import FAULT_KINDS, query_sizes, read_notes, read_series, thin_columns
from servoscope.web.checks import asset_checks, asset_machine, fault_checks, last_full_diagnosis
from servoscope.web.dependencies import VIEWER, Context, ContextDep, Operator
from servoscope.web.routes.baselines import asset_baseline_id, find_baseline, load_loop_baseline
from servoscope.web.schemas import assets as schemas
from servoscope.web.schemas import responses
from servoscope.web.schemas.requests import (
    CheckRequest,
    FleetQuery,
    HistoryQuery,
    NoteRequest,
    RowQuery,
    SignalQuery,
    SizeQuery,
    TrendQuery,
)
from servoscope.web.statuses import FleetLine, StatusEntry, asset_statuses, read_statuses, service_statuses

router = APIRouter(tags=["assets"], dependencies=[VIEWER])

DAY_S = 86400.0
FIRST_BLOCKS = 16  # of an asset's newest samples that are read at first, as their length is not known
SVG_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/svg+xml": {"schema": {"type": "string"}}}, "description": "The picture"}
}
UNKNOWN_RESIDUAL = (None, None, None)


def find_asset(context: Context, asset: str) -> tuple[StatusEntry, AssetStatus]:
    """Return the newest status of an asset; raises HTTPException 404 if there is no such asset."""
    for stored in asset_statuses(read_statuses(context.store, [asset]).values()):
        return stored
    raise HTTPException(404, f"there is no asset {asset}")


def require_asset(context: ContextDep, asset: str) -> str:
    """Return the name of an asset that there is; raises HTTPException 404 if there is none."""
    return find_asset(context, asset)[0].name


KnownAsset = Annotated[str, Depends(require_asset)]


def build_asset_detail(context: Context, asset: str, at: float, status: AssetStatus) -> schemas.AssetDetail:
    """Return all that is known of an asset now."""
    row = last_full_diagnosis(context, asset) if asset_condition(status).is_open else None
    checks = asset_checks(context, asset, status, row)
    baseline = asset_baseline_id(context, asset)
    return schemas.AssetDetail.build(asset, at, status, baseline=baseline, row=row, checks=checks)


@router.get("/assets")
def list_assets(context: ContextDep, query: Annotated[FleetQuery, Query()]) -> schemas.FleetStatus:
    """List the assets, the most urgent first; of many, a page at a time."""
    mark, fleet = context.event_hub.mark, context.event_hub.fleet
    fleet.read(anew=query.limit is None)
    lines, services = fleet.lines, read_statuses(context.store, fleet.services)
    wanted = [line for line in lines if query.group in (None, line.group) and query.verdict in (None, line.verdict)]
    if query.search:
        wanted = _search(context.store, wanted, query.search)
    asked = [line.asset for line in wanted]
    return schemas.FleetStatus(
        now=time.time(),
        configured=len(context.config.assets) if context.config is not None else 0,
        total=len(asked),
        mark=mark,
        assets=_asset_rows(context.store, query.page(asked)),
        groups=sorted({line.group for line in lines if line.group}),
        services=[
            schemas.ServiceRow.from_status(status_entry.name, status)
            for status_entry, status in service_statuses(services.values())
        ],
    )


def _search(store: Store, lines: Iterable[FleetLine], words: str) -> list[FleetLine]:
    """Return the assets with a text in their name, group or headline; only headlines of their own are looked up."""
    text, healthy = words.casefold(), say("report.headline.healthy", point=None)
    shown = [(line, f"{line.asset} {line.group} {healthy if line.is_plain else ''}".casefold()) for line in lines]
    others = [line.asset for line, known in shown if text not in known and not line.is_plain]
    rows = _asset_rows(store, others) if others else []
    also = {row.asset for row in rows if text in f"{row.asset} {row.group} {row.summary}".casefold()}
    return [line for line, known in shown if text in known or line.asset in also]


def _asset_rows(store: Store, names: list[str]) -> list[schemas.AssetRow]:
    stored = asset_statuses(read_statuses(store, names).values())
    rows = [schemas.AssetRow.from_status(entry.name, entry.at, status) for entry, status in stored]
    return sorted(rows, key=lambda row: (-row.severity, row.asset))


@router.get("/assets/{asset}")
def get_asset(context: ContextDep, asset: str) -> schemas.AssetDetail:
    """Return all that is known of an asset now."""
    stored, status = find_asset(context, asset)
    return build_asset_detail(context, asset, stored.at, status)


@router.get("/assets/{asset}/code.svg", response_class=Response, responses=SVG_RESPONSES)
def get_code(context: ContextDep, request: Request, asset: KnownAsset) -> Response:
    """Return the QR code that leads a phone to its page."""
    scheme = "https" if context.settings.secure else request.url.scheme
    link = page_address(f"{scheme}://{request.headers['host']}", asset)
    return Response(qr_code(link, "svg"), media_type="image/svg+xml")


@router.get("/assets/{asset}/history")
def get_residuals(context: ContextDep, asset: str, query: Annotated[HistoryQuery, Query()]) -> schemas.ResidualHistory:
    """Return its statistics and residuals over a time; of each of `points` equal parts of it, the largest."""
    until = query.until if query.until is not None else find_asset(context, asset)[1].position.t
    since = query.since if query.since is not None else until - DAY_S
    if not since < until:
        raise HTTPException(422, "from must be before to")
    rows, count = query_downsampled(context.store, asset, (since, until), query.points)
    by_row = [{f: numbers for f, *numbers in row["residual"]} for row in rows]
    residuals = []
    for f in sorted({f for row in by_row for f in row}):
        columns = [list(column) for column in zip(*(row.get(f, UNKNOWN_RESIDUAL) for row in by_row), strict=True)]
        residuals.append(schemas.ResidualSeries(frequency_hz=f, real=columns[0], imag=columns[1], healthy=columns[2]))
    return schemas.ResidualHistory(
        asset=asset,
        from_=since,
        to=until,
        bucket_s=(until - since) / query.points,
        rows=count,
        t=[row["t"] for row in rows],
        statistic=[row["statistic"] for row in rows],
        level=[row["level"] for row in rows],
        residuals=residuals,
    )


@router.get("/assets/{asset}/sizes")
def get_sizes(context: ContextDep, asset: KnownAsset, query: Annotated[SizeQuery, Query()]) -> responses.SizeHistory:
    """Return how its faults, or its coefficients, have changed over a time."""
    kinds = FAULT_KINDS if query.of == "faults" else ("coefficient",)
    series = read_series(context.store, asset, query.span, kinds) if context.store.has_sizes else {}
    columns = ("t", "value", "low", "high", "healthy")
    curves = [
        responses.SizeCurve.model_validate(
            {"kind": kind, "name": name, **dict(zip(columns, thin_columns(rows, query.points).tolist(), strict=True))}
        )
        for (kind, name), rows in series.items()
    ]
    return responses.SizeHistory(asset=asset, curves=curves)


@router.get("/assets/{asset}/notes")
def list_notes(context: ContextDep, asset: KnownAsset) -> responses.NoteList:
    """List what people have noted about it."""
    return responses.NoteList(notes=[responses.Note.model_validate(note) for note in read_notes(context.store, asset)])


@router.post("/assets/{asset}/notes", status_code=201)
def add_note(context: ContextDep, who: Operator, asset: str, request: NoteRequest) -> responses.Note:
    """Note what was done to it."""
    find_asset(context, asset)
    machine = asset_machine(context, asset) if request.kind != NOTE else None
    if machine is not None and machine.loop_baseline is None:
        why = "learns from logs, and not from what the store keeps: use servoscope learn"
        raise HTTPException(409, f"{asset}: kind {machine.kind!r} {why}")
    context.store.add_audit(who.user, asset, NOTE, request.model_dump())
    return responses.Note(who=who.user, **request.model_dump())


@router.post("/assets/{asset}/checks")
def write_checks(
    context: ContextDep, who: Operator, asset: KnownAsset, request: CheckRequest
) -> list[responses.FaultCheck]:
    """Write what to check on it for a fault, in words of one's own; the audit keeps who did, and what was there."""
    context.store.add_audit(who.user, asset, CHECKS, request.model_dump())
    return fault_checks(context, asset, asset_machine(context, asset), [request.fault])


@router.get("/assets/{asset}/trend")
def get_trend(context: ContextDep, asset: KnownAsset, query: Annotated[TrendQuery, Query()]) -> responses.Forecast:
    """Return how a size grows, and when it will reach a limit; 404 where there is no such size."""
    try:
        series = query_sizes(context.store, asset, query.name, query.since)
    except StoreUnavailableError:
        raise
    except StoreError as error:
        raise HTTPException(404, str(error)) from None
    prognosis = prognose(series, query.limit)
    return responses.Forecast(asset=asset, **dict(prognosis))


@router.get("/assets/{asset}/limits")
def get_limits(context: ContextDep, asset: KnownAsset) -> responses.LimitList:
    """Return the sizes at which its loop loses tracking or its margin of stability; none where that is not known."""
    id_ = asset_baseline_id(context, asset)
    if id_ is None:
        return responses.LimitList(limits=[])
    path = find_baseline(context, id_).path
    return responses.LimitList(limits=list(_loop_limits(path, load_cached(path).hash)))


@functools.lru_cache(maxsize=256)  # it takes a second, and every reader of a page asks
def _loop_limits(baseline: Path, _: str) -> tuple[OperatingLimit, ...]:
    try:
        return tuple(operating_limits(load_loop_baseline(baseline).loop))
    except (BaselineError, LoopError):
        return ()


@router.get("/assets/{asset}/signals")
def get_signals(context: ContextDep, asset: str, query: Annotated[SignalQuery, Query()]) -> schemas.RecentSignals:
    """Return its last seconds, or those before a time, as measured."""
    units = schemas.signal_units(find_asset(context, asset)[1].metadata.units)
    sequence, blocks = _read_blocks(context.store, asset, query.seconds, query.until)
    t, *signals = np.concatenate([block.signals[:4] for block in blocks], axis=1) if blocks else np.zeros((4, 0))
    end = query.until if query.until is not None else t[-1] if t.size else 0.0
    within = (t > end - query.seconds) & (t <= end)
    t, signals = t[within], [signal[within] for signal in signals]
    columns = signal_columns(t, signals, query.points)
    return schemas.RecentSignals(asset=asset, sequence=sequence, samples=int(t.size), units=units, **columns)


def _read_blocks(store: Store, asset: str, seconds: float, until: float | None) -> tuple[int | None, list[Block]]:
    """Return the sequence of the newest block that the store keeps, and the blocks from so long before a time on."""
    blocks, limit = list[Block](), FIRST_BLOCKS
    while True:
        rows = store.recent_samples(asset, limit)
        blocks = [Block.unpack(asset, *row) for row in rows]
        end = (blocks[-1].t[-1] if until is None else until) if blocks else 0.0
        if len(rows) < limit or end - blocks[0].t[0] >= seconds:
            return (rows[-1][0] if rows else None), blocks
        limit *= 4


@router.get("/assets/{asset}/alarms")
def list_asset_transitions(
    context: ContextDep, asset: KnownAsset, query: Annotated[RowQuery, Query()]
) -> schemas.TransitionList:
    """List the transitions of its alarms, the newest last."""
    rows = query_history(context.store, "alarms", assets=[asset], span=query.span, last=query.last)
    return schemas.TransitionList(transitions=[schemas.TransitionRow.from_stored(row) for row in rows])
