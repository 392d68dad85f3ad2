"""Alarms against the truth: events, their rate, delays of detection and misses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.scoring.intervals import Measured, share


def events(alarm: BoolArray, on_delay: int = 0) -> npt.NDArray[np.int64]:
    """Return the samples at which an alarm is raised: once per excursion, however long it lasts.

    Parameters
    ----------
    alarm
        Whether the detector is above its limit, shape (N,), for example ``statistic > limit``. Before the first
        sample it is taken to be below.
    on_delay
        Samples that it must have been above before the alarm is raised; shorter excursions do not count.

    Returns
    -------
    numpy.ndarray
        Indices, shape (E,).
    """
    edges = np.diff(np.concatenate([[False], alarm, [False]]).astype(np.int8))
    start, end = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return np.asarray(start[end - start > on_delay] + on_delay)


def alarm_rate(count: int, exposure: float, confidence: float = 0.95) -> Measured:
    """Return events per unit of exposure with the exact interval for a Poisson count (Garwood, 1936).

    Parameters
    ----------
    count
        Number of events.
    exposure
        What they were counted over, positive: hours give a rate per hour.
    confidence
        Of the interval. It is exact for events that come independently; bursts make the truth wider.
    """
    from scipy.special import chdtri  # upper quantile of the chi-square

    beyond = (1.0 - confidence) / 2.0
    low = chdtri(2 * count, 1.0 - beyond) / 2.0 if count else 0.0
    high = chdtri(2 * count + 2, beyond) / 2.0
    return Measured(count / exposure, float(low) / exposure, float(high) / exposure)


@dataclass(frozen=True, eq=False)
class Detections:
    """What a detector made of some runs with one true onset each.

    Parameters
    ----------
    delays
        From onset to the first alarm at or after it, in units of the times, shape (runs,); inf: missed.
    false_alarms
        Alarms before the onset, shape (runs,).
    """

    delays: FloatArray
    false_alarms: npt.NDArray[np.int64]

    @property
    def missed(self) -> Measured:
        """Share of runs without an alarm in time, with Wilson's interval."""
        return share(int(np.isinf(self.delays).sum()), self.delays.size)

    @property
    def median(self) -> float:
        """Median delay of all runs; inf where half of them are missed."""
        return self.quantile(0.5)

    def quantile(self, q: float) -> float:
        """Return the smallest delay within which a share q of *all* runs was detected; inf where fewer were.

        Leaving out the misses would make a detector look quicker the more it misses.
        """
        return float(np.quantile(self.delays, q, method="inverted_cdf"))


def detections(alarms: Sequence[npt.ArrayLike], onsets: npt.ArrayLike, within: float = np.inf) -> Detections:
    """Compare the alarms of some runs with the onset of the change in each.

    Parameters
    ----------
    alarms
        Per run the times at which an alarm was raised, see `events`; any number.
    onsets
        True onsets, one per run or one for all, in the same unit.
    within
        A detection later than this after the onset counts as a miss.
    """
    onset = np.broadcast_to(np.asarray(onsets, dtype=np.float64), (len(alarms),))
    times = [np.sort(np.asarray(alarm, dtype=np.float64)) for alarm in alarms]
    before = np.array([np.searchsorted(t, at) for t, at in zip(times, onset, strict=True)], dtype=np.int64)
    first = np.array([t[i] if i < t.size else np.inf for t, i in zip(times, before, strict=True)])
    delays = first - onset
    return Detections(np.where(delays <= within, delays, np.inf), before)
