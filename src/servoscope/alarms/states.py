"""The alarm life-cycle after ISA-18.2 / IEC 62682 as a table: what each event does in each state."""

from __future__ import annotations

from enum import StrEnum
from typing import Literal, NamedTuple

__all__ = ["COMMANDS", "LATCHED", "TABLE", "WAITING", "Event", "Found", "Release", "State", "after"]


class State(StrEnum):
    """The states of an alarm; the standards' letters are in their order, A to I."""

    NORMAL = "normal"
    UNACKNOWLEDGED = "unacknowledged"
    ACKNOWLEDGED = "acknowledged"
    RETURNED = "returned_unacknowledged"
    LATCHED_UNACKNOWLEDGED = "latched_unacknowledged"
    LATCHED_ACKNOWLEDGED = "latched_acknowledged"
    SHELVED = "shelved"
    SUPPRESSED = "suppressed_by_design"
    OUT_OF_SERVICE = "out_of_service"


class Event(StrEnum):
    """What can happen to an alarm: its condition, its design, its clock, or somebody's command."""

    OCCUR = "occur"
    CLEAR = "clear"
    CLEAR_LATCHED = "clear_latched"
    SUPPRESS = "suppress"
    UNSUPPRESS = "unsuppress"
    EXPIRE = "expire"
    ACKNOWLEDGE = "acknowledge"
    RESET = "reset"
    SHELVE = "shelve"
    UNSHELVE = "unshelve"
    REMOVE = "remove_from_service"
    RESTORE = "return_to_service"


COMMANDS = (
    Event.ACKNOWLEDGE,
    Event.RESET,
    Event.SHELVE,
    Event.UNSHELVE,
    Event.REMOVE,
    Event.RESTORE,
)  # what people may do; the rest happens by itself

Found = Literal["suppressed", "abnormal", "latched", "normal"]


class Release(NamedTuple):
    """Where an alarm goes that is released, by what is found then; the first that applies, in this order."""

    suppressed: State
    abnormal: State
    latched: State
    normal: State


A, B, C, D, E, F, G, H, I = State

# What was not seen while it was put away is announced, acknowledged before or not: the release is news.
RELEASED = Release(suppressed=H, abnormal=B, latched=E, normal=A)

TABLE: dict[tuple[State, Event], State | Release] = {
    (A, Event.OCCUR): B,
    (B, Event.CLEAR): D,
    (C, Event.CLEAR): A,
    (B, Event.CLEAR_LATCHED): E,
    (C, Event.CLEAR_LATCHED): F,
    (D, Event.OCCUR): B,
    (E, Event.OCCUR): B,
    (F, Event.OCCUR): B,
    (B, Event.ACKNOWLEDGE): C,
    (D, Event.ACKNOWLEDGE): A,
    (E, Event.ACKNOWLEDGE): F,
    # A latch that nobody has acknowledged cannot be reset, as in OPC UA Part 9.
    (F, Event.RESET): A,
    # Put away, an alarm goes on following its condition, and history says so; nothing is announced.
    **{(put, event): put for put in (G, H, I) for event in (Event.OCCUR, Event.CLEAR, Event.CLEAR_LATCHED)},
    **{(state, Event.SHELVE): G for state in (A, B, C, D, E, F, G, H)},
    (G, Event.UNSHELVE): RELEASED,
    (G, Event.EXPIRE): RELEASED,
    **{(state, Event.SUPPRESS): H for state in (A, B, C, D, E, F)},
    # What an operator has put away stays where it is: the design speaks again when it is released.
    **{(put, event): put for put in (G, I) for event in (Event.SUPPRESS, Event.UNSUPPRESS)},
    (H, Event.UNSUPPRESS): RELEASED,
    **{(state, Event.REMOVE): I for state in (A, B, C, D, E, F, G, H)},
    (I, Event.RESTORE): RELEASED,
}

WAITING = (B, D, E)  # states that wait for an operator
LATCHED = (E, F)


def after(state: State, event: Event, found: Found) -> State | None:
    """Return the state behind an event; None where the event has no meaning there.

    Parameters
    ----------
    state, event
        The row of the table.
    found
        What a release finds; without meaning elsewhere.
    """
    to = TABLE.get((state, event))
    return getattr(to, found) if isinstance(to, Release) else to
