"""What a baseline that was learned anew after a repair cannot yet show, by how few recordings it has."""

from __future__ import annotations

from typing import NamedTuple

from servoscope.baseline.baseline import Baseline
from servoscope.learning.detectability import forecast_changes

MAX_FURTHER = 10  # recordings that are asked for
COARSE_RATIO = 0.5  # of a smallest detectable change, to which these recordings lower it


class CoarseMonitoring(NamedTuple):
    """The fault whose smallest detectable change further recordings lower most: relative, now and then."""

    fault: str
    now: float
    later: float
    recordings: int  # how many healthy recordings more that takes


def coarse_monitoring(baseline: Baseline) -> CoarseMonitoring | None:
    """Return what a baseline that was learned anew lacks; None where it lacks nothing that counts."""
    for further in range(1, MAX_FURTHER + 1):
        changes = forecast_changes(baseline, further)
        fault = min(changes, key=lambda name: changes[name][1] / changes[name][0], default=None)
        if fault is not None and changes[fault][1] < COARSE_RATIO * changes[fault][0]:
            return CoarseMonitoring(fault, *changes[fault], further)
    return None
