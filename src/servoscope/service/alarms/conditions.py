"""What is known of an asset, and whether it is normal or abnormal in the sense of one alarm."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from servoscope.core.messages import message, render
from servoscope.service.alarms.settings import AlarmDefinition
from servoscope.service.assets.reception import Reception
from servoscope.signals import quality

Condition = Literal["normal", "abnormal", "unknown"]
MASKING_FINDINGS = ("waiting", "silent")  # findings of data quality behind which no other can be detected


@dataclass(frozen=True)
class AssetSnapshot:
    """What is known of an asset at one time, as far as alarms are concerned; it holds until the next one."""

    # ``healthy``, ``fault`` or ``undetermined``, data quality already considered (`signals.quality.limit_verdict`)
    verdict: str = "undetermined"
    quality: tuple[str, ...] = ()  # active findings of data quality
    # statistic, level: T^2 and the sequential test as multiples of their limits; None: not evaluated
    statistic: float | None = None
    level: float | None = None
    reception: Reception | None = None  # how its samples come in; None: the service itself
    buffered: float | None = None  # share of the service's buffer that is filled; None: not the service
    connection: str | None = None  # what is wrong with a connection of the service; None: not a connection
    outlook: str | None = None  # whether the limit of its fault is ``near`` or ``reached``; None: it has none
    control: str | None = None  # what is nearly certainly wrong with the control; "": nothing; None: not assessed
    outlook_cause: str = ""  # the prognosis in a sentence
    alarms: tuple[str, ...] = ()  # the asset's alarms whose condition is abnormal; `advance_alarms` fills it in
    cause: str = ""  # what transitions name as their cause, for example the diagnosis in a sentence


def evaluate_condition(definition: AlarmDefinition, abnormal: bool, snapshot: AssetSnapshot) -> Condition:
    """Return what a snapshot means for an alarm; `abnormal`: whether its condition was so before, for the hysteresis.

    What is not known is not normal: an alarm neither occurs nor clears for want of data.
    """
    words = definition.abnormal_words
    if definition.source == "verdict":
        if snapshot.verdict in words:
            return "abnormal"
        return "unknown" if snapshot.verdict == "undetermined" else "normal"
    if definition.source == "quality":
        if any(kind in words for kind in snapshot.quality):
            return "abnormal"
        return "unknown" if any(kind in MASKING_FINDINGS for kind in snapshot.quality) else "normal"
    if definition.source == "reception":
        if snapshot.reception is None or snapshot.reception.source_down:  # the source has an alarm of its own
            return "unknown"
        return "abnormal" if snapshot.reception.state in words else "normal"
    if definition.source == "connection":
        return "unknown" if snapshot.connection is None else "abnormal" if snapshot.connection else "normal"
    if definition.source == "outlook":
        return "unknown" if snapshot.outlook is None else "abnormal" if snapshot.outlook in words else "normal"
    if definition.source == "control":
        return "unknown" if snapshot.control is None else "abnormal" if snapshot.control in words else "normal"
    value: float | None = getattr(snapshot, definition.source)
    if value is None or math.isnan(value):
        return "unknown"
    return "abnormal" if value >= definition.limit - definition.hysteresis * abnormal else "normal"


def describe_cause(definition: AlarmDefinition, snapshot: AssetSnapshot) -> str:
    """Return the cause that an alarm's transitions name."""
    if definition.source == "quality":
        return quality.describe_findings(snapshot.quality)
    if definition.source == "reception" and snapshot.reception is not None:
        return snapshot.reception.why
    if definition.source == "connection":
        return snapshot.connection or ""
    if definition.source == "outlook":
        return snapshot.outlook_cause
    if definition.source == "control":
        return render(message("alarm.cause_control", cause=snapshot.control or ""))
    if definition.source == "statistic" and snapshot.statistic is not None:
        return render(message("alarm.cause_statistic", ratio=snapshot.statistic))
    if definition.source == "level" and snapshot.level is not None:
        return render(message("alarm.cause_level", ratio=snapshot.level))
    return snapshot.cause
