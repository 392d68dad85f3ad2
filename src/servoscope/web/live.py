"""What is new, as it happens: server-sent events."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.responses import StreamingResponse

from servoscope.errors import StoreError
from servoscope.web.asked import OfLive
from servoscope.web.assets import detail, known
from servoscope.web.context import Context, In, Viewer
from servoscope.web.guard import identify
from servoscope.web.hub import event
from servoscope.web.metrics import Metrics

router = APIRouter(tags=["live"])

QUIET_S = 15.0  # after which a comment keeps the connection open
RETRY = b"retry: 2000\n\n"


@router.get(
    "/live",
    response_class=StreamingResponse,
    responses={200: {"content": {"text/event-stream": {"schema": {"type": "string"}}}, "description": "Events"}},
)
async def live(context: In, who: Viewer, request: Request, query: Annotated[OfLive, Query()]) -> StreamingResponse:
    """Tell the fleet, or one asset, as it is, and then what changes."""
    if query.asset is not None:
        await asyncio.to_thread(known, context, query.asset)

    def allowed() -> bool:
        return identify(request.headers, context.settings, context.users, context.sessions) is not None

    stream = _counted(request.app.state.metrics, _events(context, query.asset, allowed))
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return StreamingResponse(stream, media_type="text/event-stream", headers=headers)


async def _counted(metrics: Metrics, stream: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    metrics.readers.inc()
    try:
        async for text in stream:
            yield text
    finally:
        metrics.readers.dec()


async def _events(context: Context, asset: str | None, allowed: Callable[[], bool]) -> AsyncIterator[bytes]:
    """Yield events until the reader may no longer read, or the server stops."""
    hub = context.hub
    seen, noted, unavailable = -1, hub.noted, ""
    yield RETRY
    while not hub.closed and allowed():
        told = False
        if hub.unavailable != unavailable:
            unavailable, told = hub.unavailable, True
            yield event("store", {"available": not unavailable, "why": unavailable})
        if hub.tick != seen:
            since, seen = seen, hub.tick
            text = await _news(context, asset, since)
            told |= bool(text)
            if text:
                yield text
        for note in [one for one in hub.notes if one.number > noted and asset in (None, one.asset)]:
            told = True
            yield note.text
        noted = hub.noted
        if not told:
            yield b": still here\n\n"
        await _wait(context, seen, noted, unavailable)


async def _wait(context: Context, seen: int, noted: int, unavailable: str) -> None:
    hub = context.hub
    if not hub.closed and (hub.tick, hub.noted, hub.unavailable) == (seen, noted, unavailable):
        await hub.news(QUIET_S)


async def _news(context: Context, asset: str | None, since: int) -> bytes:
    hub = context.hub
    if asset is None:
        return hub.since(since)
    if not hub.changed(asset, since):
        return b""
    row = hub.rows[asset]
    try:
        return event("asset", await asyncio.to_thread(detail, context, asset, row))
    except StoreError:  # the hub meets it too, and says so
        return b""
