"""What OpenAPI says of the interface, with errors as they are: problems, one kind for all of them."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI

from servoscope.web.problems import KIND
from servoscope.web.said import Problem

__all__ = ["install"]

OWN = ("HTTPValidationError", "ValidationError")  # of the framework, which never answers here


def install(app: FastAPI) -> None:
    """Let an application describe its errors as it answers them."""
    generate = app.openapi

    def described() -> dict[str, Any]:
        if app.openapi_schema is None:
            plain = generate()
            schemas = plain["components"]["schemas"]
            for name in OWN:
                schemas.pop(name, None)
            schemas["Problem"] = Problem.model_json_schema()
            told = {"schema": {"$ref": "#/components/schemas/Problem"}}
            for operations in plain["paths"].values():
                for operation in operations.values():
                    operation["responses"].pop("422", None)
                    operation["responses"]["default"] = {"description": "What went wrong", "content": {KIND: told}}
            app.openapi_schema = plain
        return app.openapi_schema

    app.openapi = described  # type: ignore[method-assign]  # how FastAPI wants it
