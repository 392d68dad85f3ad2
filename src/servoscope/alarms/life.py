"""An alarm's life: its state, carried through observations, time and commands; every transition comes out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from servoscope.alarms.conditions import Snapshot, because, condition
from servoscope.alarms.definitions import AlarmDefinition
from servoscope.alarms.records import AlarmState, Command, Transition
from servoscope.alarms.states import COMMANDS, LATCHED, Event, Found, State, after
from servoscope.errors import AlarmError

__all__ = ["advance", "start", "step"]

SYSTEM = "system"  # who, where nobody did


def start(asset: str, alarm: str, time: float) -> AlarmState:
    """Return the state of an alarm that nothing is known of yet, at a time (epoch, s)."""
    return AlarmState(asset, alarm, at=time, since=time, condition_since=time)


def step(
    definition: AlarmDefinition, state: AlarmState, given: Snapshot | Command | None, time: float
) -> tuple[AlarmState, tuple[Transition, ...]]:
    """Carry one alarm to a time: first the delays that end until then, each at its own moment, then what is given.

    An observation holds until the next one, so that steps in between, with None, change nothing but when transitions
    are told. A clock that is set back takes running delays with it.

    Parameters
    ----------
    definition
        What the alarm is.
    state
        As returned by `start` or an earlier step; it stays valid.
    given
        An observation, a command, or None: only time has passed.
    time
        Now (epoch, s).

    Returns
    -------
    AlarmState, tuple of Transition
        The new state, and what happened, in order.

    Raises
    ------
    AlarmError
        If a command has no meaning in the state that the alarm is in.
    """
    life = _Life(definition, _set_back(state, time))
    life.run_to(time)
    if isinstance(given, Command):
        life.obey(given, time)
    elif given is not None:
        life.observe(given, time)
        life.run_to(time)
    return replace(life.state, at=time), tuple(life.transitions)


def advance(
    definitions: Mapping[str, AlarmDefinition], states: Mapping[str, AlarmState], given: Snapshot | None, time: float
) -> tuple[dict[str, AlarmState], tuple[Transition, ...]]:
    """Carry all alarms of an asset to a time.

    Parameters
    ----------
    definitions
        By name, as `AlarmSettings.of_asset` has them. An alarm that suppresses others stands before them, so that
        both happen at the same moment.
    states
        By name, one for each definition.
    given
        An observation; None: only time has passed.
    time
        Now (epoch, s).
    """
    new, told = dict(states), list[Transition]()
    for name, definition in definitions.items():
        active = tuple(other for other, one in new.items() if one.active)
        if given is not None and given.alarms != active:
            given = replace(given, alarms=active)
        new[name], transitions = step(definition, new[name], given, time)
        told += transitions
    return new, tuple(sorted(told, key=lambda one: one.time))


class _Life:
    """One step in progress."""

    def __init__(self, definition: AlarmDefinition, state: AlarmState) -> None:
        self.definition = definition
        self.state = state
        self.transitions: list[Transition] = []

    def run_to(self, time: float) -> None:
        """Let happen what is due until then, the earliest first."""
        while due := [one for one in self._due() if one[0] <= time]:
            when, event = min(due, key=lambda one: one[0])
            # A delay made shorter while it runs may have ended in the past, which has been told already.
            when = max(when, self.state.at)
            self._happen(event, when, "shelving expired" if event is Event.EXPIRE else self.state.cause)

    def observe(self, seen: Snapshot, time: float) -> None:
        """Put what is known now in the place of what was known."""
        definition, state = self.definition, self.state
        suppressors = [word for word in definition.suppressed_when if word in (*seen.quality, *seen.alarms)]
        if bool(suppressors) != state.suppressed:
            event = Event.SUPPRESS if suppressors else Event.UNSUPPRESS
            self._happen(event, time, ", ".join(suppressors or definition.suppressed_when))
        was = state.condition == "abnormal" or (state.condition == "unknown" and state.active)
        now = condition(definition, was, seen)
        since = state.condition_since if now == state.condition else time
        self.state = replace(self.state, condition=now, condition_since=since, cause=because(definition, seen))

    def obey(self, command: Command, time: float) -> None:
        """Do what is commanded, or refuse it."""
        state, event, until = self.state, command.event, command.until
        name = f"{state.asset}: {state.alarm}"
        if event not in COMMANDS:
            raise AlarmError(f"{name}: {event} is not a command, choose from {', '.join(COMMANDS)}")
        if after(state.state, event, self._found()) is None:
            raise AlarmError(f"{name} is {state.state}: {event} means nothing there")
        if event is Event.SHELVE and (until is None or not time < until < math.inf):
            raise AlarmError(f"{name}: shelving needs an end in the future, say until when")
        self._happen(event, time, command.why, command.who)
        if event is Event.SHELVE:
            self.state = replace(self.state, shelved_until=until)

    def _due(self) -> Iterator[tuple[float, Event]]:
        state, definition = self.state, self.definition
        if state.condition == "abnormal" and not state.active:
            yield state.condition_since + definition.on_delay_s, Event.OCCUR
        if state.condition == "normal" and state.active:
            event = Event.CLEAR_LATCHED if definition.latching else Event.CLEAR
            yield state.condition_since + definition.off_delay_s, event
        if state.shelved_until is not None:
            yield state.shelved_until, Event.EXPIRE

    def _found(self) -> Found:
        state = self.state
        if state.suppressed:
            return "suppressed"
        if state.active:
            return "abnormal"
        return "latched" if state.latched else "normal"

    def _happen(self, event: Event, time: float, cause: str, who: str = SYSTEM) -> None:
        """Write what the event says of condition and design, then what the table says of the state."""
        flags = _FLAGS.get(event, {})
        self.state = replace(self.state, **flags)
        before = self.state.state
        to = after(before, event, self._found())
        if to is None:
            raise AssertionError(f"{event} cannot happen in {before}")
        latched = self.state.latched or to in LATCHED or (to is State.UNACKNOWLEDGED and self.definition.latching)
        self.state = replace(
            self.state,
            state=to,
            since=self.state.since if to is before else time,
            latched=latched and event not in (Event.RESET, Event.CLEAR),
            shelved_until=self.state.shelved_until if to is State.SHELVED else None,
            sequence=self.state.sequence + 1,
        )
        name = self.state.asset, self.state.alarm, self.state.sequence
        self.transitions.append(Transition(time, *name, before, to, event, cause, who))


_FLAGS: dict[Event, dict[str, Any]] = {
    Event.OCCUR: {"active": True},
    Event.CLEAR: {"active": False},
    Event.CLEAR_LATCHED: {"active": False},
    Event.SUPPRESS: {"suppressed": True},
    Event.UNSUPPRESS: {"suppressed": False},
}


def _set_back(state: AlarmState, time: float) -> AlarmState:
    """Return the state with its times moved along, if the clock has been set back."""
    if time >= state.at:
        return state
    back = state.at - time
    until = None if state.shelved_until is None else state.shelved_until - back
    since, condition_since = state.since - back, state.condition_since - back
    return replace(state, at=time, since=since, condition_since=condition_since, shelved_until=until)
