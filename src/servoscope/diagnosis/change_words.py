"""The change of a fault in one clause: what has risen or fallen, and by how much, for the first line of every view."""

from __future__ import annotations

from collections.abc import Sequence

from servoscope.core.messages import Message, catalogue, message
from servoscope.core.verdict import Verdict
from servoscope.diagnosis.result import FaultInterval
from servoscope.isolation.candidate import UNKNOWN, FaultEstimate

FRACTIONS = {0.1: "tenth", 0.2: "fifth", 0.25: "quarter", 1.0 / 3.0: "third", 0.5: "half"}
MAX_FRACTION_ERROR = 0.05  # of a change that is called by a fraction, relative to the fraction
MIN_FACTOR = 2.5  # ratio from which a change is a multiple of the healthy value, not a percentage more than it


INVERSE = frozenset({"motor_constant"})  # faults whose parameter is u per force, and whose quantity is force per u
MIN_LEFT_SHARE = 0.1  # of a change that was repaired, from which on something is said to be left of it
MIN_LIKELY_PROBABILITY = 0.5  # of an explanation of a suspect recording that is worth telling
MAX_ONE_IN = 1e6  # recordings: no model is believed further


def suspect_headline(interval: FaultInterval, said: Message, point: str) -> Message:
    """Return what to do with a recording that is unlike healthy ones, but not yet a fault, and its likeliest cause."""
    at = message("diagnosis.point", name=point) if point else None
    if (change := said.values.get("change")) is not None:
        return message("diagnosis.suspect", point=at, likely=message("diagnosis.suspect_change", change=change))
    best = interval.candidates[0]
    known = best.name != UNKNOWN and best.probability >= MIN_LIKELY_PROBABILITY
    names = tuple(map(fault_label, best.names))
    likely = message("diagnosis.suspect_likely", names=names, probability=best.probability) if known else None
    return message("diagnosis.suspect", point=at, likely=likely)


def how_sure(verdict: Verdict) -> Message:
    """Return how many healthy recordings would look like this: by the number of those left out, and by the model."""
    one_in = min(1.0 / verdict.by_model, MAX_ONE_IN) if verdict.by_model else MAX_ONE_IN
    return message("diagnosis.how_sure", guaranteed=verdict.recordings + 1, model=float(f"{one_in:.1g}"))


def change_messages(faults: Sequence[FaultEstimate]) -> tuple[Message, ...]:
    """Return a clause for each fault: ``leakage has risen by a fifth``.

    A size whose 95 % interval holds 1 has no direction: the clause says that it is not known.
    """
    return tuple(map(_change_message, faults))


def relative_changes(faults: Sequence[FaultEstimate]) -> tuple[Message, ...]:
    """Return how far each fault is from healthy: ``friction +5 %``."""
    sizes = ((quantity_name(fault), 100.0 * (_of_quantity(fault).ratio - 1.0)) for fault in faults)
    return tuple(message("change.relative", name=name, percent=percent) for name, percent in sizes)


def after_repair(before: Sequence[FaultEstimate], now: FaultEstimate | None) -> Message:
    """Return what is left of faults that were repaired, of a machine that is healthy; `now`: its size, if known."""
    if now is None or [now.name] != [fault.name for fault in before]:
        return message("service.examination.as_before", sizes=None)
    changes, share = relative_changes((now,)), (now.ratio - 1.0) / (before[0].ratio - 1.0)
    if not now.may_be_healthy and share > MIN_LEFT_SHARE:
        return message("service.examination.not_quite", changes=changes)
    return message("service.examination.as_before", sizes=message("service.examination.scatter", changes=changes))


def fault_label(name: str) -> str:
    """Return the name of a fault as every view shows it."""
    return name.replace("_", " ")


def quantity_label(name: str) -> Message | str:
    """Return the quantity that rises or falls with the fault of this name."""
    return message(f"quantity.{name}") if f"quantity.{name}" in catalogue() else fault_label(name)


def quantity_name(fault: FaultEstimate) -> Message | str:
    """Return the quantity that rises or falls with a fault."""
    if f"quantity.{fault.name}" in catalogue():
        return quantity_label(fault.name)
    kind, of, joint = fault.name.partition(" of ")
    if of:
        return message("quantity.of_joint", kind=kind, joint=joint)
    if fault.name == fault.parameter:
        return fault_label(fault.name)
    return message("quantity.other", name=fault_label(fault.name), parameter=fault.parameter)


def _of_quantity(fault: FaultEstimate) -> FaultEstimate:
    """Return a fault with the ratio of its quantity, which may be the inverse of its parameter."""
    if fault.name not in INVERSE:
        return fault
    low, high = fault.interval
    return fault.model_copy(update={"ratio": 1.0 / fault.ratio, "interval": (1.0 / high, 1.0 / low)})


def _change_message(fault: FaultEstimate) -> Message:
    fault = _of_quantity(fault)
    name, (low, high) = quantity_name(fault), fault.interval
    if fault.mass_kg is not None and not fault.mass_kg[1] <= 0.0 <= fault.mass_kg[2]:
        return message("change.mass", name=name, mass=fault.mass_kg[0])
    if low <= 1.0 <= high:
        return message("change.unsure", name=name)
    if fault.ratio >= MIN_FACTOR:
        return message("change.multiple", name=name, ratio=fault.ratio)
    key = "change.risen" if fault.ratio > 1.0 else "change.fallen"
    return message(key, name=name, amount=_amount(abs(fault.ratio - 1.0)))


def _amount(change: float) -> Message:
    fraction = min(FRACTIONS, key=lambda value: abs(change / value - 1.0))
    if abs(change / fraction - 1.0) <= MAX_FRACTION_ERROR:
        return message(f"fraction.{FRACTIONS[fraction]}")
    return message("fraction.percent", percent=100.0 * change)
