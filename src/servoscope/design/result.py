"""What a study before deployment says, as data: one JSON object per loop, reference and noise."""

from __future__ import annotations

import math

from pydantic import BaseModel, ConfigDict

from servoscope.core.messages import MessageText

Spans = tuple[tuple[float, float | None], ...]


class _StudyModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class DirectionStudy(_StudyModel):
    """One direction of a fault.

    Parameters
    ----------
    detectable
        Ratio from which on the monitor announces it in time with 90 % probability; None: nowhere in its range.
    unclear
        Spans of ratios at which it is not named rightly with 99.5 % probability, from the smallest change on; an open
        end is None.
    bound
        End of the first span as linear sensitivities and the Cramer-Rao bound have it.
    nearest
        Fault that it is taken for, if any.
    tracking, stability
        Ratio from which on the loop no longer follows its reference, or has lost half of its margin of stability; None:
        nowhere in its range, or a study of before this was asked.
    """

    detectable: float | None
    unclear: Spans
    bound: float | None
    nearest: str
    tracking: float | None = None
    stability: float | None = None

    @property
    def isolable(self) -> float | None:
        """Ratio from which on it is named rightly; None: nowhere in its range."""
        return self.unclear[-1][1] if self.unclear else 1.0

    @property
    def first_isolable(self) -> float | None:
        """Smallest ratio at which it is named rightly, though larger ones may be unclear again."""
        return self.unclear[0][1] if self.unclear else 1.0

    def clear(self, ratio: float) -> bool:
        """Return whether a fault of this ratio is named rightly."""
        x = abs(math.log(ratio))
        return not any(abs(math.log(a)) <= x and (b is None or x <= abs(math.log(b))) for a, b in self.unclear)


class SizePrecision(_StudyModel):
    """Smallest standard deviation of a size, relative, so many seconds after the onset; None: nothing tells it.

    The healthy parameters are known as the baseline and the seconds before the onset know them.
    """

    seconds: float
    std: float | None


class FaultStudy(_StudyModel):
    """One fault, by direction, and how precise its size becomes."""

    name: str
    parameter: str
    sizes: tuple[SizePrecision, ...]
    up: DirectionStudy
    down: DirectionStudy


class MimicStudy(_StudyModel):
    """A change that is no fault of the list, and the one that it looks like.

    Parameters
    ----------
    amount, unit
        Size of the change that `looks_like` is told for: 0.01 relative, or a tenth of a sample.
    cosines
        Between its innovations and those of each fault.
    imitates, looks_like
        The fault with the largest cosine, and the ratio that it seems to have.
    told_apart
        Amount from which on it is told from that fault; None: never.
    """

    name: str
    words: MessageText
    amount: float
    unit: str
    cosines: dict[str, float]
    imitates: str
    looks_like: float
    told_apart: float | None


class FaultPromise(_StudyModel):
    """One fault, by a baseline alone: relative changes from which on it is detected, and named; None: never."""

    parameter: str
    detectable: float | None
    isolable: float | None
    nearest: str  # the fault that it is most like


class BaselineStudy(_StudyModel):
    """What a baseline alone says of faults, under the motion that it was learned from; `missing`: why not more."""

    loop: str
    missing: str
    false_alarms_per_year: float
    faults: dict[str, FaultPromise]
    cosines: dict[str, dict[str, float]]


class DesignStudy(_StudyModel):
    """Which faults of a loop can be detected and told apart, and at which size.

    Parameters
    ----------
    loop, reference
        What is studied.
    units
        Of y and u; empty where they are not known.
    before_s, after_s
        Healthy seconds before the onset, and seconds after it that count.
    noise_u_std, noise_y_std
        Of the loop.
    false_alarms_per_year
        Budget.
    faults
        By name.
    cosines
        Between what small faults do, by their names; what errors of the healthy parameters explain is left out.
    mimics
        What else the faults could be.
    """

    loop: str
    reference: MessageText
    units: tuple[str, str]
    before_s: float
    after_s: float
    noise_u_std: float
    noise_y_std: float
    false_alarms_per_year: float
    faults: dict[str, FaultStudy]
    cosines: dict[str, dict[str, float]]
    mimics: tuple[MimicStudy, ...]
