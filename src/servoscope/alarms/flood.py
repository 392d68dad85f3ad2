"""A flood of alarms across a fleet: recognised, lower priorities held and counted, all of them told at its end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from servoscope.alarms.definitions import PRIORITIES, FloodSettings, Priority
from servoscope.alarms.records import Transition
from servoscope.alarms.saved import whole
from servoscope.alarms.states import WAITING

__all__ = ["FloodState", "Held", "Notice", "announce", "pass_time"]

VERSION = 1


@dataclass(frozen=True)
class Held:
    """An alarm that a flood keeps from being announced: its latest transition, and how often it was new meanwhile."""

    transition: Transition
    priority: Priority
    count: int

    @property
    def whose(self) -> tuple[str, str]:
        """Asset and alarm."""
        return self.transition.asset, self.transition.alarm


@dataclass(frozen=True)
class FloodState:
    """What is remembered of a fleet's new alarms.

    Parameters
    ----------
    recent
        When they occurred (epoch, s), as far as they count.
    since
        Beginning of the flood (epoch, s); None: there is none.
    counted, peak
        New alarms in it so far, and the most within one period.
    held
        Those that wait for its end.
    """

    recent: tuple[float, ...] = ()
    since: float | None = None
    counted: int = 0
    peak: int = 0
    held: tuple[Held, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        held = [{**asdict(one), "transition": one.transition.to_dict()} for one in self.held]
        return {"version": VERSION, **asdict(self), "recent": list(self.recent), "held": held}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> FloodState:
        """Return the state that `to_dict` wrote.

        Raises
        ------
        StateError
            If it is of another version, or is not whole.
        """
        values = whole(plain, cls, VERSION, "flood state")
        held = tuple(Held(**{**one, "transition": Transition.from_dict(one["transition"])}) for one in plain["held"])
        return cls(**{**values, "recent": tuple(plain["recent"]), "held": held})


@dataclass(frozen=True)
class Notice:
    """What an operator is to be told.

    Parameters
    ----------
    kind
        ``alarm``: one that is new; ``change``: another transition; ``held``: the latest transition of one that a flood
        has kept back, at its end; ``flood_begins`` and ``flood_ends``.
    time
        When (epoch, s).
    transition, priority
        Of the first three kinds.
    counted
        How often a held alarm was new; new alarms in the flood.
    peak
        Of a flood: the most new alarms within one period.
    """

    kind: Literal["alarm", "change", "held", "flood_begins", "flood_ends"]
    time: float
    transition: Transition | None = None
    priority: Priority | None = None
    counted: int = 1
    peak: int = 0


def announce(
    settings: FloodSettings, state: FloodState, transition: Transition, priority: Priority
) -> tuple[FloodState, tuple[Notice, ...]]:
    """Take one transition of any asset's alarm, about in the order of time, and say what operators are told.

    Parameters
    ----------
    settings
        When there is a flood.
    state
        ``FloodState()`` at first.
    transition
        Each of them, new alarm or not.
    priority
        Of its alarm.
    """
    state, notices = pass_time(settings, state, transition.time)
    if transition.is_new:
        recent = (*state.recent, transition.time)
        counted = len(recent) if state.since is None else state.counted + 1
        state = replace(state, recent=recent, counted=counted, peak=max(state.peak, len(recent)))
        if state.since is None and len(recent) > settings.limit:
            state = replace(state, since=transition.time)
            notices += (Notice("flood_begins", transition.time, counted=counted, peak=state.peak),)
    told: Literal["alarm", "change"] = "alarm" if transition.is_new else "change"
    whose = (transition.asset, transition.alarm)
    before = next((one for one in state.held if one.whose == whose), None)
    low = PRIORITIES.index(priority) < PRIORITIES.index(settings.announced_from)
    if state.since is not None and low and (transition.is_new or (before and transition.after in WAITING)):
        count = (before.count if before else 0) + transition.is_new
        held = Held(transition, priority, count)
        others = (held if one is before else one for one in state.held)
        return replace(state, held=(*others, *([] if before else [held]))), notices
    # Somebody has dealt with a held alarm, or it is high now: no need to tell it later.
    state = replace(state, held=tuple(one for one in state.held if one is not before))
    return state, (*notices, Notice(told, transition.time, transition, priority))


def pass_time(settings: FloodSettings, state: FloodState, time: float) -> tuple[FloodState, tuple[Notice, ...]]:
    """Let time pass: a flood ends when few enough alarms are new, and what it held is told.

    Parameters
    ----------
    settings, state
        As for `announce`.
    time
        Now (epoch, s).
    """
    # Assets tell their transitions one after the other: what is a little ahead counts, a clock that was set does not.
    recent = tuple(one for one in state.recent if abs(time - one) < settings.period_s)
    if state.since is None:
        return replace(state, recent=recent, counted=0, peak=0), ()
    if len(recent) >= settings.ends_below:
        return replace(state, recent=recent), ()
    end = Notice("flood_ends", time, counted=state.counted, peak=state.peak)
    told = (Notice("held", time, one.transition, one.priority, one.count) for one in state.held)
    return FloodState(recent), (end, *told)
