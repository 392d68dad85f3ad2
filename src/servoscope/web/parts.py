"""What several requests have in common: uploads by their ids, and which part of them is meant."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from servoscope.web.asked import Part
from servoscope.web.context import Context

__all__ = ["part_of", "upload_of"]


def upload_of(context: Context, id_: str) -> tuple[Path, str]:
    """Return folder and file name of an upload.

    Raises
    ------
    HTTPException
        404: if there is none.
    """
    return context.folder.path("uploads", id_).absolute(), str(context.folder.about("uploads", id_)["name"])


def part_of(asked: Part) -> dict[str, Any]:
    """Return columns and rows for a task."""
    columns = asked.columns.given() if asked.columns is not None else None
    return {"columns": columns, "where": asked.where, "from_s": asked.from_s, "to_s": asked.to_s}
