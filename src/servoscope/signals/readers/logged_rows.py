"""The rows of a recording as they come from a file, piece by piece, and what they become: samples, or a recording."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.core import outofcore
from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.messages import message
from servoscope.core.outofcore import GrowableArray
from servoscope.models.loop import Loop
from servoscope.signals import Defect, Recording, clean, with_defects
from servoscope.signals.readers.table import Table
from servoscope.signals.resample import ResampleTarget
from servoscope.signals.samples import Samples
from servoscope.signals.time_axis import build_time_axis

MIN_EPOCH_S, MAX_EPOCH_S = 3e8, 5e9  # a time stamp between them counts from 1970: from 1979 to 2128


class LoggedRows:
    """The rows of one recording, as they come: time if the file has it, r, u, y, runs if there are some, channels."""

    def __init__(
        self,
        name: str,
        timed: bool,
        row_rate: float | None,
        channels: tuple[str, ...],
        loop: Loop | None,
        labels: tuple[str, str, str],
        target: ResampleTarget | None,
    ) -> None:
        self.name, self._has_time, self._channels = name, timed, channels
        self._loop, self._labels, self._row_rate = loop, labels, row_rate or (loop.sample_rate if loop else None)
        self._target = target if timed or row_rate else None
        self._columns: list[GrowableArray] = []
        self._broken: list[tuple[int, float, int, str]] = []
        self._rows = 0

    def add(self, table: Table, values: list[npt.NDArray[Any]], rows: BoolArray) -> None:
        """Take some rows of a piece."""
        for before, number, text in table.broken:
            index = min(max(before - 1, 0), rows.size - 1)
            if rows[index]:
                at = float(values[0][index]) if self._has_time else float("nan")
                self._broken.append((self._rows + int(rows[:index].sum()), at, number, text))
        self._columns = self._columns or [GrowableArray() for _ in values]
        for column, x in zip(self._columns, values, strict=True):
            column.append(x if rows.all() else x[rows])
        self._rows += int(rows.sum())

    @property
    def _rate(self) -> float | None:
        return self._loop.sample_rate if self._loop is not None else None

    def split_columns(self) -> tuple[list[FloatArray], FloatArray | None, dict[str, FloatArray]]:
        """Return t, r, u and y; the runs, if there are some; the channels."""
        columns = [column.to_array() for column in self._columns]
        if not self._has_time:
            columns.insert(0, _uniform_time(self._rows, self._row_rate or 1.0))
        covariates = dict(zip(self._channels, columns[len(columns) - len(self._channels) :], strict=True))
        signals, runs = columns[:4], columns[4 : len(columns) - len(self._channels)]
        return signals, runs[0] if runs else None, covariates

    def samples(self) -> Samples:
        """Return the rows in the order of time, and resampled where that is asked for; nothing else is done to them.

        Raises RecordingError if their time stamps are unusable, or their rate is not the loop's.
        """
        if self._target is not None:
            return self._clean(*self.split_columns())
        (t, *signals), run, channels = self.split_columns()
        axis = build_time_axis(t, run, self._rate, self.name, signals=signals)
        r, u, y = map(axis.reorder, signals)
        others = {name: axis.reorder(channel) for name, channel in channels.items()}
        return Samples.from_columns(axis.t, r, u, y, np.diff(axis.run, prepend=0) > 0, others)

    def dated_recording(self, log: Log) -> Recording:
        """Return the rows cleaned; time stamps that are seconds since 1970 count from the first of them."""
        (t, *signals), run, covariates = self.split_columns()
        began = log.origin
        if not began and t.size and MIN_EPOCH_S < t[0] < MAX_EPOCH_S:
            began = float(np.floor(t[0]))
            t = t if t.flags.writeable else t.copy()
            for rows in outofcore.iter_chunks(0, t.size, t):
                t[rows] -= began
        recording = self._clean([t, *signals], run, covariates)
        return replace(recording, began=began, zone="UTC" if log.is_utc else "") if began else recording

    def _clean(self, signals: list[FloatArray], run: FloatArray | None, covariates: dict[str, FloatArray]) -> Recording:
        notes = [self._note(*torn, signals[0]) for torn in self._broken]
        recording = clean(
            *signals,
            name=self.name,
            sample_rate=self._rate,
            run=run,
            limits=None if self._loop is None else self._loop.input_limits,
            labels=self._labels,
            channels=covariates,
            target=self._target,
        )
        if not self._has_time:
            text = message("defect.no_time", rate=self._row_rate)
            notes.append(Defect("clock", float(recording.t[0]), float(recording.t[-1]), recording.samples, text))
        return with_defects(recording, *notes)

    def _note(self, row: int, at: float, number: int, text: str, t: FloatArray) -> Defect:
        at = at if self._has_time else float(t[row])
        shown = text if len(text) <= 30 else f"{text[:27]}..."
        return Defect("text", at, at, 1, message("defect.torn", row=number, text=shown))


@dataclass(frozen=True, eq=False)
class Log:
    """What a file holds."""

    parts: dict[str, LoggedRows]  # by what their column says, in the order of appearance; without one, all under ""
    origin: float  # what makes seconds since 1970 of their time stamps, where dates are known [s]
    is_utc: bool = True  # whether they are UTC then


def _uniform_time(rows: int, rate: float) -> FloatArray:
    t = outofcore.empty((rows,))
    for piece in outofcore.iter_chunks(0, rows, t):
        t[piece] = np.arange(piece.start, piece.stop) / rate
    return t
