"""What the rows of a store hold, as far as more than the query that reads them has to know it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from servoscope.core.messages import message, render
from servoscope.prognosis.series import NORMAL_95

if TYPE_CHECKING:
    import sqlalchemy as sa

Row = Mapping[str, Any]  # of any table
CHECKS = "checks"  # in the audit: what to check on an asset for a fault, in its owner's words
NOTE = "note"  # in the audit: what somebody noted about an asset
BASELINE_NOTE = "baseline"  # kind of the note that a baseline was put in force
CONFIRMATION = "confirmed"  # kind of the note that what has changed after a repair is no fault
RELEARN = "relearn"  # command: take the baseline that an asset has now
BEGUN = "begun"  # in a command's document: when a service began to execute it [UTC s]
TEST = "test"  # command: try a webhook, command, message or mail, whose name is in the place of an alarm's
SIZE_EVERY_S = 600.0  # between two stored values of a coefficient
# how the outcome of a refused command begins in rows of version 0.1, which have no fields for it
REFUSAL_PREFIX = "refused: "


class CommandOutcome(NamedTuple):
    """What became of a command: accepted, or refused for a reason."""

    accepted: bool
    refusal: str = ""

    @property
    def text(self) -> str:
        """What people read."""
        return render(
            message("service.command_done" if self.accepted else "service.command_refused", reason=self.refusal)
        )

    def extend(self, document: Row) -> Row:
        """Return a command's document with the outcome."""
        refusal = {} if self.accepted else {"refusal": self.refusal}
        return {**document, "accepted": self.accepted, **refusal}

    @classmethod
    def from_row(cls, outcome: str, document: Row) -> CommandOutcome:
        """Return the outcome that a row of the commands holds."""
        if "accepted" in document:
            return cls(document["accepted"], document.get("refusal", ""))
        return cls(not outcome.startswith(REFUSAL_PREFIX), outcome.removeprefix(REFUSAL_PREFIX))


class RefusedRow(NamedTuple):
    """A row that the database has refused for what it holds."""

    table: str
    asset: str
    row: dict[str, str]  # its values, in short
    why: str

    @classmethod
    def of(cls, table: sa.Table, row: Row, why: str) -> RefusedRow:
        """Return what names a row of a table."""
        return cls(str(table.name), str(row.get("asset", "")), {name: ascii(row[name])[:100] for name in row}, why)


def fault_rows(t: float, kind: str, faults: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of faults as a diagnosis names them, found at `t` [UTC s]."""
    sizes = ((fault["name"], fault["ratio"], *fault["interval"], 1.0) for fault in faults)
    return [_size_row(t, kind, *values) for values in sizes]


def coefficient_rows(t: float, parameters: Iterable[tuple[str, float, float, float]]) -> list[dict[str, Any]]:
    """Return the rows of coefficients, each with name, value, standard deviation and healthy value, at `t` [UTC s]."""
    return [
        _size_row(t, "coefficient", name, value, value - NORMAL_95 * std, value + NORMAL_95 * std, healthy)
        for name, value, std, healthy in parameters
    ]


def _size_row(t: float, *values: str | float) -> dict[str, Any]:
    return {"t": t, **dict(zip(("kind", "name", "value", "low", "high", "healthy"), values, strict=True))}


def period_number(t: float | None) -> int | None:
    """Return in which period of `SIZE_EVERY_S` a time [UTC s] lies: of each, the first values are stored."""
    return None if t is None else int(t // SIZE_EVERY_S)
