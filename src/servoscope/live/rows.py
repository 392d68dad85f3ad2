"""Rows on their way to the store, and what they are made of."""

from __future__ import annotations

from typing import Any, NamedTuple

from servoscope.alarms import AlarmDefinition, Transition

__all__ = ["Outcome", "Row", "transition_row"]


class Row(NamedTuple):
    """A row for the store: its table and its values."""

    table: str
    values: dict[str, Any]


class Outcome(NamedTuple):
    """What something led to: rows for the store, and those of them that operators may have to be told."""

    rows: list[Row]
    transitions: list[Transition]


def transition_row(one: Transition, definition: AlarmDefinition) -> dict[str, Any]:
    """Return a transition as the store keeps it, without its number."""
    plain = one.to_dict()
    kept = {key: plain[key] for key in ("alarm", "before", "after", "cause", "who")}
    return {"t": one.time, **kept, "document": {"event": plain["event"], "priority": definition.priority}}
