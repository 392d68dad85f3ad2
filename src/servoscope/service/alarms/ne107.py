"""The status of an asset after NAMUR NE 107, from its verdict, its data and its alarms."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, get_args

from servoscope.core.messages import message, render
from servoscope.service.alarms.records import AlarmState
from servoscope.service.alarms.settings import AlarmDefinition, Ne107
from servoscope.service.alarms.state_table import LATCHED_STATES, LifecycleState

SEVERITY: tuple[Ne107, ...] = get_args(Ne107)  # from good to failure, as NE 107 (2017) ranks them
NE107_OF_QUALITY: dict[str, Ne107] = {  # of a signal that does not come yet, that has failed, that is inaccurate
    "waiting": "function_check",
    **dict.fromkeys(("silent", "frozen_y", "frozen_u"), "failure"),
    **dict.fromkeys(("gap", "jitter", "rate", "clock"), "out_of_specification"),
}
NE107_OF_VERDICT: dict[str, Ne107] = {"undetermined": "function_check", "fault": "maintenance_required"}


class Ne107Status(NamedTuple):
    """The most severe status, and its reasons."""

    ne107: Ne107
    reasons: tuple[str, ...]


def evaluate_ne107(
    verdict: str, quality: Iterable[str], alarms: Iterable[tuple[AlarmDefinition, AlarmState]]
) -> Ne107Status:
    """Return the status of an asset from its verdict, the active findings of data quality, and all of its alarms.

    An alarm that is shelved still counts, since shelving only silences it; one that its design suppresses does not;
    one that is out of service means that somebody works on the asset.
    """
    found: list[tuple[Ne107, str]] = [(NE107_OF_QUALITY[kind], kind) for kind in quality]
    if verdict in NE107_OF_VERDICT:
        found.append((NE107_OF_VERDICT[verdict], verdict))
    for definition, one in alarms:
        if one.state is LifecycleState.OUT_OF_SERVICE:
            found.append(("function_check", render(message("alarm.out_of_service", alarm=one.alarm))))
        elif not one.suppressed and (one.active or one.state in LATCHED_STATES):
            found.append((definition.ne107, one.alarm))
    worst: Ne107 = max((status for status, _ in found), key=SEVERITY.index, default="good")
    reasons = (reason for status, reason in found if status == worst and worst != "good")
    return Ne107Status(worst, tuple(dict.fromkeys(reasons)))
