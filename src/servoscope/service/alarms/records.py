"""What is remembered of an alarm, its transitions, and the commands of operators."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Self

from pydantic import TypeAdapter, ValidationError

from servoscope.core.errors import StateError
from servoscope.service.alarms.conditions import Condition
from servoscope.service.alarms.state_table import LifecycleEvent, LifecycleState


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
        found: Self = _adapter(cls).validate_python(plain)  # type: ignore[arg-type]
        return found


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
        if set(plain) != {each.name for each in fields(cls)} | {"version"}:  # type: ignore[arg-type]
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
