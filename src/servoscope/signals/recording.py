"""What a recording is: columns of equal length on one clock, and what was wrong with them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from servoscope.core import outofcore
from servoscope.core.arrays import Int32Array
from servoscope.core.errors import RecordingError
from servoscope.core.short_repr import ShortRepr
from servoscope.signals.defects import Defect
from servoscope.signals.samples import Samples

MAX_STRETCHES = 8  # that stand for a long recording


def frame_of(name: str, data: Any) -> Any:
    """Return a frame of pandas for what has a name; raises RecordingError if pandas is not installed."""
    try:
        import pandas as pd
    except ModuleNotFoundError:
        raise RecordingError(f"{name}: a frame needs pandas, pip install pandas") from None
    return pd.DataFrame(data)


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Recording(ShortRepr, Samples):
    """Samples of one asset on one rising clock, of at least 20 rows, as `clean` makes them.

    Where the time in the file starts again with a new run, the runs are laid end to end.

    Examples
    --------
    >>> ss.read("friday.csv", "loop.toml").part(0.0, 10.0).samples
    2000
    """

    name: str  # what it is called in reports, for example the file's name
    sample_rate: float  # sample rate [Hz]
    run: Int32Array  # index of the run, from 0, shape (N,)
    defects: tuple[Defect, ...] = ()  # what was wrong with the rows as logged, in the order of time
    began: float | None = None  # when t was 0, by the log's own clock [s since 1970]; None where it has no dates
    zone: str = ""  # of `began`: UTC; empty where dates are local, and nobody says where

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
        """All that has one value per row, channels aside: t, r, u, y, restart, run."""
        return *super().columns, self.run

    def _shown_facts(self) -> dict[str, object]:
        return {
            "name": self.name,
            "length": f"{self.duration_s:.6g} s",
            "samples": self.samples,
            "rate": f"{self.sample_rate:g} Hz",
            "defects": len(self.defects),
        }

    def to_frame(self) -> Any:
        """Return a frame of pandas with the columns t, r, u, y, run and the channels, one row per sample.

        Raises RecordingError if pandas is not installed.
        """
        columns = {"t": self.t, "r": self.r, "u": self.u, "y": self.y, "run": self.run, **self.channels}
        return frame_of(self.name, columns)

    def __getitem__(self, rows: slice | npt.NDArray[Any]) -> Self:
        """Return some of the rows without the defects; a slice copies nothing."""
        return replace(super().__getitem__(rows), run=self.run[rows], defects=())

    def rows(self, rows: slice) -> Self:
        """Return some of the rows without the defects; nothing is copied."""
        return self[rows]

    def part(self, from_s: float, to_s: float) -> Recording:
        """Return the rows with from_s <= t < to_s and the defects that overlap them.

        Raises RecordingError if there are none.
        """
        first, end = np.searchsorted(self.t, [from_s, to_s])
        if first >= end:
            span = f"{self.t[0]:g} to {self.t[-1]:g} s"
            raise RecordingError(f"{self.name}: nothing from {from_s:g} to {to_s:g} s, it spans {span}")
        part = self[first:end]
        restart = part.restart.copy()
        restart[0] = True
        defects = tuple(d for d in self.defects if d.to_s >= from_s and d.from_s < to_s)
        return replace(part, restart=restart, run=part.run - part.run[0], defects=defects)


def thin_out(recording: Recording, rows: int, shortest: int) -> Recording:
    """Return stretches of a recording, evenly spread over it and of at least the shortest length, of so many rows."""
    count = min(max(rows // max(shortest, 1), 1), MAX_STRETCHES)
    length = rows // count
    starts = np.linspace(0, recording.samples - length, count).astype(np.intp)
    part = recording[(starts[:, None] + np.arange(length)).ravel()]
    part.restart[::length] = True
    outofcore.release(*recording.columns)
    return part


def with_defects(recording: Recording, *added: Defect) -> Recording:
    """Return the recording with further defects, all in the order of time."""
    return replace(recording, defects=tuple(sorted((*recording.defects, *added), key=lambda defect: defect.from_s)))
