"""Errors as answers: problems after RFC 9457, one kind for all of them, which OpenAPI describes too."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.responses import JSONResponse, Response

from servoscope.core.errors import AlarmError, ServoscopeError, StoreError
from servoscope.core.messages import say
from servoscope.core.texts import clean_text, clean_texts
from servoscope.web.schemas.responses import JsonObject, Problem

PROBLEM_TYPE = "application/problem+json"
MAX_ERRORS = 20  # that the answer to a refused request names
FRAMEWORK_SCHEMAS = ("HTTPValidationError", "ValidationError")  # of the framework, whose answers are replaced here


def install_openapi(app: FastAPI) -> None:
    """Let an application describe its errors as it answers them."""
    generate = app.openapi

    def describe() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = generate()
            schemas = document["components"]["schemas"]
            for name in FRAMEWORK_SCHEMAS:
                schemas.pop(name, None)
            schemas["Problem"] = Problem.model_json_schema()
            content = {PROBLEM_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
            for operations in document["paths"].values():
                for operation in operations.values():
                    operation["responses"].pop("422", None)
                    operation["responses"]["default"] = {"description": "What went wrong", "content": content}
            app.openapi_schema = document
        return app.openapi_schema

    app.openapi = describe  # type: ignore[method-assign]  # how FastAPI wants it


def problem(
    status: int, detail: str, instance: str | None = None, errors: list[dict[str, str]] | None = None
) -> JsonObject:
    """Return a problem as plain values."""
    title, detail = HTTPStatus(status).phrase, clean_text(" ".join(detail.split()))
    document = Problem(
        type="about:blank", title=title, status=status, detail=detail, instance=instance, errors=clean_texts(errors)
    )
    return document.model_dump(exclude_none=True)


def problem_response(
    status: int,
    detail: str,
    instance: str,
    errors: list[dict[str, str]] | None = None,
    headers: Mapping[str, str] | None = None,
) -> JSONResponse:
    """Return a problem as a response."""
    content = problem(status, detail, instance, errors or None)
    return JSONResponse(content, status, headers=headers, media_type=PROBLEM_TYPE)


def http_status(error: ServoscopeError) -> int:
    """Return the status that stands for an error."""
    if isinstance(error, AlarmError):
        return 409
    return 503 if isinstance(error, StoreError) else 422


def install_error_handlers(app: FastAPI) -> None:
    """Let an application answer all errors as problems."""

    @app.exception_handler(HTTPException)
    async def _http(request: Request, error: HTTPException) -> Response:
        return problem_response(error.status_code, str(error.detail), request.url.path, headers=error.headers)

    @app.exception_handler(RequestValidationError)
    async def _invalid(request: Request, error: RequestValidationError) -> Response:
        errors = [
            {"where": ".".join(map(str, problem["loc"])), "what": str(problem["msg"])}
            for problem in error.errors()[:MAX_ERRORS]
        ]
        detail = f"{errors[0]['where']}: {errors[0]['what']}" if errors else say("web.invalid")
        return problem_response(422, detail, request.url.path, errors)

    @app.exception_handler(ServoscopeError)
    async def _own(request: Request, error: ServoscopeError) -> Response:
        status = http_status(error)
        headers = {"Retry-After": "2"} if status == 503 else None
        return problem_response(status, str(error), request.url.path, headers=headers)

    @app.exception_handler(ClientDisconnect)
    async def _incomplete(request: Request, _: ClientDisconnect) -> Response:
        return problem_response(400, say("web.incomplete"), request.url.path)

    @app.exception_handler(Exception)
    async def _unexpected(request: Request, error: Exception) -> Response:
        logging.getLogger("servoscope.web").error("%s %s", request.method, request.url.path, exc_info=error)
        return problem_response(500, say("web.unexpected"), request.url.path)
