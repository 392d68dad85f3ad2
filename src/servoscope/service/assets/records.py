"""Rows on their way to the store, and what they are made of."""

from __future__ import annotations

from typing import Any, NamedTuple

from servoscope.service.alarms import AlarmDefinition, AlarmTransition

# tables of what the samples and the state before them lead to, whenever and however often that is computed
REPEATABLE_TABLES = frozenset({"recent", "residuals", "sizes"})


class TableRow(NamedTuple):
    """A row for the store: its table and its values."""

    table: str
    values: dict[str, Any]


class BlockRefusal(NamedTuple):
    """Why a block was left out: in a word, and in a sentence."""

    kind: str
    why: str


class StepResult(NamedTuple):
    """What a step of an asset leads to: rows for the store, and those of them of which operators may be notified."""

    rows: list[TableRow]
    transitions: list[AlarmTransition]
    refusal: BlockRefusal | None = None  # why the block was left out, if it was
    repeatable: bool = False  # whether the block leads from the state before it to that after it, and to nothing else


def audit_row(event: str, document: dict[str, Any], user: str = "servoscope") -> TableRow:
    """Return a line of the audit: who did what."""
    return TableRow("audit", {"who": user, "what": event, "document": document})


def transition_row(one: AlarmTransition, definition: AlarmDefinition) -> dict[str, Any]:
    """Return a transition as the store keeps it, without its number."""
    plain = one.to_dict()
    columns = {key: plain[key] for key in ("alarm", "before", "after", "cause", "who")}
    return {"t": one.time, **columns, "document": {"event": plain["event"], "priority": definition.priority}}
