"""Values of several nodes, each told when it changes, put on one clock by the time stamps of their source."""

from __future__ import annotations

import heapq
import math
from typing import NamedTuple

import numpy as np

from servoscope.plants import FloatArray

__all__ = ["SET_BACK_S", "Aligned", "Aligner", "Gap"]

MOST = 100_000  # samples of constant values that are believed at once
SET_BACK_S = 10.0  # a value that is older than the last sample by more tells that the clock was set back


class Gap(NamedTuple):
    """A stretch of which nothing is known: from the last sample to the next one [UTC s], and samples missing."""

    begins: float
    ends: float
    samples: int


class Aligned(NamedTuple):
    """Samples that are complete: time stamps [UTC s], shape (N,), and values, shape (signals, N); gaps before them."""

    t: FloatArray
    values: FloatArray
    gaps: list[Gap]


class Aligner:
    """Makes samples of single values.

    A value holds until the next one: a source tells only changes. What lies between two changes is filled as long as
    the source is known to live; after `cut` it is not, and the next sample begins anew.

    Parameters
    ----------
    signals
        How many there are.
    period
        Sample time [s].
    last
        Time of the last sample that is known already [UTC s]; NaN: none.
    """

    def __init__(self, signals: int, period: float, last: float = math.nan) -> None:
        self._period, self._held = period, np.full(signals, math.nan)
        self._known = np.zeros(signals, dtype=np.bool_)
        self._pending: list[tuple[float, int, int, float]] = []  # a heap: time, order, signal, value
        self._order = 0
        self._newest = -math.inf
        self._cut, self._begin = True, math.inf
        self._found: list[tuple[float, FloatArray]] = []
        self._gaps: list[Gap] = []
        self.last = last  # time of the last sample that was made
        self.late = 0  # values that came after their sample had been made

    def cut(self, begin: float, *, complete: bool = False) -> None:
        """Take note that the source is heard anew, from `begin` on; older values tell what holds, and make no samples.

        Unless all changes of the time between are known, what was held before is worth nothing any more.
        """
        self._cut, self._begin = True, begin
        if not complete:
            self._known[:] = False
            self._pending.clear()
            self._newest = -math.inf

    def add(self, signal: int, t: float, value: float) -> None:
        """Take a value; NaN where its status says that it is bad."""
        self._order += 1
        self._newest = max(self._newest, t)
        heapq.heappush(self._pending, (t, self._order, signal, value))

    def take(self, alive: float) -> Aligned:
        """Return the samples that are complete: those older than the newest value, and all up to `alive` [UTC s].

        A source tells changes in their order. Where none comes any more, it has to be known otherwise that it lives,
        and that whatever has changed up to `alive` was told.
        """
        half = 0.5 * self._period
        settled = max(alive, self._newest)
        while self._pending and self._pending[0][0] + half <= settled:
            at, group = self._pending[0][0], dict[int, float]()
            while self._pending and self._pending[0][0] < at + half:
                _, _, signal, value = heapq.heappop(self._pending)
                group[signal] = value
            self._group(at, group)
        if self._cut and self._known.all() and self._begin + 2.0 * self._period <= alive:
            self._sample(self._begin)  # nothing has changed since then
        if not self._cut and alive - self.last < MOST * self._period:
            while self.last + 2.0 * self._period <= alive:
                self._sample(self.last + self._period)
        if not self._pending:
            self._newest = -math.inf
        found, self._found = self._found, []
        gaps, self._gaps = self._gaps, []
        t = np.array([at for at, _ in found])
        return Aligned(t, np.array([held for _, held in found]).reshape(-1, self._held.size).T, gaps)

    def _group(self, at: float, group: dict[int, float]) -> None:
        """Take values of one moment."""
        if at < self.last - SET_BACK_S and not (self._cut and at < self._begin):
            self.cut(at, complete=True)
            self.last = math.nan
        behind = at <= self.last + 0.5 * self._period
        if behind and not self._cut:
            self.late += len(group)
        fresh = not behind and not (self._cut and at < self._begin)
        steps = round((at - self.last) / self._period) if fresh and not self._cut else 1
        if steps > MOST:
            self.cut(at, complete=True)  # a clock that was set, or a source that was not cut off in time
        elif steps > 1:
            for moment in np.linspace(self.last, at, steps + 1)[1:-1].tolist():
                self._sample(moment)
        for signal, value in group.items():
            self._held[signal], self._known[signal] = value, True
        if fresh and self._known.all():
            self._sample(at)

    def _sample(self, at: float) -> None:
        missing = round((at - self.last) / self._period) - 1 if self._cut and not math.isnan(self.last) else 0
        if missing > 0:
            self._gaps.append(Gap(self.last, at, missing))
        self._found.append((at, self._held.copy()))
        self.last, self._cut = at, False
