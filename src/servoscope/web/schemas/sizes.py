"""What the interface answers of sizes over time: curves, forecasts, and notes of what was done to an asset."""

from __future__ import annotations

from typing import Literal

from servoscope.prognosis.forecast import Outlook
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


class Note(ApiResponse):
    """What somebody noted about an asset; `anew`: its trend begins there."""

    who: str
    t: float
    text: str
    anew: bool


class NoteList(ApiResponse):
    """Notes in the order of time."""

    notes: list[Note]


class Forecast(ApiResponse):
    """How a size grows, and when it reaches a limit: intervals as lower end, median, upper end."""

    asset: str
    name: str
    limit: float
    coverage: float
    points: int
    from_t: float
    to_t: float
    outlook: Outlook
    value: tuple[float, ...] | None
    rate_per_day: tuple[float, ...] | None
    remaining_s: tuple[float | None, ...] | None
    odds: float | None
    summary: str
    explanation: tuple[str, ...]


class LimitRow(ApiResponse):
    """The ratio to healthy, above 1 and below 1, at which the loop loses tracking or its margin of stability."""

    fault: str
    kind: Literal["tracking", "stability"]
    up: float | None
    down: float | None


class LimitList(ApiResponse):
    """Limits by fault."""

    limits: list[LimitRow]
