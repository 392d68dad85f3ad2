"""How often the values of a signal come: as the server has promised, and as their time stamps show."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

STEPS = 60  # updates from which an interval is measured
FAST_SHARE = 0.1  # of the steps: as short as these a signal's updates may follow each other
MIN_STEPS = 10  # steps that tell whether a server's word holds
FASTER_SHARE = 0.75  # of the interval that a server has stated: steps as short as that are faster
MAX_PERIODS = 1.5  # sample times: a longer interval leaves out samples
ONE_STEP = 1.5  # times the smallest change: a signal that never changes by more is slow itself, and not its updates


class UpdateRate:
    """Measures the updates of one signal over the last `STEPS` of them, by the time stamps of their source."""

    def __init__(self) -> None:
        self._t, self._values = deque[float](maxlen=STEPS + 1), deque[float](maxlen=STEPS + 1)

    def add(self, t: float, value: float) -> None:
        """Take a value with its time [UTC s]."""
        if math.isfinite(value) and not (self._t and t <= self._t[-1]):
            self._t.append(t)
            self._values.append(value)

    @property
    def interval_s(self) -> float:
        """Time between two updates where they follow each other closely [s]; NaN: too few have come."""
        if len(self._t) <= STEPS:
            return math.nan
        return float(np.quantile(np.diff(self._t), FAST_SHARE))

    def contradicts(self, interval_s: float) -> bool | None:
        """Whether values come faster than a server says it looks for them [s]; None: too few have come to tell.

        Some servers do not look, but are told of each change, and say the time between their messages instead.
        """
        steps = np.diff(self._t)
        return None if steps.size < MIN_STEPS else bool(np.median(steps) < FASTER_SHARE * interval_s)

    def is_too_slow(self, period: float) -> bool:
        """Whether samples of a signal that changes in between are left out; `period`: the sample time [s].

        A coarse signal that creeps is told rarely too; but it changes by one step of its sensor at a time.
        """
        if not self.interval_s > MAX_PERIODS * period:
            return False
        changes = np.abs(np.diff(self._values))
        changes = changes[changes > 0.0]
        return bool(changes.size and changes.max() > ONE_STEP * changes.min())
