"""What of a block can be used: samples in the order of time, and where one does not follow its predecessor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from servoscope.plants import FloatArray
from servoscope.recording.clock import GAP, LATE, SAME

__all__ = ["Arrival", "arrive"]

BoolArray = npt.NDArray[np.bool_]


class Arrival(NamedTuple):
    """Which samples of a block count, and which of these begin anew, both (N,); the time of the last one [UTC s]."""

    used: BoolArray
    restart: BoolArray
    t: float


def arrive(t: FloatArray, before: float, period: float) -> Arrival:
    """Sort out a block by its time stamps.

    A sample that repeats the time of one before it, or comes late, is left out; after a gap of more than 1.5 sample
    times, or when the clock was set back, the next one begins anew. Nothing is sorted: what came before is processed.

    Parameters
    ----------
    t
        Time stamps [UTC s], shape (N,).
    before
        Time of the last sample before the block; NaN: there was none.
    period
        Sample time [s].
    """
    steps = np.diff(t, prepend=before)
    if ((steps > SAME * period) & (steps <= GAP * period)).all():
        return Arrival(np.ones(t.size, dtype=np.bool_), np.zeros(t.size, dtype=np.bool_), float(t[-1]))
    used, restart, last = np.zeros(t.size, dtype=np.bool_), np.zeros(t.size, dtype=np.bool_), before
    for i, now in enumerate(t.tolist()):
        if not np.isfinite(now) or -LATE * period < now - last <= SAME * period:
            continue
        used[i], restart[i] = True, not 0.0 < now - last <= GAP * period
        last = now
    return Arrival(used, restart, float(last))
