"""What the interface answers of sizes over time: curves, forecasts, and notes of what was done to an asset."""

from __future__ import annotations

from typing import Literal

from pydantic import ConfigDict, Field

from servoscope.core.messages import MessageField
from servoscope.design.operating_limits import OperatingLimit
from servoscope.prognosis.forecast import Prognosis
from servoscope.web.schemas.requests import NoteRequest
from servoscope.web.schemas.responses import ApiResponse


class SizeCurve(ApiResponse):
    """A fault or coefficient over time, as a ratio to healthy, with its 95 % intervals."""

    name: str
    kind: Literal["full", "live", "coefficient"]
    t: list[float]
    value: list[float]
    low: list[float]
    high: list[float]
    healthy: list[float]


class SizeHistory(ApiResponse):
    """How faults and coefficients of an asset have changed; of each of `points` equal parts of the time one value."""

    asset: str
    curves: list[SizeCurve]


class Note(NoteRequest, ApiResponse):
    """What somebody noted about an asset."""

    model_config = ConfigDict(extra="ignore")  # of later versions

    who: str
    kind: str = "note"  # type: ignore[assignment]


class NoteList(ApiResponse):
    """Notes in the order of time."""

    notes: list[Note]


class Forecast(Prognosis, ApiResponse):
    """A prognosis of an asset, with its sentences as text."""

    asset: str
    # headline, reasons, effects: in the sentences
    headline: MessageField = Field(exclude=True)
    reasons: tuple[MessageField, ...] = Field((), exclude=True)
    effects: dict[str, tuple[float, float, float]] = Field({}, exclude=True)


class LimitList(ApiResponse):
    """Limits by fault."""

    limits: list[OperatingLimit]
