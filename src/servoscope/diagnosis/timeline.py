"""Several changes in one recording as part of a diagnosis: when the actuator was not healthy, and how."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from servoscope.detection.onset import Onset
from servoscope.diagnosis.ml_refit import refit_candidates, summarise_refit
from servoscope.diagnosis.result import FaultInterval
from servoscope.diagnosis.segments import segment_intervals
from servoscope.evidence.examination import Examination
from servoscope.isolation.candidate import UNKNOWN, Candidate
from servoscope.isolation.ml import MAX_WINDOW_SAMPLES, RefitResult, TimelineStretch, find_timeline, is_constant
from servoscope.isolation.ml.window import RefitWindow

MARGIN_S = 1.0  # before the earliest onset, from which the past is not sure to be healthy


def trace_timeline(
    exam: Examination,
    refined: RefitResult,
    onset: Onset,
    recursive: tuple[Candidate, ...],
    sure: float,
    progress: Callable[[], None],
) -> tuple[FaultInterval, ...]:
    """Return when the actuator differed from healthy and what explains that; nothing where a single change suffices.

    Looked at from the refit's first sample on, where its single change does not explain the recording, does not last,
    or does not stay the same. A stretch that nothing explains leaves the single change as it was.
    """
    if exam.baseline.axis is not None:
        # the search knows linear plants only; where the refit has no name for the change of an axis, sums may have one
        unnamed = exam.change is not None and (refined.is_unknown or refined.hypotheses[0].probability < sure)
        told = segment_intervals(exam, sure) if unnamed else ()
        return told if all(interval.faults for interval in told) else ()
    explained = not refined.is_unknown and refined.goodness.statistic <= refined.goodness.limit
    lasts = bool(exam.alarm[-1]) and not refined.onset.profile.duration  # a drift may be steps
    if explained and lasts and is_constant(refined):
        return ()
    first = refined.window.first_sample
    end = min(exam.recording.samples, first + MAX_WINDOW_SAMPLES)
    window = RefitWindow.from_recording(exam.baseline, exam.recording.rows(slice(first, end)), 0, end - first)
    rate = exam.recording.sample_rate
    likely_healthy = onset.low_s if refined.is_unknown else min(onset.low_s, _time(exam, first + refined.onset.low))
    healthy = int(np.searchsorted(exam.recording.t[first:end], likely_healthy - MARGIN_S))
    timeline = find_timeline(window, exam.baseline.plant.all_faults, healthy, refined.best.fitted, progress)
    if any(stretch.refit is not None and stretch.refit.is_unknown for stretch in timeline):
        return ()
    return _fault_intervals(exam, timeline, first, recursive, sure, 3.0 * exam.pipeline.bank.wait / rate)


def is_repaired(exam: Examination, intervals: Sequence[FaultInterval]) -> bool:
    """Return whether a change that is as old as the recording was over at a time that is known, and nothing since."""
    if len(intervals) != 1 or exam.alarm[-1] or (exam.features is not None and exam.features.changed is not None):
        return False
    return intervals[0].from_start and intervals[0].end_interval_s is not None


def _fault_intervals(
    exam: Examination,
    stretches: Sequence[TimelineStretch],
    first: int,
    recursive: tuple[Candidate, ...],
    sure: float,
    early_s: float,
) -> tuple[FaultInterval, ...]:
    intervals = []
    for stretch, following in pairwise([*stretches, None]):
        if stretch is None or stretch.refit is None:
            continue
        candidates = refit_candidates(stretch.refit)
        best, onset = candidates[0], _dates(exam, first, stretch.begin)
        end = None if following is None else _dates(exam, first, following.begin)
        intervals.append(
            FaultInterval(
                detected_at_s=_detection(exam, onset[0], np.inf if end is None else end[1]),
                onset_s=onset,
                end_s=None if end is None else end[1],
                end_interval_s=end,
                from_start=onset[1] - float(exam.recording.t[0]) <= early_s,
                probability=best.probability,
                faults=best.faults if best.probability >= sure and best.name != UNKNOWN else (),
                candidates=candidates,
                refit=summarise_refit(stretch.refit, exam, recursive, first),
            )
        )
    return tuple(intervals)


def _dates(exam: Examination, first: int, begin: tuple[int, int, int]) -> tuple[float, float, float]:
    """Return when a change came; the first changed sample ends the time in which it did."""
    low, likely, high = (first + k for k in begin)
    return _time(exam, max(low - 1, 0)), _time(exam, likely), _time(exam, high)


def _time(exam: Examination, sample: int) -> float:
    return float(exam.recording.t[min(sample, exam.recording.samples - 1)])


def _detection(exam: Examination, from_s: float, to_s: float) -> float | None:
    """Return when an alarm was raised in an interval; None where it was there already."""
    raised = np.flatnonzero(np.diff(exam.alarm.astype(np.int8), prepend=0) > 0)
    times = exam.t(raised)
    inside = raised[(times >= from_s) & (times <= to_s)]
    if not len(inside):
        return None
    crossed = int(exam.estimates.crossed[inside[0]]) - 1
    return float(exam.recording.t[crossed] if crossed >= 0 else exam.t(inside[0]))
