"""What is measured and how it is shown: scenarios with permanent ids, and the tables that they make."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

Numbers = dict[str, Any]
"""What one unit of work found: plain numbers, lists and dicts, ready for JSON."""
Row = tuple[str, ...]


@dataclass(frozen=True)
class Scenario:
    """One thing to measure, by units of work that know nothing of each other.

    Parameters
    ----------
    id
        Permanent; also the name of its file of results.
    words
        What it is, in the first column of its table.
    units
        Units of work of the full study; their seeds are 0 to units - 1.
    job
        Top-level function ``job(seed, *arguments)``, so that it can run in another process.
    arguments
        After the seed.
    rows
        Turns ``words`` and what the units found into rows of the table.
    """

    id: str
    words: str
    units: int
    job: Callable[..., Numbers]
    arguments: tuple[Any, ...]
    rows: Callable[[str, Sequence[Numbers]], list[Row]]

    def run(self, seed: int) -> Numbers:
        """Do one unit of work."""
        return self.job(seed, *self.arguments)


@dataclass(frozen=True)
class Table:
    """The place of some scenarios in ``RESULTS.md``: between the markers of its key."""

    key: str
    columns: Row
    scenarios: tuple[Scenario, ...]
