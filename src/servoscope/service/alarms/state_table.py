"""The alarm life-cycle after ISA-18.2 / IEC 62682 as a table: what each event does in each state."""

from __future__ import annotations

from enum import StrEnum
from typing import Literal, NamedTuple


class LifecycleState(StrEnum):
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


class LifecycleEvent(StrEnum):
    """What can happen to an alarm: by its condition, its design, its clock, or by an operator's command."""

    OCCUR = "occur"
    CLEAR = "clear"
    CLEAR_LATCHED = "clear_latched"
    SUPPRESS = "suppress"
    UNSUPPRESS = "unsuppress"
    EXPIRE = "expire"
    # commands of operators from here on
    ACKNOWLEDGE = "acknowledge"
    RESET = "reset"
    SHELVE = "shelve"
    UNSHELVE = "unshelve"
    REMOVE = "remove_from_service"
    RESTORE = "return_to_service"


COMMANDS = tuple(LifecycleEvent)[
    tuple(LifecycleEvent).index(LifecycleEvent.ACKNOWLEDGE) :
]  # what operators may do; the rest happens by itself

ReleaseCondition = Literal["suppressed", "abnormal", "latched", "normal"]


class ReleaseTargets(NamedTuple):
    """The state of an alarm that is released, by its condition then; the first that applies, in this order."""

    suppressed: LifecycleState
    abnormal: LifecycleState
    latched: LifecycleState
    normal: LifecycleState


A, B, C, D, E, F, G, H, I = LifecycleState

# What operators did not see while it was shelved is announced, acknowledged before or not.
RELEASE_TARGETS = ReleaseTargets(suppressed=H, abnormal=B, latched=E, normal=A)

TRANSITION_TABLE: dict[tuple[LifecycleState, LifecycleEvent], LifecycleState | ReleaseTargets] = {
    (A, LifecycleEvent.OCCUR): B,
    (B, LifecycleEvent.CLEAR): D,
    (C, LifecycleEvent.CLEAR): A,
    (B, LifecycleEvent.CLEAR_LATCHED): E,
    (C, LifecycleEvent.CLEAR_LATCHED): F,
    (D, LifecycleEvent.OCCUR): B,
    (E, LifecycleEvent.OCCUR): B,
    (F, LifecycleEvent.OCCUR): B,
    (B, LifecycleEvent.ACKNOWLEDGE): C,
    (D, LifecycleEvent.ACKNOWLEDGE): A,
    (E, LifecycleEvent.ACKNOWLEDGE): F,
    # A latch that nobody has acknowledged cannot be reset, as in OPC UA Part 9.
    (F, LifecycleEvent.RESET): A,
    # Shelved, suppressed or out of service, an alarm still follows its condition, in history only.
    **{(state, event): state for state in (G, H, I) for event in tuple(LifecycleEvent)[:3]},
    **{(state, LifecycleEvent.SHELVE): G for state in (A, B, C, D, E, F, G, H)},
    (G, LifecycleEvent.UNSHELVE): RELEASE_TARGETS,
    (G, LifecycleEvent.EXPIRE): RELEASE_TARGETS,
    **{(state, LifecycleEvent.SUPPRESS): H for state in (A, B, C, D, E, F)},
    # What an operator has shelved or taken out of service stays so: the design matters again on its release.
    **{(state, event): state for state in (G, I) for event in (LifecycleEvent.SUPPRESS, LifecycleEvent.UNSUPPRESS)},
    (H, LifecycleEvent.UNSUPPRESS): RELEASE_TARGETS,
    **{(state, LifecycleEvent.REMOVE): I for state in (A, B, C, D, E, F, G, H)},
    (I, LifecycleEvent.RESTORE): RELEASE_TARGETS,
}

UNACKNOWLEDGED_STATES = (B, D, E)  # states that wait for an operator
LATCHED_STATES = (E, F)


def next_state(state: LifecycleState, event: LifecycleEvent, condition: ReleaseCondition) -> LifecycleState | None:
    """Return the state after an event, None where it has no meaning; `condition` matters for a release only."""
    to = TRANSITION_TABLE.get((state, event))
    return getattr(to, condition) if isinstance(to, ReleaseTargets) else to
