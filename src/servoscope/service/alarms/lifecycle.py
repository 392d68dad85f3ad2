"""The life-cycle of an alarm: its state is advanced by observations, time and commands; each transition is returned.

And the status of an asset after NAMUR NE 107, from its verdict, its data and its alarms.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple, get_args

from servoscope.core.errors import AlarmError
from servoscope.core.messages import message, render
from servoscope.service.alarms.conditions import AssetSnapshot, describe_cause, evaluate_condition
from servoscope.service.alarms.records import (
    COMMANDS,
    LATCHED_STATES,
    AlarmState,
    AlarmTransition,
    LifecycleEvent,
    LifecycleState,
    OperatorCommand,
    ReleaseCondition,
    next_state,
)
from servoscope.service.alarms.settings import AlarmDefinition, Ne107

SYSTEM_USER = "system"  # where nobody commanded a transition
EVENT_FLAGS: dict[LifecycleEvent, dict[str, Any]] = {  # what an event says of condition and design
    LifecycleEvent.OCCUR: {"active": True},
    LifecycleEvent.CLEAR: {"active": False},
    LifecycleEvent.CLEAR_LATCHED: {"active": False},
    LifecycleEvent.SUPPRESS: {"suppressed": True},
    LifecycleEvent.UNSUPPRESS: {"suppressed": False},
}
SEVERITY: tuple[Ne107, ...] = get_args(Ne107)  # from good to failure, as NE 107 (2017) ranks them
NE107_OF_QUALITY: dict[str, Ne107] = {  # of a signal that does not come yet, that has failed, that is inaccurate
    "waiting": "function_check",
    **dict.fromkeys(("silent", "frozen_y", "frozen_u"), "failure"),
    **dict.fromkeys(("gap", "jitter", "rate", "clock"), "out_of_specification"),
}
NE107_OF_VERDICT: dict[str, Ne107] = {
    "undetermined": "function_check",
    "suspect": "maintenance_required",
    "fault": "maintenance_required",
}


def initial_alarm_state(asset: str, alarm: str, time: float) -> AlarmState:
    """Return the state of an alarm of which nothing is known yet, at a time (epoch, s)."""
    return AlarmState(asset, alarm, at=time, since=time, condition_since=time)


def step_alarm(
    definition: AlarmDefinition, state: AlarmState, update: AssetSnapshot | OperatorCommand | None, time: float
) -> tuple[AlarmState, tuple[AlarmTransition, ...]]:
    """Advance one alarm to a time (epoch, s): first the delays that end until then, each at its time, then `update`.

    An observation holds until the next one, so that further steps in between, with None, change only when transitions
    are returned. A clock that is set back moves running delays along. Raises AlarmError if a command has no meaning
    in the alarm's state.
    """
    step = _LifecycleStep(definition, _shift_times(state, time))
    step.run_to(time)
    if isinstance(update, OperatorCommand):
        step.execute(update, time)
    elif update is not None:
        step.observe(update, time)
        step.run_to(time)
    return replace(step.state, at=time), tuple(step.transitions)


def advance_alarms(
    definitions: Mapping[str, AlarmDefinition],
    states: Mapping[str, AlarmState],
    update: AssetSnapshot | None,
    time: float,
) -> tuple[dict[str, AlarmState], tuple[AlarmTransition, ...]]:
    """Advance all alarms of an asset to a time (epoch, s), in the order of `AlarmSettings.asset_alarms`.

    An alarm that suppresses others comes before them there, so that both happen at the same moment.
    """
    new, advanced = dict(states), list[AlarmTransition]()
    for name, definition in definitions.items():
        active = tuple(other for other, alarm_state in new.items() if alarm_state.active)
        if update is not None and update.alarms != active:
            update = replace(update, alarms=active)
        new[name], transitions = step_alarm(definition, new[name], update, time)
        advanced += transitions
    return new, tuple(sorted(advanced, key=lambda transition: transition.time))


def next_event_time(definitions: Mapping[str, AlarmDefinition], states: Mapping[str, AlarmState]) -> float:
    """Return when the first delay ends that is running, infinite where none is (epoch, s).

    Until then steps with the same observation change nothing but the time of the last step.
    """
    steps = (_LifecycleStep(definitions[name], state) for name, state in states.items())
    return min((when for step in steps for when, _ in step._due_events()), default=math.inf)


class AlarmStandstill(NamedTuple):
    """Until when alarms stay as they are, if nothing else becomes known than at their last step, at `at` (epoch, s)."""

    known: Hashable
    at: float
    until: float


class _LifecycleStep:
    """One step in progress."""

    def __init__(self, definition: AlarmDefinition, state: AlarmState) -> None:
        self.definition, self.state = definition, state
        self.transitions: list[AlarmTransition] = []

    def run_to(self, time: float) -> None:
        """Apply the events that are due until then, the earliest first."""
        while due := [pending for pending in self._due_events() if pending[0] <= time]:
            when, event = min(due, key=lambda candidate: candidate[0])
            # A delay made shorter while it runs may have ended in the past, whose history is already written.
            when, expired = max(when, self.state.at), event is LifecycleEvent.EXPIRE
            self._apply(event, when, render(message("alarm.shelving_expired")) if expired else self.state.cause)

    def observe(self, snapshot: AssetSnapshot, time: float) -> None:
        """Replace what was known by what is known now."""
        definition, state = self.definition, self.state
        suppressors = [word for word in definition.suppressed_when if word in (*snapshot.quality, *snapshot.alarms)]
        if bool(suppressors) != state.suppressed:
            event = LifecycleEvent.SUPPRESS if suppressors else LifecycleEvent.UNSUPPRESS
            self._apply(event, time, ", ".join(suppressors or definition.suppressed_when))
        was_abnormal = state.condition == "abnormal" or (state.condition == "unknown" and state.active)
        now = evaluate_condition(definition, was_abnormal, snapshot)
        since = state.condition_since if now == state.condition else time
        cause = describe_cause(definition, snapshot)
        self.state = replace(self.state, condition=now, condition_since=since, cause=cause)

    def execute(self, command: OperatorCommand, time: float) -> None:
        """Execute a command; raises AlarmError if it has no meaning in this state."""
        state, event, until = self.state, command.event, command.until
        name = f"{state.asset}: {state.alarm}"
        if event not in COMMANDS:
            raise AlarmError(f"{name}: {event} is not a command, choose from {', '.join(COMMANDS)}")
        if next_state(state.state, event, self._release_condition()) is None:
            raise AlarmError(f"{name} is {state.state}: {event} means nothing there")
        if event is LifecycleEvent.SHELVE and (until is None or not time < until < math.inf):
            raise AlarmError(f"{name}: shelving needs an end in the future, say until when")
        self._apply(event, time, command.reason, command.user)
        if event is LifecycleEvent.SHELVE:
            self.state = replace(self.state, shelved_until=until)

    def _due_events(self) -> Iterator[tuple[float, LifecycleEvent]]:
        state, definition = self.state, self.definition
        if state.condition == "abnormal" and not state.active:
            yield state.condition_since + definition.on_delay_s, LifecycleEvent.OCCUR
        if state.condition == "normal" and state.active:
            event = LifecycleEvent.CLEAR_LATCHED if definition.latching else LifecycleEvent.CLEAR
            yield state.condition_since + definition.off_delay_s, event
        if state.shelved_until is not None:
            yield state.shelved_until, LifecycleEvent.EXPIRE

    def _release_condition(self) -> ReleaseCondition:
        state = self.state
        if state.suppressed:
            return "suppressed"
        if state.active:
            return "abnormal"
        return "latched" if state.latched else "normal"

    def _apply(self, event: LifecycleEvent, time: float, cause: str, user: str = SYSTEM_USER) -> None:
        """Set what the event says of condition and design, then what the table says of the state."""
        state = self.state = replace(self.state, **EVENT_FLAGS.get(event, {}))
        to = next_state(state.state, event, self._release_condition())
        if to is None:
            raise AssertionError(f"{event} cannot happen in {state.state}")
        latches = to in LATCHED_STATES or (to is LifecycleState.UNACKNOWLEDGED and self.definition.latching)
        self.state = replace(
            state,
            state=to,
            since=state.since if to is state.state else time,
            latched=(state.latched or latches) and event not in (LifecycleEvent.RESET, LifecycleEvent.CLEAR),
            shelved_until=state.shelved_until if to is LifecycleState.SHELVED else None,
            sequence=state.sequence + 1,
        )
        number = self.state.sequence
        self.transitions.append(
            AlarmTransition(time, state.asset, state.alarm, number, state.state, to, event, cause, user)
        )


def _shift_times(state: AlarmState, time: float) -> AlarmState:
    """Return the state with its times moved along, if the clock has been set back."""
    if time >= state.at:
        return state
    back = state.at - time
    until = None if state.shelved_until is None else state.shelved_until - back
    since, condition_since = state.since - back, state.condition_since - back
    return replace(state, at=time, since=since, condition_since=condition_since, shelved_until=until)


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
    statuses: list[tuple[Ne107, str]] = [(NE107_OF_QUALITY[kind], kind) for kind in quality]
    if verdict in NE107_OF_VERDICT:
        statuses.append((NE107_OF_VERDICT[verdict], verdict))
    for definition, alarm_state in alarms:
        if alarm_state.state is LifecycleState.OUT_OF_SERVICE:
            statuses.append(("function_check", render(message("alarm.out_of_service", alarm=alarm_state.alarm))))
        elif not alarm_state.suppressed and (alarm_state.active or alarm_state.state in LATCHED_STATES):
            statuses.append((definition.ne107, alarm_state.alarm))
    worst: Ne107 = max((status for status, _ in statuses), key=SEVERITY.index, default="good")
    reasons = (reason for status, reason in statuses if status == worst and worst != "good")
    return Ne107Status(worst, tuple(dict.fromkeys(reasons)))
