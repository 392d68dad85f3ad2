"""A flood of alarms across a fleet: recognised, lower priorities held and counted, all of them told at its end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal

from servoscope.alarms.definitions import PRIORITIES, FloodSettings, Priority
from servoscope.alarms.life import Transition
from servoscope.alarms.states import State
from servoscope.errors import StateError

__all__ = ["FloodState", "Held", "Notice", "announce", "pass_time"]

VERSION = 1


@dataclass(frozen=True)
class Held:
    """A new alarm that a flood has kept from being announced: which, since when (epoch, s), and how often."""

    asset: str
    alarm: str
    priority: Priority
    time: float
    count: int


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
        New alarms since it began, and the most within one period.
    held
        Those that wait for its end, and have not been answered since.
    """

    recent: tuple[float, ...] = ()
    since: float | None = None
    counted: int = 0
    peak: int = 0
    held: tuple[Held, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {"version": VERSION, **asdict(self), "recent": list(self.recent), "held": [asdict(h) for h in self.held]}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> FloodState:
        """Return the state that `to_dict` wrote; StateError if it is of another version, or not whole."""
        if plain.get("version") != VERSION or set(plain) != {each.name for each in fields(cls)} | {"version"}:
            raise StateError(
                f"flood state of version {plain.get('version')!r}, or not whole: this servoscope reads {VERSION}; "
                "remove it to begin anew"
            )
        values = {key: value for key, value in plain.items() if key != "version"}
        held = tuple(Held(**one) for one in plain["held"])
        return cls(**{**values, "recent": tuple(plain["recent"]), "held": held})


@dataclass(frozen=True)
class Notice:
    """What an operator is to be told.

    Parameters
    ----------
    kind
        ``alarm``: one that is new, `transition`; ``held``: one that a flood has kept back, told at its end;
        ``flood_begins`` and ``flood_ends``.
    time
        When (epoch, s).
    transition
        Of ``alarm``.
    held
        Of ``held``; of ``flood_ends`` all of them.
    counted, peak
        Of ``flood_begins`` and ``flood_ends``: new alarms in the flood, and the most within one period.
    """

    kind: Literal["alarm", "held", "flood_begins", "flood_ends"]
    time: float
    transition: Transition | None = None
    held: tuple[Held, ...] = ()
    counted: int = 0
    peak: int = 0


def announce(
    settings: FloodSettings, state: FloodState, transition: Transition, priority: Priority
) -> tuple[FloodState, tuple[Notice, ...]]:
    """Take one transition of any asset's alarm, in the order of time, and say what an operator is told.

    Parameters
    ----------
    settings
        When there is a flood.
    state
        ``FloodState()`` at first.
    transition
        Each of them, new alarm or not: a held one that is answered or cleared drops out.
    priority
        Of its alarm.
    """
    state, notices = pass_time(settings, state, transition.time)
    key = (transition.asset, transition.alarm)
    if not transition.is_new:
        if transition.after is not State.RETURNED:  # an alarm that came and went still has to be told
            state = replace(state, held=tuple(one for one in state.held if (one.asset, one.alarm) != key))
        return state, notices
    recent = (*state.recent, transition.time)
    counted = state.counted + 1 if state.since is not None else len(recent)
    state = replace(state, recent=recent, counted=counted, peak=max(state.peak, len(recent)))
    if state.since is None and len(recent) > settings.limit:
        state = replace(state, since=transition.time)
        notices += (Notice("flood_begins", transition.time, counted=counted, peak=state.peak),)
    if state.since is None or PRIORITIES.index(priority) >= PRIORITIES.index(settings.announced_from):
        return state, (*notices, Notice("alarm", transition.time, transition))
    return replace(state, held=_with(state.held, transition, priority)), notices


def pass_time(settings: FloodSettings, state: FloodState, time: float) -> tuple[FloodState, tuple[Notice, ...]]:
    """Let time pass: a flood ends when few enough alarms are new, and what it held is told."""
    recent = tuple(one for one in state.recent if time - settings.period_s < one <= time)
    if state.since is None:
        return replace(state, recent=recent, counted=0, peak=0), ()
    if len(recent) >= settings.ends_below:
        return replace(state, recent=recent), ()
    end = Notice("flood_ends", time, held=state.held, counted=state.counted, peak=state.peak)
    told = (Notice("held", time, held=(one,)) for one in state.held)
    return FloodState(recent), (end, *told)


def _with(held: tuple[Held, ...], transition: Transition, priority: Priority) -> tuple[Held, ...]:
    same = [one for one in held if (one.asset, one.alarm) == (transition.asset, transition.alarm)]
    if same:
        return tuple(replace(one, count=one.count + 1) if one is same[0] else one for one in held)
    return (*held, Held(transition.asset, transition.alarm, priority, transition.time, 1))
