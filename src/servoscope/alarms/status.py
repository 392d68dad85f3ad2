"""The status of an asset after NAMUR NE 107, from its verdict, its data and its alarms."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, get_args

from servoscope.alarms.definitions import AlarmDefinition, Ne107
from servoscope.alarms.records import AlarmState
from servoscope.alarms.states import LATCHED, State

__all__ = ["OF_QUALITY", "Status", "status"]

SEVERITY: tuple[Ne107, ...] = get_args(Ne107)  # from good to failure, as NE 107 (2017) ranks them

OF_QUALITY: dict[str, Ne107] = {
    "waiting": "function_check",
    "silent": "failure",
    "frozen_y": "failure",
    "frozen_u": "failure",
    "gap": "out_of_specification",
    "jitter": "out_of_specification",
    "rate": "out_of_specification",
    "clock": "out_of_specification",
}  # a signal that says nothing, one that does not say it yet, and one that says it badly


class Status(NamedTuple):
    """The most severe status, and all that speaks for it."""

    ne107: Ne107
    reasons: tuple[str, ...]


def status(verdict: str, quality: Iterable[str], alarms: Iterable[tuple[AlarmDefinition, AlarmState]]) -> Status:
    """Return the status of an asset.

    Parameters
    ----------
    verdict
        ``healthy``, ``fault`` or ``undetermined``.
    quality
        Findings of data quality that stand.
    alarms
        All of the asset. One that is shelved still speaks, since shelving is about telling operators; one that its
        design suppresses does not; one that is out of service says that somebody is at work.
    """
    said: list[tuple[Ne107, str]] = [(OF_QUALITY[kind], kind) for kind in quality]
    if verdict == "undetermined":
        said.append(("function_check", "undetermined"))
    if verdict == "fault":
        said.append(("maintenance_required", "fault"))
    for definition, one in alarms:
        if one.state is State.OUT_OF_SERVICE:
            said.append(("function_check", f"{one.alarm} is out of service"))
        elif not one.suppressed and (one.active or one.state in LATCHED):
            said.append((definition.ne107, one.alarm))
    worst: Ne107 = max((one for one, _ in said), key=SEVERITY.index, default="good")
    return Status(worst, tuple(dict.fromkeys(why for one, why in said if one == worst and worst != "good")))
