"""What to check on the machine: for each fault what its loop file says, or its plant."""

from __future__ import annotations

from collections.abc import Iterator

from servoscope.core.messages import Message, catalogue, message, text_message
from servoscope.diagnosis.result import FaultInterval
from servoscope.models.loop import Loop

MIN_PROBABILITY_CHECKED = 0.05  # probability from which an explanation is worth a look where none is certain


def what_to_check(loop: Loop, interval: FaultInterval | None) -> tuple[Message, ...]:
    """Return what to check for the faults of an interval, the likeliest first; nothing without an interval."""
    if interval is None:
        return ()
    return tuple(check for name in suspects(interval) for check in checks_of_fault(loop, name))


def suspects(interval: FaultInterval) -> tuple[str, ...]:
    """Return the names of the faults to look for: those that are named, else those that are likely."""
    likely = [candidate for candidate in interval.candidates if candidate.probability >= MIN_PROBABILITY_CHECKED]
    names = [fault.name for fault in interval.faults] or [name for candidate in likely for name in candidate.names]
    return tuple(dict.fromkeys(names))


def checks_of_fault(loop: Loop, name: str) -> Iterator[Message]:
    """Yield what to check for one fault; nothing where nobody has said it."""
    checks = next((fault.checks for fault in loop.plant.all_faults if fault.name == name), "")
    if name in (loop.checks or {}):
        yield from map(text_message, (loop.checks or {})[name])
    elif checks:
        yield message("diagnosis.check", checks=checks)
    elif f"check.{name}" in catalogue():
        yield message(f"check.{name}")
