"""The alarm of a recording: when, the evaluation that is explained, and since when by the recursion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from servoscope.detection.onset import Onset, estimate_onset
from servoscope.diagnosis.output_onset import refine_onset
from servoscope.diagnosis.pressure_evidence import pressure_onset
from servoscope.diagnosis.result import FaultInterval
from servoscope.evidence.examination import Examination


@dataclass(frozen=True)
class RecordingAlarm:
    """The alarm of a recording: its sample, the evaluation that is explained, and the onset by the recursion."""

    sample: int
    evaluation: int
    onset: Onset


def first_alarm(exam: Examination, progress: Callable[[str], None] = lambda _: None) -> RecordingAlarm | None:
    """Return the first alarm of an examination; None if there was none."""
    if not exam.alarm.any():
        return None
    first = int(exam.alarm.argmax())
    # the sequential test alarms at any sample, T^2 at its evaluations
    crossed = int(exam.estimates.crossed[first]) - 1
    at_once = crossed >= 0 and not exam.baseline.loop.monitor.on_delay
    sample = crossed if at_once else int(exam.estimates.index[first])
    at = exam.explained
    progress("onset")
    if (change := exam.change) is not None:
        # a change that is over may be older than the recording
        ends = (0, 0, 0) if change.segments and change.segments[0].changed else change.onset_interval
        low, likely, high = (float(exam.recording.t[k]) for k in ends)
        return RecordingAlarm(change.detected, at, Onset(low, likely, high, ends[1]))
    if exam.pressures is not None and exam.pressures.excess > 1.0:
        return RecordingAlarm(sample, at, pressure_onset(exam.pressures, exam.recording))
    onset = estimate_onset(
        exam.pipeline,
        exam.recording,
        exam.expected[at],
        exam.estimates.theta[at],
        sample,
        max(int(exam.estimates.index[at]), sample),
    )
    return RecordingAlarm(sample, at, refine_onset(exam, onset, sample, int(exam.estimates.index[at])))


def covers(interval: FaultInterval, t: float) -> bool:
    """Return whether an interval lasts at a time [s]."""
    begin = -np.inf if interval.onset_s is None else interval.onset_s[1]
    return begin <= t and (interval.end_s is None or t <= interval.end_s)


def onset_of(intervals: Sequence[FaultInterval], exam: Examination, alarm: RecordingAlarm) -> Onset:
    """Return the onset of the interval in which the explained evaluation lies, the last one where none does."""
    at = float(exam.t(alarm.evaluation))
    interval = next((known for known in intervals if covers(known, at)), intervals[-1])
    assert interval.onset_s is not None
    return Onset(*interval.onset_s, int(np.searchsorted(exam.recording.t, interval.onset_s[1])))
