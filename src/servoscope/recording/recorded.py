"""What a recording is: columns of equal length on one clock, and what was wrong with them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.errors import RecordingError
from servoscope.recording.defects import Defect

__all__ = ["Recording", "with_defects"]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Recording:
    """r, u and y of one asset over a time span, on one clock; made by `clean`.

    Parameters
    ----------
    name
        What it is called in reports, for example the file's name.
    t
        Time [s], shape (N,), rising. Where the file's time restarts with a new run, runs are laid end to end.
    r, u, y
        Reference, control input, measured output as logged (SI units), shape (N,).
    sample_rate
        Sample rate [Hz].
    restart
        True where a row does not follow its predecessor by one sample: first row, new run, after a gap;
        shape (N,).
    run
        Index of the run, from 0, shape (N,).
    defects
        What was wrong, in the order of time.
    """

    name: str
    t: FloatArray
    r: FloatArray
    u: FloatArray
    y: FloatArray
    sample_rate: float
    restart: BoolArray
    run: IntArray
    defects: tuple[Defect, ...] = ()

    @property
    def samples(self) -> int:
        """Number of rows N."""
        return int(self.t.size)

    @property
    def duration_s(self) -> float:
        """From the first row to one sample after the last [s], gaps included."""
        return float(self.t[-1] - self.t[0]) + 1.0 / self.sample_rate

    @property
    def columns(self) -> tuple[npt.NDArray[Any], ...]:
        """All that has one value per row."""
        return self.t, self.r, self.u, self.y, self.restart, self.run

    def rows(self, rows: slice) -> Recording:
        """Return some rows as they stand here, without defects; nothing is copied."""
        t, r, u, y, restart, run = (column[rows] for column in self.columns)
        return replace(self, t=t, r=r, u=u, y=y, restart=restart, run=run, defects=())

    def part(self, from_s: float, to_s: float) -> Recording:
        """Return the rows with from_s <= t < to_s and the defects that overlap them.

        Raises
        ------
        RecordingError
            If there are none.
        """
        first, end = np.searchsorted(self.t, [from_s, to_s])
        if first >= end:
            span = f"{self.t[0]:g} to {self.t[-1]:g} s"
            raise RecordingError(f"{self.name}: nothing from {from_s:g} to {to_s:g} s, it spans {span}")
        found = self.rows(slice(first, end))
        restart = found.restart.copy()
        restart[0] = True
        defects = tuple(d for d in self.defects if d.to_s >= from_s and d.from_s < to_s)
        return replace(found, restart=restart, run=found.run - found.run[0], defects=defects)


def with_defects(recording: Recording, *more: Defect) -> Recording:
    """Return the recording with further defects, all in the order of time."""
    return replace(recording, defects=tuple(sorted((*recording.defects, *more), key=lambda defect: defect.from_s)))
