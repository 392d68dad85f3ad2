"""The application: routes of the interface, pages, metrics and health behind one guard."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator
from importlib.resources import as_file, files
from pathlib import Path

from fastapi import APIRouter, FastAPI
from starlette.exceptions import HTTPException
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp

from servoscope import __version__
from servoscope.web import alarms, assets, baselines, description, designs, diagnoses, live, problems, session, uploads
from servoscope.web.context import Context
from servoscope.web.guard import API, Guard
from servoscope.web.metrics import Metrics

__all__ = ["application"]

SWEEP_S = 3600.0
TEXT = "text/plain; version=0.0.4; charset=utf-8"
PARTS = (session, assets, alarms, live, diagnoses, uploads, baselines, designs)


def application(context: Context) -> ASGIApp:
    """Return what uvicorn serves."""
    metrics = Metrics(context.hub)

    @contextlib.asynccontextmanager
    async def running(_: FastAPI) -> AsyncIterator[None]:
        tasks = [asyncio.create_task(context.hub.follow()), asyncio.create_task(_sweep(context))]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            await context.jobs.close()

    app = FastAPI(
        title="servoscope",
        version=__version__,
        summary="Condition monitoring of servo loops: assets, alarms, diagnoses, baselines.",
        openapi_url=f"{API}/openapi.json",
        docs_url=None,  # they would load scripts from elsewhere
        redoc_url=None,
        lifespan=running,
    )
    app.state.context, app.state.metrics = context, metrics
    problems.install(app)
    description.install(app)
    router = APIRouter(prefix=API)
    for part in PARTS:
        router.include_router(part.router)
    app.include_router(router)
    _own(app, context, metrics)
    _pages(app)
    return Guard(app, context.settings, context.users, context.sessions, metrics)


async def _sweep(context: Context) -> None:
    while True:
        try:
            await asyncio.to_thread(context.folder.sweep, context.settings.keep_days * 86400.0)
        except OSError as error:
            logging.getLogger("servoscope.web").warning("old uploads cannot be removed: %s", error)
        await asyncio.sleep(SWEEP_S)


def _own(app: FastAPI, context: Context, metrics: Metrics) -> None:
    """Add metrics and health."""

    @app.get("/metrics", include_in_schema=False)
    async def told() -> Response:
        return Response(metrics.text(), media_type=TEXT)

    @app.get("/health/live", include_in_schema=False)
    async def alive() -> Response:
        return JSONResponse({"ok": True})

    @app.get("/health/ready", include_in_schema=False)
    async def ready() -> Response:
        why = context.hub.unavailable
        return JSONResponse({"ok": not why, "why": why}, 503 if why else 200)


def _pages(app: FastAPI) -> None:
    """Add the pages: files under ``/static``, and the shell at every other address."""
    folder = Path(str(contextlib.ExitStack().enter_context(as_file(files("servoscope.web")))), "pages")
    palette, shell = folder.parents[1] / "report" / "palette.css", folder / "index.html"

    @app.get("/static/palette.css", include_in_schema=False)
    async def colours() -> Response:
        return _file(palette)

    app.mount("/static", GZipMiddleware(_Fresh(directory=folder, check_dir=False), minimum_size=1000))

    @app.api_route("/{path:path}", methods=["GET", "HEAD"], include_in_schema=False)
    async def page(request: Request, path: str) -> Response:
        if path.split("/")[0] in ("api", "static", "metrics", "health"):
            raise HTTPException(404, f"there is nothing at {request.url.path}")
        return _file(shell)


def _file(path: Path) -> Response:
    if not path.is_file():
        raise HTTPException(404, f"this installation has no {path.name}")
    return FileResponse(path, headers={"Cache-Control": "no-cache"})


class _Fresh(StaticFiles):
    """Files that a browser asks for each time whether they have changed: an update shows at once."""

    def file_response(self, *args: object, **more: object) -> Response:
        """Return a file, or that it has not changed."""
        found = super().file_response(*args, **more)  # type: ignore[arg-type]  # handed on as they come
        found.headers["Cache-Control"] = "no-cache"
        return found
