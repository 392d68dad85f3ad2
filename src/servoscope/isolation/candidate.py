"""What isolation finds: candidates, each a set of faults with their sizes, or none that is known."""

from __future__ import annotations

import math
from typing import Annotated, Any, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from servoscope.baseline.learned_fault import SEVERITY
from servoscope.models.plants import Plant

UNKNOWN = "unknown"


def _open_ends(interval: Any) -> Any:
    """Return an interval as JSON has it, null for an end that nothing bounds, with infinite ends."""
    if isinstance(interval, (list, tuple)) and len(interval) == 2:
        return tuple(
            open_end if end is None else end for end, open_end in zip(interval, (-math.inf, math.inf), strict=True)
        )
    return interval


Interval = Annotated[tuple[float, float], BeforeValidator(_open_ends)]


class ResultModel(BaseModel):
    """A record of a result, read strictly."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class CoefficientChange(ResultModel):
    """A coefficient that has moved, whatever explains that: its ratio to the learned value, with a 95 % interval."""

    name: str
    ratio: float
    interval: Interval


class FaultEstimate(ResultModel):
    """A fault with its size: `ratio` of `parameter` to its healthy value, and the 95 % interval of it.

    The parameter of a fault learned from labelled recordings is ``severity``: there `ratio` is to the labelled one.
    """

    name: str
    parameter: str
    ratio: float
    interval: Interval
    # of a payload at a place that the loop file knows: its mass [kg] and the 95 % interval of it
    mass_kg: tuple[float, float, float] | None = Field(default=None, exclude_if=lambda value: value is None)

    @property
    def learned(self) -> bool:
        """Whether it is known from labelled recordings, so that `ratio` is a share of their severity."""
        return self.parameter == SEVERITY

    @property
    def may_be_healthy(self) -> bool:
        """Whether the 95 % interval of its ratio holds the healthy value; a share of a labelled severity never does."""
        return not self.learned and self.interval[0] <= 1.0 <= self.interval[1]

    @property
    def change(self) -> float:
        """How far from healthy it is: of the parameter's healthy value, or of the labelled severity."""
        return self.ratio if self.learned else abs(self.ratio - 1.0)

    def weighed(self, plant: Plant) -> Self:
        """Return it with the mass that its ratio stands for, where it is one of a payload whose place is known."""
        value, low, high = (plant.added_mass(self.parameter, ratio) for ratio in (self.ratio, *self.interval))
        mass = None if value is None or low is None or high is None else (value, low, high)
        return self.model_copy(update={"mass_kg": mass})


class Candidate(ResultModel):
    """One explanation of a detected change; ``unknown`` carries no faults."""

    name: str
    probability: float
    faults: tuple[FaultEstimate, ...] = ()
    misfit: float | None = None  # squared standard deviations by which it fits worse than the best; None for unknown
    covariance: tuple[tuple[float, ...], ...] | None = None  # of a pair: of the logarithms of its ratios, shape (k, k)
    # Of a fault learned from labelled recordings: of the angle between the deviation and its direction, in units of
    # the misfit's covariance; 1 is the same way, 0 elsewhere, -1 the opposite way.
    cosine: float | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its faults, of which `name` is made; ``unknown`` where there are none."""
        return tuple(fault.name for fault in self.faults) or (self.name,)

    @property
    def is_learned(self) -> bool:
        """Whether it is a fault learned from labelled recordings."""
        return any(fault.learned for fault in self.faults)

    def weighed(self, plant: Plant) -> Self:
        """Return it with the masses of its faults."""
        return self.model_copy(update={"faults": tuple(fault.weighed(plant) for fault in self.faults)})
