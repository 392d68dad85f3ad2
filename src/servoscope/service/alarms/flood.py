"""A flood of alarms across a fleet: detected; lower priorities are held and counted, and announced at its end."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

from servoscope.service.alarms.records import UNACKNOWLEDGED_STATES, AlarmTransition, PersistentState
from servoscope.service.alarms.settings import PRIORITIES, FloodSettings, Priority


@dataclass(frozen=True)
class HeldAlarm:
    """An alarm that a flood keeps from being announced: its latest transition, and how often it was new meanwhile."""

    transition: AlarmTransition
    priority: Priority
    count: int


@dataclass(frozen=True)
class FloodState(PersistentState):
    """What is remembered of a fleet's new alarms; times are (epoch, s)."""

    saved_as: ClassVar[str] = "flood state"

    recent: tuple[float, ...] = ()  # when they occurred, as far as they count
    since: float | None = None  # beginning of the flood; None: there is none
    counted: int = 0  # counted, peak: new alarms in it so far, and the most within one period
    peak: int = 0
    held: tuple[HeldAlarm, ...] = ()  # those that wait for its end


@dataclass(frozen=True)
class Notification:
    """What operators are notified of."""

    # ``alarm``: one that is new; ``change``: another transition; ``held``: the latest transition of one that a flood
    # has held, at its end; ``flood_begins`` and ``flood_ends``
    kind: Literal["alarm", "change", "held", "flood_begins", "flood_ends"]
    time: float  # (epoch, s)
    transition: AlarmTransition | None = None  # transition, priority: of the first three kinds
    priority: Priority | None = None
    counted: int = 1  # how often a held alarm was new; new alarms in the flood
    peak: int = 0  # of a flood: the most new alarms within one period


def notify_transition(
    settings: FloodSettings, state: FloodState, transition: AlarmTransition, priority: Priority
) -> tuple[FloodState, tuple[Notification, ...]]:
    """Take each transition of any asset's alarm, about in the order of time; return what operators are notified of."""
    state, notices = advance_flood(settings, state, transition.time)
    if transition.is_new:
        recent = (*state.recent, transition.time)
        counted = len(recent) if state.since is None else state.counted + 1
        state = replace(state, recent=recent, counted=counted, peak=max(state.peak, len(recent)))
        if state.since is None and len(recent) > settings.limit:
            state = replace(state, since=transition.time)
            notices += (Notification("flood_begins", transition.time, counted=counted, peak=state.peak),)
    asset, alarm = transition.asset, transition.alarm
    places = [
        k
        for k, held_alarm in enumerate(state.held)
        if held_alarm.transition.asset == asset and held_alarm.transition.alarm == alarm
    ]
    before = state.held[places[0]] if places else None
    low = PRIORITIES.index(priority) < PRIORITIES.index(settings.announced_from)
    waits = transition.is_new or (before is not None and transition.after in UNACKNOWLEDGED_STATES)
    if state.since is not None and low and waits:
        held = HeldAlarm(transition, priority, (before.count if before else 0) + transition.is_new)
        k = places[0] if places else len(state.held)
        return replace(state, held=(*state.held[:k], held, *state.held[k + 1 :])), notices
    # Somebody has dealt with a held alarm, or its priority is high now: it is not announced once more at the end.
    if before is not None:
        state = replace(state, held=tuple(alarm for alarm in state.held if alarm is not before))
    kind: Literal["alarm", "change"] = "alarm" if transition.is_new else "change"
    return state, (*notices, Notification(kind, transition.time, transition, priority))


def advance_flood(
    settings: FloodSettings, state: FloodState, time: float
) -> tuple[FloodState, tuple[Notification, ...]]:
    """Advance to a time (epoch, s): a flood ends when few enough alarms are new, and what it held is announced."""
    # Assets report transitions one after the other: what is a little ahead counts, a clock that was set does not.
    recent = state.recent
    if recent and max(time - min(recent), max(recent) - time) >= settings.period_s:
        recent = tuple(alarm_time for alarm_time in recent if abs(time - alarm_time) < settings.period_s)
    if state.since is None:
        return replace(state, recent=recent, counted=0, peak=0), ()
    if len(recent) >= settings.ends_below:
        return replace(state, recent=recent), ()
    end = Notification("flood_ends", time, counted=state.counted, peak=state.peak)
    held = (Notification("held", time, alarm.transition, alarm.priority, alarm.count) for alarm in state.held)
    return FloodState(recent), (end, *held)
