"""Living with a fault: a bounded change of a gain or a set-point, recommended, or executed through a sink."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from servoscope.actions.outbox import Outgoing, key_of
from servoscope.actions.settings import ToleranceSettings
from servoscope.alarms.saved import whole

__all__ = ["Change", "ToleranceState", "begin", "respond"]

VERSION = 1
HOUR = 3600.0  # s
WORTH = 0.05  # of max_step: smaller changes are noise of the estimate


@dataclass(frozen=True)
class ToleranceState:
    """What is remembered of one quantity of one asset.

    Parameters
    ----------
    value
        As it was asked for last; nominal at first.
    changed
        When it was asked to change, within the last hour (epoch, s).
    sequence
        Number of changes so far.
    """

    value: float
    changed: tuple[float, ...] = ()
    sequence: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {"version": VERSION, **asdict(self), "changed": list(self.changed)}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> ToleranceState:
        """Return the state that `to_dict` wrote; StateError if it is of another version, or not whole."""
        values = whole(plain, cls, VERSION, "tolerance state")
        return cls(**{**values, "changed": tuple(values["changed"])})


@dataclass(frozen=True)
class Change:
    """A change that was recommended or asked for; for the audit.

    Parameters
    ----------
    time, asset, action, sequence
        When (epoch, s), where, by which table `[actions.tolerance.NAME]`, and which of its changes.
    quantity, kind
        What is changed.
    previous, value, target
        From, to, and where it would go without limits.
    executed
        Whether it was sent to a sink, or only recommended.
    reason
        What calls for it, and which limit holds it back.
    """

    time: float
    asset: str
    action: str
    sequence: int
    quantity: str
    kind: str
    previous: float
    value: float
    target: float
    executed: bool
    reason: str

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return asdict(self)


def begin(settings: ToleranceSettings) -> ToleranceState:
    """Return the state before the first change."""
    return ToleranceState(settings.nominal)


def respond(
    name: str,
    settings: ToleranceSettings,
    state: ToleranceState,
    asset: str,
    ratio: float | None,
    time: float,
    now: float,
) -> tuple[ToleranceState, Change | None, Outgoing | None]:
    """Say what to change now: at most one bounded step towards what the fault calls for.

    Call it when the asset's fault alarm occurs and each time that its diagnosis is renewed, and with None when the
    alarm is normal again, which leads back to nominal.

    Parameters
    ----------
    name, settings
        A table `[actions.tolerance.NAME]`.
    state
        As returned by `begin` or an earlier call.
    asset
        Where.
    ratio
        Size of the fault, if it is the one of the settings and alone in the diagnosis; None: it is not there.
    time
        Of the diagnosis or transition (epoch, s).
    now
        Time (epoch, s), of the clock that `deliver` is given.

    Returns
    -------
    ToleranceState, Change or None, Outgoing or None
        The new state; what to record, None where there is nothing to change or it is not allowed now; and the row
        for the outbox, in mode ``execute`` only.
    """
    target = settings.nominal if ratio is None else settings.target(ratio)
    bounded = min(max(target, settings.min), settings.max)
    step = min(max(bounded - state.value, -settings.max_step), settings.max_step)
    changed = tuple(one for one in state.changed if time - HOUR < one)  # one from the future counts: the clock was set
    if settings.mode == "off" or not abs(step) > WORTH * settings.max_step or len(changed) >= settings.per_hour:
        return state, None, None
    value = bounded if step == bounded - state.value else state.value + step
    limits = [f"bounds {settings.min:g} to {settings.max:g}"] if bounded != target else []
    limits += [f"max_step {settings.max_step:g}"] if value != bounded else []
    cause = f"{settings.fault} over" if ratio is None else f"{settings.fault} at {ratio:.4g} of healthy"
    change = Change(
        time=time,
        asset=asset,
        action=name,
        sequence=state.sequence + 1,
        quantity=settings.quantity,
        kind=settings.kind,
        previous=state.value,
        value=value,
        target=target,
        executed=settings.mode == "execute",
        reason=", held back by ".join([cause, *([" and ".join(limits)] if limits else [])]),
    )
    row = None
    if change.executed and settings.sink is not None:
        key = key_of(name, asset, change.sequence, repr(time))
        row = Outgoing(key, settings.sink, {"key": key, "event": "change", **change.to_dict()}, now, now)
    return ToleranceState(value, (*changed, time), change.sequence), change, row
