"""What is known of an asset, and whether it is normal or abnormal in the sense of one alarm."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from servoscope.core.messages import message, render
from servoscope.service.alarms.settings import ABNORMAL_WORDS, TROUBLE_SOURCES, AlarmDefinition, AlarmSource
from servoscope.service.assets.reception import Reception
from servoscope.signals import quality

Condition = Literal["normal", "abnormal", "unknown"]
# words of a source that say that no other of its words can be known
MASKING_WORDS = {"verdict": ("undetermined",), "quality": ("waiting", "silent")}


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
    # what is wrong with a connection, with an asset that is left out, or with files that wait; None: none of them
    trouble: str | None = None
    outlook: str | None = None  # whether the limit of its fault is ``near`` or ``reached``; None: it has none
    control: str | None = None  # what the last minutes show by themselves; "": nothing; None: not assessed
    outlook_cause: str = ""  # the prognosis in a sentence
    alarms: tuple[str, ...] = ()  # the asset's alarms whose condition is abnormal; `advance_alarms` fills it in
    cause: str = ""  # what transitions name as their cause, for example the diagnosis in a sentence


def evaluate_condition(definition: AlarmDefinition, abnormal: bool, snapshot: AssetSnapshot) -> Condition:
    """Return what a snapshot means for an alarm; `abnormal`: whether its condition was so before, for the hysteresis.

    What is not known is not normal: an alarm neither occurs nor clears for want of data.
    """
    source = definition.source
    if source in ABNORMAL_WORDS:
        words = observed_words(source, snapshot)
        if words is not None and any(word in definition.abnormal_words for word in words):
            return "abnormal"
        masks = MASKING_WORDS.get(source, ())
        return "unknown" if words is None or any(word in masks for word in words) else "normal"
    value: float | None = getattr(snapshot, source)
    if value is None or math.isnan(value):
        return "unknown"
    return "abnormal" if value >= definition.limit - definition.hysteresis * abnormal else "normal"


def observed_words(source: AlarmSource, snapshot: AssetSnapshot) -> tuple[str, ...] | None:
    """Return the words of a source that hold now; None: not known."""
    reception, trouble = snapshot.reception, snapshot.trouble
    if source == "reception":  # a source that is down has an alarm of its own
        return None if reception is None or reception.source_down else (reception.state,)
    if source in TROUBLE_SOURCES:
        return None if trouble is None else ("trouble",) * bool(trouble)
    value: tuple[str, ...] | str | None = getattr(snapshot, source)
    return (value,) if isinstance(value, str) else value


def describe_cause(definition: AlarmDefinition, snapshot: AssetSnapshot) -> str:
    """Return the cause that an alarm's transitions name."""
    if definition.source == "quality":
        return quality.describe_findings(snapshot.quality)
    if definition.source == "reception" and snapshot.reception is not None:
        return snapshot.reception.why
    if definition.source in TROUBLE_SOURCES:
        return snapshot.trouble or ""
    if definition.source == "outlook":
        return snapshot.outlook_cause
    if definition.source == "control":
        return render(message("alarm.cause_control", cause=snapshot.control or ""))
    if definition.source == "statistic" and snapshot.statistic is not None:
        return render(message("alarm.cause_statistic", ratio=snapshot.statistic))
    if definition.source == "level" and snapshot.level is not None:
        return render(message("alarm.cause_level", ratio=snapshot.level))
    return snapshot.cause
