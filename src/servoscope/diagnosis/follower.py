"""Follows the samples of one asset block by block: what the service, the engines of a fleet and Spark have in common.

A follower is the monitor with the delay of its alarm, and the rule for when an alarm is diagnosed in full: the refit
needs samples from before the alarm and from after it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import FloatArray, IndexArray
from servoscope.detection.statistic import consecutive_exceedances
from servoscope.detection.trace import Trace
from servoscope.diagnosis.monitor import Monitor
from servoscope.signals.samples import Samples

State = TypeVar("State", bound="FollowerState")


@dataclass(frozen=True, eq=False, kw_only=True)
class FollowerState:
    """What a follower needs to go on; records of whole assets extend it."""

    monitor: FloatArray  # state of the monitor, shape (size,)
    samples: int = 0  # that the monitor has processed
    exceeding: int = 0  # the number of evaluations above a limit, without interruption until now


class Evaluations(NamedTuple):
    """The evaluations of a block: what the monitor found, and at which of the block's samples, shape (K,)."""

    trace: Trace
    sample: IndexArray
    alarms: IndexArray  # those in alarm, after the on-delay


class Follower:
    """Follows assets of one baseline; `monitor`: one of this baseline that is there already."""

    def __init__(self, baseline: Baseline, monitor: Monitor | None = None) -> None:
        self.baseline = baseline
        self.monitor = monitor if monitor is not None else Monitor(baseline)
        self._on_delay = self.monitor.pipeline.delays[0]

    def init(self) -> FloatArray:
        """Return the state of the monitor before the first sample."""
        return self.monitor.init()

    def follow(self, state: State, samples: Samples) -> tuple[State, Evaluations]:
        """Process a block of samples, in the order of time; the old state stays valid."""
        s = samples
        monitor, trace = self.monitor.run(state.monitor, s.r, s.u, s.y, s.restart, channels=s.channels)
        return self.judge(state, monitor, trace, len(samples))

    def judge(self, state: State, monitor: FloatArray, trace: Trace, samples: int) -> tuple[State, Evaluations]:
        """Return what `follow` returns, of what the monitor has made of so many samples."""
        index = np.rint(trace.t * self.baseline.loop.sample_rate).astype(np.int64) - state.samples
        exceeding = consecutive_exceedances(trace.exceeded, state.exceeding)
        new = replace(
            state,
            monitor=monitor,
            samples=state.samples + samples,
            exceeding=int(exceeding[-1]) if exceeding.size else state.exceeding,
        )
        return new, Evaluations(trace, index, np.flatnonzero(exceeding > self._on_delay))


class DiagnosisSchedule(NamedTuple):
    """When the full diagnosis of an alarm is due; all in the unit of the samples' time, from which numbers come."""

    window: float  # length of the window that is diagnosed
    after: float  # how much of it lies behind the alarm

    def end(self, alarm: float, begin: float | None = None) -> float:
        """Return the end of the window; `begin`: the first sample, after which there is to be a whole window."""
        end = alarm + self.after
        return end if begin is None else max(end, begin + self.window)

    def next_alarm(self, since: float, now: float, longest: float) -> float:
        """Return when a fault that lasts counts as a new one: it may have grown, and another may have come."""
        return now + min(max(now - since, self.window), longest)
