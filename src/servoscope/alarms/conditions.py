"""What is known of an asset, and whether it is normal or abnormal in the sense of one alarm."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from servoscope import quality
from servoscope.alarms.definitions import AlarmDefinition

__all__ = ["Condition", "Snapshot", "because", "condition"]

Condition = Literal["normal", "abnormal", "unknown"]
BLIND = ("waiting", "silent")  # findings that leave nothing to be seen of the others


@dataclass(frozen=True)
class Snapshot:
    """What is known of an asset at one time, as far as alarms are concerned; it holds until the next one.

    Parameters
    ----------
    verdict
        ``healthy``, ``fault`` or ``undetermined``, data quality already considered (`servoscope.quality.judged`).
    quality
        Findings of data quality that stand.
    statistic, level
        T^2 and the sequential test as multiples of their limits; None: not evaluated.
    buffered
        Share of the service's buffer that is filled; None: not the service.
    alarms
        Names of the asset's alarms whose condition is abnormal; `advance` fills it in.
    cause
        What to say of it in transitions, for example the diagnosis in a sentence.
    """

    verdict: str = "undetermined"
    quality: tuple[str, ...] = ()
    statistic: float | None = None
    level: float | None = None
    buffered: float | None = None
    alarms: tuple[str, ...] = ()
    cause: str = ""


def condition(definition: AlarmDefinition, abnormal: bool, seen: Snapshot) -> Condition:
    """Return what a snapshot means to an alarm.

    Parameters
    ----------
    definition
        What the alarm watches.
    abnormal
        Whether the condition was abnormal before: hysteresis asks for it.
    seen
        What is known. What is not known is not normal: an alarm neither occurs nor clears for want of data.
    """
    if definition.source == "verdict":
        if seen.verdict in definition.words:
            return "abnormal"
        return "unknown" if seen.verdict == "undetermined" else "normal"
    if definition.source == "quality":
        if any(kind in definition.words for kind in seen.quality):
            return "abnormal"
        return "unknown" if any(kind in BLIND for kind in seen.quality) else "normal"
    values = {"statistic": seen.statistic, "level": seen.level, "buffered": seen.buffered}
    value = values[definition.source]
    if value is None or math.isnan(value):
        return "unknown"
    return "abnormal" if value >= definition.limit - definition.hysteresis * abnormal else "normal"


def because(definition: AlarmDefinition, seen: Snapshot) -> str:
    """Return what a snapshot says to an alarm, for its transitions."""
    if definition.source == "quality":
        return quality.told(seen.quality)
    if definition.source == "statistic" and seen.statistic is not None:
        return f"T^2 is {seen.statistic:.3g} times its limit"
    if definition.source == "level" and seen.level is not None:
        return f"the sequential test is at {seen.level:.3g} times its limit"
    return seen.cause
