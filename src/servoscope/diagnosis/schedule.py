"""When an alarm is diagnosed in full: the refit needs samples from before the alarm and from after it."""

from __future__ import annotations

from typing import NamedTuple


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
