"""What an alarm remembers, what becomes of it, and what people may want of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from servoscope.alarms.conditions import Condition
from servoscope.alarms.saved import whole
from servoscope.alarms.states import Event, State
from servoscope.errors import StateError

__all__ = ["AlarmState", "Command", "Transition"]

VERSION = 1


@dataclass(frozen=True)
class Command:
    """What somebody wants: one of `servoscope.alarms.COMMANDS`, who, why, and for shelving until when (epoch, s)."""

    event: Event
    who: str
    why: str = ""
    until: float | None = None


@dataclass(frozen=True)
class AlarmState:
    """All that an alarm remembers; a plain dictionary and back.

    Parameters
    ----------
    asset, alarm
        Whose alarm it is, and its name.
    at
        Time of the last step (epoch, s).
    state, since
        Where it is in the life-cycle, and since when (epoch, s).
    condition, condition_since, cause
        What was observed last, before the delays, since when (epoch, s), and what was said of it.
    active
        Whether the condition is abnormal behind the delays, whatever the state.
    latched
        Whether it occurred and has not been reset since; latching alarms only.
    suppressed
        Whether its design suppresses it now.
    shelved_until
        When shelving expires (epoch, s).
    sequence
        Number of transitions so far.
    """

    asset: str
    alarm: str
    at: float
    since: float
    condition_since: float
    state: State = State.NORMAL
    condition: Condition = "unknown"
    cause: str = ""
    active: bool = False
    latched: bool = False
    suppressed: bool = False
    shelved_until: float | None = None
    sequence: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {"version": VERSION, **asdict(self), "state": self.state.value}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> AlarmState:
        """Return the state that `to_dict` wrote.

        Raises
        ------
        StateError
            If it is of another version, or is not whole.
        """
        values = whole(plain, cls, VERSION, "alarm state")
        try:
            return cls(**{**values, "state": State(values["state"])})
        except ValueError:
            raise StateError(f"alarm state {values['state']!r} is unknown: restore it from a copy") from None


@dataclass(frozen=True)
class Transition:
    """One line of an alarm's history.

    Parameters
    ----------
    time
        When (epoch, s).
    asset, alarm, sequence
        Of which alarm, and which of its transitions, from 1.
    before, after, event
        What became of what, by which event of the life-cycle.
    cause, who
        Why, in words; and by whom, ``system`` where nobody commanded it.
    """

    time: float
    asset: str
    alarm: str
    sequence: int
    before: State
    after: State
    event: Event
    cause: str
    who: str

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {**asdict(self), "before": self.before.value, "after": self.after.value, "event": self.event.value}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Transition:
        """Return the transition that `to_dict` wrote."""
        states = {name: State(plain[name]) for name in ("before", "after")}
        return cls(**{**plain, **states, "event": Event(plain["event"])})

    @property
    def is_new(self) -> bool:
        """Whether an operator has to be told of an alarm."""
        return self.after is State.UNACKNOWLEDGED and self.before is not State.UNACKNOWLEDGED
