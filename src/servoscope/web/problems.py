"""Errors as RFC 9457 problems: one line for the user in `detail`, whatever went wrong and wherever."""

from __future__ import annotations

import logging
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.responses import JSONResponse, Response

from servoscope.errors import AlarmError, ServoscopeError, StoreError

__all__ = ["KIND", "answer", "describe", "install", "problem"]

KIND = "application/problem+json"


def problem(
    status: int,
    detail: str,
    instance: str = "",
    errors: list[dict[str, str]] | None = None,
    headers: dict[str, str] | None = None,
) -> JSONResponse:
    """Return a problem as a response."""
    content = describe(status, detail, instance)
    if errors:
        content["errors"] = errors
    return JSONResponse(content, status, headers=headers, media_type=KIND)


def describe(status: int, detail: str, instance: str = "") -> dict[str, Any]:
    """Return a problem as plain values."""
    title = HTTPStatus(status).phrase
    plain = {"type": "about:blank", "title": title, "status": status, "detail": " ".join(detail.split())}
    return {**plain, "instance": instance} if instance else plain


def status_of(error: ServoscopeError) -> int:
    """Return the status that an error of servoscope stands for."""
    if isinstance(error, AlarmError):
        return 409
    return 503 if isinstance(error, StoreError) else 422


def answer(error: ServoscopeError, instance: str = "") -> JSONResponse:
    """Return an error of servoscope as a response."""
    status = status_of(error)
    return problem(status, str(error), instance, headers={"Retry-After": "2"} if status == 503 else None)


def install(app: FastAPI) -> None:
    """Let an application answer all errors as problems."""

    @app.exception_handler(HTTPException)
    async def _http(request: Request, error: HTTPException) -> Response:
        headers = dict(error.headers) if error.headers else None
        return problem(error.status_code, str(error.detail), request.url.path, headers=headers)

    @app.exception_handler(RequestValidationError)
    async def _wrong(request: Request, error: RequestValidationError) -> Response:
        errors = [
            {"where": ".".join(str(part) for part in one["loc"]), "what": str(one["msg"])} for one in error.errors()
        ]
        detail = f"{errors[0]['where']}: {errors[0]['what']}" if errors else "the request is wrong"
        return problem(422, detail, request.url.path, errors)

    @app.exception_handler(ServoscopeError)
    async def _own(request: Request, error: ServoscopeError) -> Response:
        return answer(error, request.url.path)

    @app.exception_handler(ClientDisconnect)
    async def _gone(request: Request, _: ClientDisconnect) -> Response:
        return problem(400, "the request was not sent to its end", request.url.path)

    @app.exception_handler(Exception)
    async def _unexpected(request: Request, error: Exception) -> Response:
        logging.getLogger("servoscope.web").error("%s %s", request.method, request.url.path, exc_info=error)
        return problem(500, "the server met an error that it does not know; its log has more", request.url.path)
