"""The application: routes of the interface, pages, metrics and health behind one middleware."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
from collections.abc import AsyncIterator
from importlib.resources import as_file, files
from pathlib import Path

from fastapi import APIRouter, FastAPI
from starlette.exceptions import HTTPException
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, RedirectResponse, Response
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp

from servoscope import __version__
from servoscope.core.messages import catalogue, current_language, languages
from servoscope.service.health import HEALTH_PATHS, HealthReport
from servoscope.simulation.tutorial import DAYS, tutorial_log
from servoscope.web import errors
from servoscope.web.dependencies import Context
from servoscope.web.metrics import WebMetrics
from servoscope.web.middleware import API, SecurityMiddleware
from servoscope.web.routes import (
    alarms,
    assets,
    baselines,
    designs,
    diagnoses,
    events,
    notifications,
    renewal,
    session,
    uploads,
)

HELP = "/help"  # where the documentation is
GZIP_LEVEL = 5  # beyond it, text shrinks by a twentieth for twice the time
CLEANUP_S = 3600.0  # between two removals of expired uploads
ROUTE_MODULES = (session, assets, alarms, events, diagnoses, uploads, baselines, designs, renewal, notifications)


def create_app(context: Context) -> ASGIApp:
    """Return the application that uvicorn serves."""
    metrics = WebMetrics(context.event_hub, context.connections.cut)

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        tasks = [asyncio.create_task(context.event_hub.run()), asyncio.create_task(_remove_expired(context))]
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
        lifespan=lifespan,
    )
    app.state.context, app.state.metrics = context, metrics
    errors.install_openapi(app)
    errors.install_error_handlers(app)
    router = APIRouter(prefix=API)
    for module in ROUTE_MODULES:
        router.include_router(module.router)
    app.include_router(router)
    _add_health_routes(app, context, metrics)
    _add_pages(app)
    packed = GZipMiddleware(app, minimum_size=1000, compresslevel=GZIP_LEVEL)
    return SecurityMiddleware(packed, context, metrics)


async def _remove_expired(context: Context) -> None:
    while True:
        try:
            await asyncio.to_thread(context.storage.remove_expired, context.settings.keep_days * 86400.0)
        except OSError as error:
            logging.getLogger("servoscope.web").warning("old uploads cannot be removed: %s", error)
        await asyncio.sleep(CLEANUP_S)


def _add_health_routes(app: FastAPI, context: Context, metrics: WebMetrics) -> None:
    report = HealthReport(metrics.render, lambda: context.event_hub.error)

    async def get_health(request: Request) -> Response:
        answer = report.answer(request.url.path)
        assert answer is not None, "one of the paths"
        return Response(answer.body, answer.status, media_type=answer.media_type)

    for path in HEALTH_PATHS:
        app.add_api_route(path, get_health, include_in_schema=False)


def _add_pages(app: FastAPI) -> None:
    """Add the files of the pages under ``/static``, and the shell, which loads them, at every other address."""
    folder = Path(str(contextlib.ExitStack().enter_context(as_file(files("servoscope.web")))), "pages")
    palette, shell = folder.parents[1] / "report" / "palette.css", folder / "index.html"

    @app.get("/static/palette.css", include_in_schema=False)
    async def get_palette() -> Response:
        return _file_response(palette)

    @app.get("/static/language.js", include_in_schema=False)
    async def get_language() -> Response:
        known = catalogue(current_language())
        words = {key.partition(".")[2]: text for key, text in known.items() if key.startswith(("word.", "page."))}
        said = {"LANGUAGE": current_language(), "LANGUAGES": languages(), "WORDS": words}
        text = "".join(
            f"export const {name} = {json.dumps(value, ensure_ascii=False)};\n" for name, value in said.items()
        )
        headers = {"Cache-Control": "no-cache", "Vary": "Accept-Language, Cookie"}
        return Response(text, media_type="text/javascript", headers=headers)

    @app.get("/static/examples/{day}.csv", include_in_schema=False)
    def get_example(day: str) -> Response:
        if day not in DAYS:
            raise HTTPException(404, f"there is no example of {day}")
        return Response(tutorial_log(day), media_type="text/csv")

    app.mount("/static", _NoCacheFiles(directory=folder, check_dir=False))

    site = folder.parents[1] / "site"  # which wheels bring: see `servoscope docs`
    if site.is_dir():
        app.mount(HELP, _NoCacheFiles(directory=site, html=True))
        app.add_api_route(HELP, lambda: RedirectResponse(f"{HELP}/"), include_in_schema=False)

    @app.api_route("/{path:path}", methods=["GET", "HEAD"], include_in_schema=False)
    async def get_page(request: Request, path: str) -> Response:
        if path.split("/")[0] in ("api", "static", "metrics", "health"):
            raise HTTPException(404, f"there is nothing at {request.url.path}")
        return _file_response(shell)


def _file_response(path: Path) -> Response:
    if not path.is_file():
        raise HTTPException(404, f"this installation has no {path.name}")
    return FileResponse(path, headers={"Cache-Control": "no-cache"})


class _NoCacheFiles(StaticFiles):
    """Files that a browser checks for changes each time: an update shows at once."""

    def file_response(self, *args: object, **options: object) -> Response:
        """Return a file, or the answer that it has not changed."""
        response = super().file_response(*args, **options)  # type: ignore[arg-type]  # handed on as they come
        response.headers["Cache-Control"] = "no-cache"
        return response
