"""What the interface takes and answers of what to check."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from servoscope.web.schemas.requests import ApiRequest, Id
from servoscope.web.schemas.responses import ApiResponse


class FaultCheck(ApiResponse):
    """What to check for a fault; `who` wrote it for this asset `at` [UTC s]; None: nobody, loop or plant say it."""

    fault: str
    label: str
    texts: list[str]
    who: str | None = None
    at: float | None = None


class CheckRequest(ApiRequest):
    """What to check on an asset for a fault; no text: as the loop or the plant says it."""

    fault: Id
    texts: Annotated[list[Annotated[str, Field(min_length=1, max_length=300)]], Field(max_length=10)]
