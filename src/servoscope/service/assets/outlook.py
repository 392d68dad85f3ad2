"""When the fault of an asset reaches its limit, by the last prognosis: kept with the asset's state, and alarmed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from servoscope.core.settings import NonEmptyStr, Positive, Settings
from servoscope.design.operating_limits import LIMIT_KINDS, LimitKind, OperatingLimit
from servoscope.prognosis.forecast import Prognosis, prognose
from servoscope.prognosis.series import SizeSeries

OutlookWord = Literal["far", "near", "reached"]
DAY_S = 86400.0


def _check_limit(limit: object) -> object:
    if isinstance(limit, str) and limit not in LIMIT_KINDS:
        raise ValueError(f"{limit!r}: give a number, tracking or stability")
    return limit


SizeLimit = Annotated[Positive | LimitKind, BeforeValidator(_check_limit)]
AssetLimits = Mapping[str, float | OperatingLimit]  # by fault, ratio to healthy at which the machine stops


class PrognosisSettings(Settings):
    """The section `[prognosis]`: until which sizes machines may run, and how far is looked ahead."""

    # by the name of a fault, the ratio to healthy at which the machine is to be stopped: ``{ leakage = 1.5 }``; or what
    # the loop loses there: ``{ pump = "tracking" }``
    limits: dict[NonEmptyStr, SizeLimit] = Field(default_factory=dict)
    every_s: Annotated[Positive, Field(ge=60.0)] = 6 * 3600.0  # between two prognoses of an asset with such a fault [s]
    ahead_s: Positive = 90 * DAY_S  # the alarm ``limit`` says so when the limit may be reached within this time [s]


class Outlook(BaseModel):
    """A prognosis as an asset remembers it; times are [UTC s], intervals lower end, median, upper end."""

    model_config = ConfigDict(frozen=True)

    name: str  # of the fault
    limit: float
    outlook: Literal["forecast", "reached", "none"]
    t: float  # of the newest size
    asked: float  # when it was made, by the asset's clock
    reach_t: tuple[float | None, ...] | None = None  # None: later than can be said
    rate_per_day: tuple[float, ...] | None = None
    summary: str

    @classmethod
    def from_prognosis(cls, prognosis: Prognosis, asked: float) -> Self:
        """Return what is kept of a prognosis."""
        reach = tuple(
            None if remaining is None else prognosis.to_t + remaining for remaining in prognosis.remaining_s or ()
        )
        return cls.model_validate(
            {
                **{key: getattr(prognosis, key) for key in ("name", "limit", "outlook", "rate_per_day", "summary")},
                "t": prognosis.to_t,
                "asked": asked,
                "reach_t": reach or None,
            }
        )

    def word(self, now: float, ahead_s: float) -> OutlookWord:
        """Return whether the limit is reached, or may be within `ahead_s` after `now` [UTC s]."""
        if self.outlook == "reached":
            return "reached"
        earliest = self.reach_t[0] if self.outlook == "forecast" and self.reach_t else None
        return "near" if earliest is not None and earliest - now <= ahead_s else "far"


class DuePrognosis(NamedTuple):
    """A prognosis that is to be made: of which fault, until which limit, by the sizes since when [UTC s]."""

    fault: str
    limit: float
    since: float


def single_fault(faults: Sequence[Mapping[str, Any]]) -> str | None:
    """Return the fault that a full diagnosis has named; None where it named none or several."""
    return str(faults[0]["name"]) if len(faults) == 1 else None


def current_outlook(outlook: Outlook | None, faults: Sequence[Mapping[str, Any]]) -> Outlook | None:
    """Return a prognosis if it is of the fault that there is now."""
    return outlook if outlook is not None and outlook.name == single_fault(faults) else None


def prognose_in_worker(
    _: Callable[[str], None], name: str, columns: Mapping[str, Sequence[float]], limit: float
) -> dict[str, Any]:
    """Make a prognosis in a worker's process: it takes most of a second."""
    series = SizeSeries.from_arrays(name, columns["t"], columns["value"], columns["std"])
    return prognose(series, limit).model_dump(mode="json", exclude={"summary", "explanation"})
