"""Changes as they happen: server-sent events."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.responses import StreamingResponse

from servoscope.core.errors import StoreError
from servoscope.service.assets.status import AssetStatus
from servoscope.web.dependencies import VIEWER, Context, ContextDep
from servoscope.web.event_hub import format_sse
from servoscope.web.middleware import authenticate
from servoscope.web.routes.assets import build_asset_detail, find_asset
from servoscope.web.schemas.requests import LiveQuery

router = APIRouter(tags=["live"], dependencies=[VIEWER])

KEEPALIVE_S = 15.0  # after which a comment keeps the connection open
RETRY = b"retry: 2000\n\n"


@router.get(
    "/live",
    response_class=StreamingResponse,
    responses={200: {"content": {"text/event-stream": {"schema": {"type": "string"}}}, "description": "Events"}},
)
async def stream_events(
    context: ContextDep, request: Request, query: Annotated[LiveQuery, Query()]
) -> StreamingResponse:
    """Send the fleet, or one asset, as it is, and then what changes; `since` a mark, that alone."""
    if query.asset is not None:
        await asyncio.to_thread(find_asset, context, query.asset)

    # a browser that connects again repeats the mark of the last event that it has
    tick = context.event_hub.tick_at(request.headers.get("last-event-id", query.since))

    def is_permitted() -> bool:
        return authenticate(request.headers, context) is not None

    async def counted() -> AsyncIterator[bytes]:
        with request.app.state.metrics.event_readers.track_inprogress():
            async for text in _event_stream(context, query.asset, tick, is_permitted):
                yield text

    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return StreamingResponse(counted(), media_type="text/event-stream", headers=headers)


async def _event_stream(
    context: Context, asset: str | None, tick: int, is_permitted: Callable[[], bool]
) -> AsyncIterator[bytes]:
    """Yield events since a tick until the reader loses its permission, or the server stops."""
    hub = context.event_hub
    number, error = hub.last_number, ""
    yield RETRY
    while not hub.closed and is_permitted():
        sent = False
        if hub.error != error:
            error, sent = hub.error, True
            yield format_sse("store", {"available": not error, "why": error})
        if hub.tick != tick:
            before, tick = tick, hub.tick
            if text := await _changes_since(context, asset, before):
                sent = True
                yield text
        for event in [event for event in hub.events if event.number > number and asset in (None, event.asset)]:
            sent = True
            yield event.text
        number = hub.last_number
        if not sent:
            yield b": still here\n\n"
        if not hub.closed and (hub.tick, hub.last_number, hub.error) == (tick, number, error):
            await hub.wait(KEEPALIVE_S)


async def _changes_since(context: Context, asset: str | None, tick: int) -> bytes:
    hub = context.event_hub
    if asset is None:
        return hub.events_since(tick)
    stored = hub.statuses[asset] if hub.has_changed(asset, tick) else None
    if stored is None or not isinstance(stored.status, AssetStatus):
        return b""
    try:
        detail = await asyncio.to_thread(build_asset_detail, context, asset, stored.at, stored.status)
    except StoreError:  # the hub meets it too, and reports it
        return b""
    return format_sse("asset", detail)
