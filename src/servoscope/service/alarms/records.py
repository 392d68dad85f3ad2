"""The states of an alarm and what leads from one to another; what is remembered of it, and what operators command."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Any, ClassVar, Literal, NamedTuple, Self

from pydantic import TypeAdapter, ValidationError

from servoscope.core.errors import StateError
from servoscope.service.alarms.conditions import Condition


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


@functools.cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


class JsonRecord:
    """Base of dataclasses that are written as JSON."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return dict(_adapter(type(self)).dump_python(self, mode="json"))  # type: ignore[arg-type]  # a class is hashable

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Self:
        """Return the record that `to_dict` wrote."""
        record: Self = _adapter(cls).validate_python(plain)  # type: ignore[arg-type]
        return record


class PersistentState(JsonRecord):
    """Base of states that the store keeps, with the version of what their fields mean."""

    VERSION: ClassVar[int] = 1
    saved_as: ClassVar[str]  # what messages call it

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {"version": self.VERSION, **super().to_dict()}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Self:
        """Return the state that `to_dict` wrote; raises StateError if it is of another version, or not whole."""
        what, version = cls.saved_as, plain.get("version")
        if version != cls.VERSION:
            raise StateError(
                f"{what} of version {version!r}, this servoscope reads {cls.VERSION}: use that which wrote it"
            )
        if set(plain) != {field.name for field in fields(cls)} | {"version"}:  # type: ignore[arg-type]
            raise StateError(f"{what} is not whole: restore it from a copy, or remove it to begin anew")
        try:
            return super().from_dict({key: value for key, value in plain.items() if key != "version"})
        except ValidationError as error:
            unknown = error.errors()[0]["input"]
            raise StateError(f"{what}: {unknown!r} is unknown: restore it from a copy") from None


@dataclass(frozen=True)
class OperatorCommand:
    """What an operator asks for: one of `COMMANDS`, and for shelving until when (epoch, s)."""

    event: LifecycleEvent
    user: str
    reason: str = ""
    until: float | None = None


@dataclass(frozen=True)
class AlarmState(PersistentState):
    """All that is remembered of an alarm; times are (epoch, s)."""

    saved_as: ClassVar[str] = "alarm state"

    asset: str
    alarm: str
    at: float  # time of the last step
    since: float  # since when it is in its state
    condition_since: float
    state: LifecycleState = LifecycleState.NORMAL
    # condition, condition_since, cause: what was observed last, before the delays, since when, and as what
    condition: Condition = "unknown"
    cause: str = ""
    active: bool = False  # whether the condition is abnormal behind the delays, whatever the state
    latched: bool = False  # whether it occurred and has not been reset since; latching alarms only
    suppressed: bool = False  # whether its design suppresses it now
    shelved_until: float | None = None  # when shelving expires
    sequence: int = 0  # number of transitions so far


@dataclass(frozen=True)
class AlarmTransition(JsonRecord):
    """One line of an alarm's history."""

    time: float  # (epoch, s)
    asset: str
    alarm: str
    sequence: int  # which of the alarm's transitions, from 1
    before: LifecycleState
    after: LifecycleState
    event: LifecycleEvent
    cause: str  # in words
    who: str  # who commanded it; ``system``: nobody

    @property
    def is_new(self) -> bool:
        """Whether an operator has to be told of an alarm."""
        return self.after is LifecycleState.UNACKNOWLEDGED and self.before is not LifecycleState.UNACKNOWLEDGED
