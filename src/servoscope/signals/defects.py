"""What was wrong with a recording, event by event."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from servoscope.core.messages import Message, message, render

MAX_DEFECTS = 100  # events of one kind that are listed one by one


@dataclass(frozen=True)
class Defect:
    """One thing that was wrong with a recording, and what was done about it."""

    kind: str  # ``nan``, ``spike``, ``repeat``, ``order``, ``gap``, ``jitter``, ``clock``, ``saturation``,
    # ``resampled`` or ``text``
    from_s: float  # from_s, to_s: when, on the recording's clock [s]
    to_s: float
    count: int  # number of rows concerned; of a gap, the number of rows that are missing
    text: Message

    @property
    def message(self) -> str:
        """One line for the user."""
        return render(self.text)


def mask_edges(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.intp]:
    """Return first index and index after the last of each stretch in which the mask, shape (N,), is true: (M, 2)."""
    return np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8))).reshape(-1, 2)


def mask_spans(mask: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the same as pairs of numbers."""
    return [(int(start), int(stop)) for start, stop in mask_edges(mask)]


def split_consecutive(rows: npt.NDArray[np.intp]) -> list[npt.NDArray[np.intp]]:
    """Return rows, in order, cut into stretches that follow each other."""
    return np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if rows.size else []


def defects_at(kind: str, rows: npt.NDArray[np.intp], t: npt.NDArray[np.float64], **values: object) -> list[Defect]:
    """Return one defect per stretch of rows, which are in order, at the times t [s], shape (N,)."""
    defects = []
    for stretch in split_consecutive(rows):
        start, end, count = float(t[stretch[0]]), float(t[stretch[-1]]), stretch.size
        text = message(f"defect.{kind}.{'one' if count == 1 else 'many'}", from_s=start, to_s=end, **values)
        defects.append(Defect(kind, start, end, count, text))
    return limit_defects(defects)


def limit_defects(defects: list[Defect]) -> list[Defect]:
    """Return the defects, of one kind, with those past the first hundred summed up in the last."""
    if len(defects) <= MAX_DEFECTS:
        return defects
    surplus = defects[MAX_DEFECTS - 1 :]
    count, end = sum(defect.count for defect in surplus), surplus[-1].to_s
    text = message("defect.more", events=len(surplus), rows=count, to_s=end)
    return [*defects[: MAX_DEFECTS - 1], Defect(surplus[0].kind, surplus[0].from_s, end, count, text)]
