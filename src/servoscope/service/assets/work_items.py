"""What somebody has to look after on an asset: findings with size, since when, what to check and how urgent."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from datetime import UTC, datetime
from typing import NamedTuple

from servoscope.service.alarms import LifecycleState, Ne107, Priority
from servoscope.service.alarms.settings import PRIORITIES
from servoscope.service.assets.status import AlarmStatus, AssetStatus

PUT_ASIDE = (LifecycleState.SUPPRESSED, LifecycleState.OUT_OF_SERVICE)
WEAR: Ne107 = "maintenance_required"


class WorkItem(NamedTuple):
    """One finding that somebody has to look after; times are ISO 8601 in UTC, sizes ratios to healthy."""

    key: str  # the same as long as the finding lasts: who imports the list again finds the item by it
    asset: str
    group: str
    finding: str
    since: str
    parameter: str
    size: float | None
    size_low: float | None  # ends of the 95 % interval; None: nothing bounds it there
    size_high: float | None
    check: tuple[str, ...]  # what to check on the machine
    urgency: Priority
    due: str  # earliest time at which the fault may reach its limit, by the forecast
    ne107: Ne107


def work_items(asset: str, status: AssetStatus) -> list[WorkItem]:
    """Return what is to be done on an asset: at least one item unless its NE 107 status is good.

    Alarms of wear are no items of their own while a fault is known: they say that there is one.
    """
    alarms = {name: alarm for name, alarm in status.alarms.items() if _is_present(alarm)}
    has_fault = status.verdict == "fault"
    items = list(_faults(asset, status, alarms.values())) if has_fault else []
    items += [
        _item(asset, status, name, alarm.cause or name, alarm.since, _most_urgent([alarm]), alarm.ne107 or WEAR)
        for name, alarm in alarms.items()
        if not (has_fault and (alarm.ne107 or WEAR) == WEAR)
    ]
    if not items and status.ne107 != "good":
        items.append(_item(asset, status, status.verdict, status.summary, status.since, "low", status.ne107))
    return items


def _faults(asset: str, status: AssetStatus, alarms: Iterable[AlarmStatus]) -> Iterable[WorkItem]:
    faults, _ = status.newest_sizes
    since = status.since if status.onset is None else status.onset
    urgency, known = _most_urgent([alarm for alarm in alarms if (alarm.ne107 or WEAR) == WEAR]), status.metadata
    for fault in faults:
        low, high = (end if math.isfinite(end) else None for end in fault.interval)
        finding = known.faults.get(fault.name, fault.name)
        yield _item(asset, status, fault.name, finding, since, urgency, status.ne107)._replace(
            parameter=fault.parameter,
            size=fault.ratio,
            size_low=low,
            size_high=high,
            check=known.checks.get(fault.name, ()),
            due=_due(status, fault.name),
        )
    if not faults:
        yield _item(asset, status, "unknown", status.summary, since, urgency, status.ne107)


def _item(
    asset: str, status: AssetStatus, name: str, finding: str, since: float, urgency: Priority, ne107: Ne107
) -> WorkItem:
    key, group = f"{asset}:{name}", status.metadata.group
    return WorkItem(key, asset, group, finding, _time(since), "", None, None, None, (), urgency, "", ne107)


def _is_present(alarm: AlarmStatus) -> bool:
    """Return whether there is something to do: a latched alarm whose condition has gone needs no work."""
    return alarm.active is not False and alarm.state not in PUT_ASIDE


def _most_urgent(alarms: Collection[AlarmStatus]) -> Priority:
    return max((alarm.priority or "medium" for alarm in alarms), key=PRIORITIES.index, default="medium")


def _due(status: AssetStatus, fault: str) -> str:
    """Return when a fault may reach its limit; empty where no limit is known, or it is far beyond what can be said."""
    outlook = status.outlook
    if outlook is None or outlook.name != fault or outlook.outlook == "none":
        return ""
    t = outlook.t if outlook.outlook == "reached" else (outlook.reach_t or (None,))[0]
    return "" if t is None else _time(t)


def _time(t: float) -> str:
    return datetime.fromtimestamp(t, UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
