"""A file whose columns are known and whose rows are read piece by piece."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from servoscope.errors import RecordingError
from servoscope.readers.tables import Table

__all__ = ["Opened"]


@dataclass(frozen=True, eq=False)
class Opened:
    """A file whose columns are known and whose rows are not read yet.

    Parameters
    ----------
    path
        The file.
    columns
        Names of its columns.
    read
        Takes names of columns, and names of those among them that are text even where they look like numbers; returns
        the rows piece by piece.
    others
        Variables that exist but are not channels: name -> why not.
    together
        Which columns can be read at once; empty: all of them.
    """

    path: Path
    columns: tuple[str, ...]
    read: Callable[[Sequence[str], Collection[str]], Iterator[Table]]
    others: dict[str, str] = field(default_factory=dict)
    together: tuple[tuple[str, ...], ...] = ()

    @property
    def name(self) -> str:
        """What errors call the file."""
        return self.path.name

    def pieces(self, wanted: Collection[str], texts: Collection[str] = ()) -> Iterator[Table]:
        """Yield the rows piece by piece, of the columns that are wanted; `texts` among them are text in any case.

        Raises
        ------
        RecordingError
            If the file is damaged or has no rows.
        """
        rows = 0
        for table in self.read([name for name in self.columns if name in wanted], texts):
            rows += table.rows
            if table.rows:
                yield table
        if not rows:
            raise RecordingError(f"{self.path}: holds no rows")
