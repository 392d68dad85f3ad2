"""What comes of a block: whether it is the next one, what is missing before it, and rows on their way to the store."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from servoscope.service.alarms import AlarmDefinition, AlarmTransition
from servoscope.service.assets.checkpoint import AssetState, StreamPosition
from servoscope.service.assets.examination import StoredDiagnosis, undetermined
from servoscope.service.assets.examination_schedule import PendingDiagnosis
from servoscope.service.sources.block import Block
from servoscope.service.store.rows import fault_rows

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
    repeatable: bool = (
        False  # whether blocks, or time alone, lead from the state before it to that after it, and to nothing else
    )


def audit_row(event: str, document: dict[str, Any], user: str = "servoscope") -> TableRow:
    """Return a line of the audit: who did what."""
    return TableRow("audit", {"who": user, "what": event, "document": document})


def transition_row(transition: AlarmTransition, definition: AlarmDefinition) -> dict[str, Any]:
    """Return a transition as the store keeps it, without its number."""
    plain = transition.to_dict()
    columns = {key: plain[key] for key in ("alarm", "before", "after", "cause", "who")}
    return {"t": transition.time, **columns, "document": {"event": plain["event"], "priority": definition.priority}}


def diagnosis_row(window: PendingDiagnosis, diagnosis: StoredDiagnosis, baseline: str) -> TableRow:
    """Return the row of a full diagnosis by the baseline of this hash, under the number that was kept for it."""
    values = {"number": window.number, "t": window.until, "grounds": window.why, **diagnosis.columns(baseline)}
    return TableRow("diagnoses", values)


def diagnosed_rows(window: PendingDiagnosis, diagnosis: StoredDiagnosis, baseline: str) -> list[TableRow]:
    """Return the row of a full diagnosis, and those of the sizes that it has found."""
    named = fault_rows(window.until, "full", diagnosis.document.get("faults", []))
    return [diagnosis_row(window, diagnosis, baseline), *(TableRow("sizes", row) for row in named)]


def owed_rows(before: AssetState | None) -> list[TableRow]:
    """Return the rows of full diagnoses that a state waits for, and that another state in its place does not make.

    Their numbers would be lacking in the history.
    """
    if before is None:
        return []
    return [diagnosis_row(window, undetermined("renewed"), before.baseline) for window in before.pending_diagnoses]


class BlockContinuity(NamedTuple):
    """How many blocks are missing before a new one, and whether it belongs to another stream."""

    lost: int
    anew: bool

    @property
    def is_broken(self) -> bool:
        """Whether the block does not follow what was counted."""
        return self.lost > 0 or self.anew

    def audit_row(self, counted: StreamPosition, block: Block) -> TableRow:
        """Return the line of the audit for a block that does not follow what was counted."""
        streams = {"after": [counted.stream, counted.sequence], "before": [block.stream, block.sequence]}
        return audit_row("blocks lost" if self.lost else "stream began anew", {"blocks": self.lost, **streams})


class NextBlock(NamedTuple):
    """A block that is to be followed, and how it follows what was counted."""

    block: Block
    continuity: BlockContinuity = BlockContinuity(0, anew=False)
    packed: tuple[bytes, bool] | None = None  # its samples, if `pack_samples` has packed them


def check_continuity(counted: StreamPosition | None, block: Block, latest: float = math.inf) -> BlockContinuity | None:
    """Return how a block follows what was counted; None: it was counted before, or its place has passed.

    Numbers of a named stream begin at 0, and a later stream has a greater name. A stream without a name is accepted
    from any number on; where its numbers fall back while its time goes on, its sender has restarted. `latest`: the
    last time that can be true [UTC s].
    """
    if counted is None:
        return BlockContinuity(block.sequence if block.stream else 0, False)
    if block.stream == counted.stream and block.sequence > counted.sequence:
        return BlockContinuity(block.sequence - counted.sequence - 1, False)
    if counted.t > latest:  # it was counted by a clock that was wrong: whatever comes now begins anew behind it
        return BlockContinuity(0, True)
    if block.stream > counted.stream:
        return BlockContinuity(block.sequence, True)
    if not block.retained and block.t[0] > counted.t:
        return BlockContinuity(0, True)
    return None
