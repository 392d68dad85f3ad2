"""Signals that are not what the loop file says are no fault of the actuator: what is wrong, and the remedy."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.core.messages import Message
from servoscope.detection.louder_noise import LouderNoise
from servoscope.diagnosis.bias_correction import BiasCorrection
from servoscope.diagnosis.explanation import undetermined_headline
from servoscope.diagnosis.result import Diagnosis, DiagnosisWarning, recording_facts
from servoscope.diagnosis.warnings import warning_throughout
from servoscope.evidence.examination import Examination
from servoscope.evidence.signals import Correction, SignalDefect, begins_wrong, find_corrections, shrinks_misfit
from servoscope.signals import Recording

# a diagnosis, and what its trace is made of
Judgement = tuple[Diagnosis, Examination, BiasCorrection | None]


def find_wrong_signals(points: Sequence[Baseline], recording: Recording) -> tuple[Correction, bool] | None:
    """Return how to put the signals of a recording right, and whether it is healthy then; None where nothing does.

    A unit or sign may be wrong in the recording of a fault, too.
    """
    first, theta, believed = points[0], np.array(points[0].theta), None
    pipeline = first.pipeline()
    for correction in find_corrections(pipeline, theta, first.recursion.R, recording):
        if not begins_wrong(pipeline, theta, recording, correction):
            continue
        corrected = correction.apply(recording)
        if any(not Examination.from_recording(point, corrected).apparent_alarm.any() for point in points):
            return correction, True
        if believed is None and shrinks_misfit(pipeline, theta, recording, correction):
            believed = correction
    return None if believed is None else (believed, False)


def judge_put_right(
    points: Sequence[Baseline], recording: Recording, exam: Examination, judge: Callable[[Recording], Judgement]
) -> Judgement | None:
    """Return the judgement of a recording whose signals are wrong, which it says; None where they are not.

    One that is healthy with its signals put right is undetermined; any other is judged with them.
    """
    if (wrong := find_wrong_signals(points, recording)) is None:
        return None
    correction, is_healthy = wrong
    if is_healthy:
        return leave_undetermined(exam, correction.description), exam, None
    diagnosis, exam, bias = judge(correction.apply(recording))
    warning = warning_throughout(exam, "signals", correction.description)
    return diagnosis.model_copy(update={"warnings": (warning, *diagnosis.warnings)}), exam, bias


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


def judge_both_sides(recording: Recording, noise: LouderNoise, judge: Callable[[Recording], Judgement]) -> Judgement:
    """Return the judgement of a recording in which a signal becomes noisier: that of the first side with a fault.

    Noise in the regressor moves the estimates (errors in variables; Söderström, 2018), which looks like a fault of the
    plant where it comes within a recording. On the louder side it has been there from the first sample on, and a loop
    that can be simulated says what it does.
    """
    t, k, reason = recording.t, noise.onset, noise.describe(recording.t)
    diagnosis, exam, correction = judge(recording.part(float(t[0]), float(t[noise.last_quiet])))
    if diagnosis.verdict != "fault":
        diagnosis, exam, correction = judge(recording.part(float(t[k]), float(np.nextafter(t[-1], np.inf))))
        if diagnosis.verdict == "fault" and exam.noise is None:
            diagnosis = leave_undetermined(exam, reason)
    warning = DiagnosisWarning(
        kind="noise", from_s=float(t[k]), to_s=float(t[-1]), count=len(t) - k, description=reason
    )
    facts = {"samples": recording.samples, "duration_s": recording.duration_s}
    return diagnosis.model_copy(update=facts | {"warnings": (*diagnosis.warnings, warning)}), exam, correction
