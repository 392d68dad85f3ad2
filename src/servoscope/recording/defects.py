"""What was wrong with a recording, event by event, in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["Defect", "listed", "shortened", "spans", "together"]

MOST_LISTED = 100  # events of one kind that are told one by one


@dataclass(frozen=True)
class Defect:
    """One thing that was wrong with a recording, and what was done about it.

    Parameters
    ----------
    kind
        ``nan``, ``spike``, ``repeat``, ``order``, ``gap``, ``jitter``, ``clock``, ``saturation`` or ``text``.
    from_s, to_s
        When, on the recording's clock [s].
    count
        Number of rows concerned; of a gap, the number of rows that are missing.
    message
        One line for the user.
    """

    kind: str
    from_s: float
    to_s: float
    count: int
    message: str


def spans(mask: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return first index and index after the last of each stretch in which the mask, shape (N,), is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(start), int(stop)) for start, stop in edges.reshape(-1, 2)]


def together(rows: npt.NDArray[np.intp]) -> list[npt.NDArray[np.intp]]:
    """Return rows, in order, cut into stretches that follow each other."""
    return np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if rows.size else []


def listed(kind: str, rows: npt.NDArray[np.intp], t: npt.NDArray[np.float64], words: str) -> list[Defect]:
    """Return one defect per stretch of rows, which are in order, at the times t [s], shape (N,).

    ``{s}`` in the words becomes an s where a stretch has several rows.
    """
    notes = []
    for stretch in together(rows):
        start, end, count = float(t[stretch[0]]), float(t[stretch[-1]]), stretch.size
        when = f"at {start:g} s" if count == 1 else f"from {start:g} to {end:g} s"
        message = f"{words.replace('{s}', 's' * (count > 1))} ({when})"
        notes.append(Defect(kind, start, end, count, message))
    return shortened(notes)


def shortened(notes: list[Defect]) -> list[Defect]:
    """Return the defects, of one kind, with those past the first hundred summed up in the last."""
    if len(notes) <= MOST_LISTED:
        return notes
    rest = notes[MOST_LISTED - 1 :]
    count = sum(note.count for note in rest)
    message = f"{len(rest)} more like the one before, {count} rows, until {rest[-1].to_s:g} s"
    return [*notes[: MOST_LISTED - 1], Defect(rest[0].kind, rest[0].from_s, rest[-1].to_s, count, message)]
