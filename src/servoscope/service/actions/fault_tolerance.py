"""Fault tolerance: a bounded change of a gain or a set-point, recommended, or executed through a sink."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from servoscope.core.messages import message, render
from servoscope.service.actions.outbox import OutboxEntry, idempotency_key
from servoscope.service.actions.settings import FaultToleranceSettings
from servoscope.service.alarms.records import JsonRecord, PersistentState

HOUR_S = 3600.0
MIN_STEP_SHARE = 0.05  # of max_step: smaller changes are noise of the estimate


@dataclass(frozen=True)
class FaultToleranceState(PersistentState):
    """What is remembered of one quantity of one asset."""

    saved_as: ClassVar[str] = "tolerance state"

    value: float  # as it was requested last; nominal at first
    changed: tuple[float, ...] = ()  # when a change was requested, within the last hour (epoch, s)
    sequence: int = 0  # number of changes so far


@dataclass(frozen=True)
class ControlChange(JsonRecord):
    """A change that was recommended or executed; for the audit."""

    time: float  # (epoch, s)
    asset: str
    action: str  # the table `[actions.tolerance.NAME]`
    sequence: int  # which of its changes
    quantity: str  # quantity, kind: what is changed
    kind: str
    previous: float  # previous, value, target: from, to, and where it would go without limits
    value: float
    target: float
    executed: bool  # whether it was sent to a sink, or only recommended
    reason: str  # the fault, and which limit holds the change back


def accommodate_fault(
    name: str,
    settings: FaultToleranceSettings,
    state: FaultToleranceState,
    asset: str,
    ratio: float | None,
    time: float,
    now: float,
) -> tuple[FaultToleranceState, ControlChange | None, OutboxEntry | None]:
    """Return what to change now: at most one bounded step towards the value that the fault requires.

    Call it with each diagnosis, at its `time` (epoch, s), and with the fault's `ratio` to healthy if it is the one of
    the settings and alone in the diagnosis; with None when the alarm is normal again, which leads back to nominal.
    `now` is of the clock that `deliver` is given. The change is None where there is nothing to change or it is not
    allowed now; the entry for the outbox is there in mode ``execute`` only.
    """
    target = settings.nominal if ratio is None else settings.target_value(ratio)
    bounded = min(max(target, settings.min), settings.max)
    step = min(max(bounded - state.value, -settings.max_step), settings.max_step)
    # the future counts too: the clock was set
    changed = tuple(moment for moment in state.changed if time - HOUR_S < moment)
    worthwhile = abs(step) > MIN_STEP_SHARE * settings.max_step  # False for NaN
    if settings.mode == "off" or not worthwhile or len(changed) >= settings.per_hour:
        return state, None, None
    value = bounded if step == bounded - state.value else state.value + step
    limits = [message("service.limit_bounds", min=settings.min, max=settings.max)] if bounded != target else []
    limits += [message("service.limit_step", max_step=settings.max_step)] if value != bounded else []
    key = "service.change_over" if ratio is None else "service.change_present"
    cause = message(key, fault=settings.fault, ratio=ratio)
    change = ControlChange(
        time=time,
        asset=asset,
        action=name,
        sequence=state.sequence + 1,
        quantity=settings.quantity,
        kind=settings.kind,
        previous=state.value,
        value=value,
        target=target,
        executed=settings.mode == "execute",
        reason=render(message("service.change_limited", cause=cause, limits=limits) if limits else cause),
    )
    entry = None
    if change.executed and settings.sink is not None:
        key = idempotency_key(name, asset, change.sequence, repr(time))
        entry = OutboxEntry(key, settings.sink, {"key": key, "event": "change", **change.to_dict()}, now, now)
    return FaultToleranceState(value, (*changed, time), change.sequence), change, entry
