"""A machine that was repaired within a recording: healthy, with a finding in its past."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from servoscope.detection.onset import Onset
from servoscope.diagnosis.ml_refit import refit_candidates, refit_onset, refit_recording, summarise_refit
from servoscope.diagnosis.result import FaultInterval
from servoscope.evidence.examination import Examination
from servoscope.isolation.candidate import UNKNOWN, Candidate, FaultEstimate


def is_repaired(exam: Examination, intervals: Sequence[FaultInterval]) -> bool:
    """Return whether a change that is as old as the recording was over at a time that is known, and nothing since."""
    if len(intervals) != 1 or exam.alarm[-1] or (exam.features is not None and exam.features.changed is not None):
        return False
    return intervals[0].from_start and intervals[0].end_interval_s is not None


def repaired_interval(
    exam: Examination, recursive: tuple[Candidate, ...], sure: float, progress: Callable[[], None]
) -> FaultInterval:
    """Return the interval of an axis that is healthy since its change: the change is what was undone.

    The refit compares what came after with what came before, so that its ratios are those of the repair.
    """
    assert exam.change is not None
    t, change = exam.recording.t, exam.change
    at = float(t[change.onset])
    refined = refit_recording(exam, Onset(at, at, at, change.onset), change.detected, len(t) - 1, progress)
    assert refined is not None
    over, began = refit_onset(refined, exam), float(t[0])
    candidates = tuple(
        c.model_copy(update={"faults": tuple(map(_undone, c.faults))}) for c in refit_candidates(refined)
    )
    best = candidates[0]
    return FaultInterval(
        detected_at_s=float(t[change.detected]),
        onset_s=(began, began, began),
        end_s=over.likely_s,
        end_interval_s=(over.low_s, over.likely_s, over.high_s),
        from_start=True,
        probability=best.probability,
        faults=best.faults if best.probability >= sure and best.name != UNKNOWN else (),
        candidates=candidates,
        refit=summarise_refit(refined, exam, recursive),
    )


def _undone(repair: FaultEstimate) -> FaultEstimate:
    low, high = repair.interval
    return repair.model_copy(update={"ratio": 1.0 / repair.ratio, "interval": (1.0 / high, 1.0 / low), "mass_kg": None})
