"""Signals that are not what the loop file says are no fault of the actuator: what is wrong, and the remedy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.core.messages import Message
from servoscope.detection.signal_defects import SignalDefect, begins_wrong, find_corrections
from servoscope.diagnosis.examine import Examination
from servoscope.diagnosis.explanation import undetermined_headline
from servoscope.diagnosis.result import Diagnosis, DiagnosisWarning, recording_facts
from servoscope.diagnosis.warnings import warning_throughout
from servoscope.signals import Recording


def describe_correction(points: Sequence[Baseline], recording: Recording) -> Message | None:
    """Return what makes a recording healthy when its signals are put right; None where nothing does."""
    first, theta = points[0], np.array(points[0].theta)
    for correction in find_corrections(first.pipeline(), theta, first.recursion.R, recording):
        if not begins_wrong(first.pipeline(), theta, recording, correction):
            continue
        corrected = correction.apply(recording)
        if any(not Examination.from_recording(point, corrected).apparent_alarm.any() for point in points):
            return correction.description
    return None


def leave_undetermined(exam: Examination, reason: Message) -> Diagnosis:
    """Return the diagnosis of a recording whose signals are not what the loop file says."""
    recording, point = exam.recording, exam.baseline.point
    warnings = [DiagnosisWarning.of(defect) for defect in recording.defects]
    return Diagnosis(
        **recording_facts(recording),
        verdict="undetermined",
        headline=undetermined_headline(reason, point),
        reasons=(),
        intervals=(),
        parameters={},
        ifrf=(),
        warnings=(*warnings, warning_throughout(exam, "signals", reason)),
        point=point or None,
    )


def limit_to_sound_part(diagnosis: Diagnosis, recording: Recording, defect: SignalDefect) -> Diagnosis:
    """Return the diagnosis of a recording that was judged up to a defect: a fault, or undetermined."""
    from_s, to_s = float(recording.t[defect.begin]), float(recording.t[-1])
    count = recording.samples - defect.begin
    warning = DiagnosisWarning(kind="signals", from_s=from_s, to_s=to_s, count=count, description=defect.description)
    update = {
        "samples": recording.samples,
        "duration_s": recording.duration_s,
        "warnings": (*diagnosis.warnings, warning),
    }
    if diagnosis.verdict != "fault":
        headline = undetermined_headline(defect.description, diagnosis.point or "")
        update |= {"verdict": "undetermined", "headline": headline}
    return diagnosis.model_copy(update=update)
