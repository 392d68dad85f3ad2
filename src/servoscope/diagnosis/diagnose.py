"""The diagnosis of a recording: operating point, verdict, onset, fault and size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, overload

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.core import outofcore
from servoscope.core.blas import with_one_blas_thread
from servoscope.core.errors import RecordingError, SimulationError
from servoscope.core.messages import Message, message
from servoscope.core.verdict import FOUND, VerdictKind
from servoscope.detection.louder_noise import find_louder_noise, grows_innovations
from servoscope.detection.onset import Onset
from servoscope.detection.trace import UNSEEN_EXCESS, Trace
from servoscope.diagnosis import ml_refit
from servoscope.diagnosis.account import Account
from servoscope.diagnosis.batch_estimate import isolation_inputs
from servoscope.diagnosis.bias_correction import (
    BiasCorrection,
    corrected_trace,
    estimate_bias_correction,
    final_coefficients,
    final_response,
)
from servoscope.diagnosis.change_words import how_sure, suspect_headline
from servoscope.diagnosis.checks import what_to_check
from servoscope.diagnosis.explanation import build_headline, build_reasons, unwatched_changes
from servoscope.diagnosis.own_past import examine_by_own_past, own_past_warning
from servoscope.diagnosis.recording_alarm import RecordingAlarm, covers, first_alarm, onset_of
from servoscope.diagnosis.result import (
    Diagnosis,
    DiagnosisWarning,
    FaultInterval,
    keep_inputs,
    recording_facts,
)
from servoscope.diagnosis.segments import moved_coefficients, segment_intervals
from servoscope.diagnosis.signal_check import (
    judge_both_sides,
    judge_put_right,
    leave_undetermined,
    limit_to_sound_part,
)
from servoscope.diagnosis.timeline import is_repaired, trace_timeline
from servoscope.diagnosis.warnings import (
    detectable_sizes,
    estimate_warnings,
    implausible_warnings,
    power_warnings,
    warning_throughout,
)
from servoscope.evidence.examination import Examination
from servoscope.evidence.kinds import findings
from servoscope.evidence.sensors import check_sensors
from servoscope.evidence.signals import find_signal_defect
from servoscope.isolation.candidate import UNKNOWN, Candidate
from servoscope.isolation.isolate import isolate
from servoscope.isolation.ml import RefitResult, find_outside_onset
from servoscope.models.plants.axis import AxisPlant
from servoscope.signals import MIN_SAMPLES, Recording
from servoscope.signals.readers import as_recording
from servoscope.signals.readers.frames import Source

Progress = Callable[[str], None]

MIN_CERTAINTY = 0.95  # probability from which a fault is named
MAX_SIGNAL = 1e60  # of a signal; products of four of them still are numbers
MIN_UNKNOWN_PROBABILITY = 0.05  # of an unknown change, from which an operating point does not explain a recording


@overload
def diagnose(
    baseline: Baseline | str | Path,
    recording: Recording | Source,
    progress: Callable[[str], None] = ...,
    *,
    point: str | None = None,
    before: VerdictKind = ...,
) -> Diagnosis: ...


@overload
def diagnose(
    baseline: Baseline | str | Path,
    recording: list[Recording | Source] | list[Recording] | list[Path] | list[str],
    progress: Callable[[str], None] = ...,
    *,
    point: str | None = None,
    before: VerdictKind = ...,
) -> tuple[Diagnosis, ...]: ...


@with_one_blas_thread
def diagnose(
    baseline: Baseline | str | Path,
    recording: Any,
    progress: Callable[[str], None] = lambda _: None,
    *,
    point: str | None = None,
    before: VerdictKind = "undetermined",
) -> Any:
    """Say whether the actuator was healthy; if not, what changed, by how much, since when, and how sure that is.

    Parameters
    ----------
    baseline
        What healthy looks like, or its path.
    recording
        The recording to judge, or what `read` reads: a path, a frame, arrays by name. A list of them in order of time:
        one that is suspect after another one is a fault, and all diagnoses are returned.
    progress
        Called with the name of each step.
    point
        Operating point of the recording. Without it, a recording is healthy if it is so at one point of the baseline.
        A change is explained at the point where the recording stays healthy for longest; among points within one
        memory of that, where a known fault explains it, and then where it is smallest. A warning names other points
        that explain it too.
    before
        The verdict on the recording before this one, where it is known.

    Raises
    ------
    RecordingError
        If the recording's sample rate is not the loop's.
    BaselineError
        If the baseline has no such point.

    Examples
    --------
    >>> diagnose("baseline.json", "wednesday.csv").verdict
    'healthy'
    >>> [(fault.name, round(fault.ratio, 2)) for fault in diagnose("baseline.json", "friday.csv").faults]
    [('lubrication', 1.25)]
    >>> [told.verdict for told in diagnose("baseline.json", ["wednesday.csv", "friday.csv"])]
    ['healthy', 'fault']
    """
    learned = Baseline.of(baseline)
    if isinstance(recording, list):
        told = list[Diagnosis]()
        for next_recording in recording:
            told.append(diagnose(baseline, next_recording, progress, point=point, before=before))
            before = told[-1].verdict
        return tuple(told)
    judged = as_recording(recording, learned.loop)
    diagnosis = _diagnose_at_point(learned, judged, progress, point, before)[0]
    return keep_inputs(diagnosis, baseline if point is None else learned.at(point), recording)


@with_one_blas_thread
def diagnose_with_trace(
    baseline: Baseline | str | Path,
    recording: Recording | Source,
    progress: Callable[[str], None] = lambda _: None,
    *,
    point: str | None = None,
    before: VerdictKind = "undetermined",
) -> tuple[Diagnosis, Trace]:
    """Return the diagnosis of a recording together with its trace; arguments and errors as for `diagnose`."""
    learned = Baseline.of(baseline)
    judged = as_recording(recording, learned.loop)
    diagnosis, exam, correction = _diagnose_at_point(learned, judged, progress, point, before)
    return diagnosis, corrected_trace(exam, correction)


def _diagnose_at_point(
    baseline: Baseline, recording: Recording, progress: Progress, point: str | None, before: VerdictKind
) -> tuple[Diagnosis, Examination, BiasCorrection | None]:
    """Return the diagnosis at the operating point that explains the recording, and what its trace is made of."""
    largest = max(abs(bound) for x in (recording.r, recording.u, recording.y) for bound in outofcore.extremes(x))
    if largest > MAX_SIGNAL:
        raise RecordingError(f"{recording.name}: has values up to {largest:.2g}, check the units of r, u and y")
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # what is beyond all numbers explains nothing
            return _judge_sound_part(baseline, recording, progress, point, before)
    except (np.linalg.LinAlgError, SimulationError, ArithmeticError) as error:
        reason = f"its numbers have no solution ({error})"
        raise RecordingError(f"{recording.name}: {reason}; check units, signs and sizes of r, u and y") from None


def _judge_sound_part(
    baseline: Baseline, recording: Recording, progress: Progress, point: str | None, before: VerdictKind
) -> tuple[Diagnosis, Examination, BiasCorrection | None]:
    """Return what `_diagnose_at_point` does, of the recording up to a signal that is stuck or jumps."""
    defect = find_signal_defect(recording, baseline.loop.delay)
    if defect is not None:
        sound = recording.part(float(recording.t[0]), float(recording.t[max(defect.begin, MIN_SAMPLES)]))
        diagnosis, exam, correction = _judge_signals(baseline, sound, progress, point, before)
        return limit_to_sound_part(diagnosis, recording, defect), exam, correction
    return _judge_signals(baseline, recording, progress, point, before)


def _judge_signals(
    baseline: Baseline, recording: Recording, progress: Progress, point: str | None, before: VerdictKind
) -> tuple[Diagnosis, Examination, BiasCorrection | None]:
    points = baseline.per_point if point is None else (baseline.at(point),)
    recording, departed = check_sensors(points[0], recording)
    sensors = [*map(DiagnosisWarning.of, departed)]
    model = points[0].covariates
    if model is not None and (missing := model.describe_missing(recording.channels)) is not None:
        raise RecordingError(f"{recording.name}: {missing}")
    points = tuple(Account(at_point).shared(recording.duration_s) for at_point in points)
    exams = [Examination.from_recording(at_point, recording) for at_point in points]
    if (unusable := next(findings(exams[0], "undetermined"), None)) is not None:
        return leave_undetermined(exams[0], unusable.text), exams[0], None
    if (own := next(filter(None, map(examine_by_own_past, exams)), None)) is not None and own.alarm.any():
        diagnosis, correction = diagnose_examination(own, progress, inside=True)
        return _with_warnings(diagnosis, [own_past_warning(own), *sensors]), own, correction
    last = max(_first_alarm_time(exam) for exam in exams)
    near = last - baseline.loop.monitor.memory if np.isfinite(last) else last
    rivals = sorted((exam for exam in exams if _first_alarm_time(exam) >= near), key=largest_statistic_ratio)
    if np.isinf(last):
        diagnosis, correction = diagnose_examination(rivals[0], progress)
        return _with_warnings(diagnosis, sensors), rivals[0], correction
    progress("signals")
    again = partial(_judge_signals, baseline, progress=progress, point=point, before=before)
    if (put_right := judge_put_right(points, recording, rivals[0], again)) is not None:
        return put_right
    noise = find_louder_noise(recording, baseline.loop.monitor.memory)
    if noise is not None and grows_innovations(points[0].pipeline(), recording, noise):
        return judge_both_sides(recording, noise, again)
    diagnoses = sorted(
        ((*diagnose_examination(exam, progress, before), exam) for exam in rivals),
        key=lambda judged: (judged[0].verdict not in FOUND, _change_size(judged[0])),
    )
    diagnosis, correction, exam = diagnoses[0]
    others = [message("warning.point", other=other.headline) for other, *_ in diagnoses[1:] if _is_explained(other)]
    doubts = [warning_throughout(exam, "point", other) for other in others]
    return _with_warnings(diagnosis, [*sensors, *doubts]), exam, correction


def _with_warnings(diagnosis: Diagnosis, warnings: Sequence[DiagnosisWarning]) -> Diagnosis:
    return diagnosis.model_copy(update={"warnings": (*diagnosis.warnings, *warnings)}) if warnings else diagnosis


def _first_alarm_time(exam: Examination) -> float:
    if Account(exam.baseline).verdict(exam).kind not in FOUND:
        return np.inf
    alarm, changed = exam.apparent_alarm, exam.features_changed_s
    first = float(exam.t(int(alarm.argmax()))) if alarm.any() else np.inf
    return min(first, np.inf if changed is None else changed)


def largest_statistic_ratio(exam: Examination) -> float:
    """Return the largest value of all statistics, as a multiple of its limit."""
    ratios = (statistic.value / statistic.limit for statistic in exam.statistics)
    return max(float(ratio.max(where=exam.ready, initial=0.0)) for ratio in ratios)


def _change_size(diagnosis: Diagnosis) -> float:
    """Return how large the change is, relative; infinite where no known fault explains it."""
    return max(fault.change for fault in diagnosis.candidates[0].faults) if _is_explained(diagnosis) else np.inf


def _is_explained(diagnosis: Diagnosis) -> bool:
    """Return whether known faults explain the change."""
    known = all(c.probability < MIN_UNKNOWN_PROBABILITY for c in diagnosis.candidates if c.name == UNKNOWN)
    return known and bool(diagnosis.candidates)


def diagnose_examination(
    exam: Examination,
    progress: Progress = lambda _: None,
    before: VerdictKind = "undetermined",
    *,
    inside: bool = False,
) -> tuple[Diagnosis, BiasCorrection | None]:
    """Return the diagnosis of an examination, and how its estimates become those of the actuator itself.

    `before`: the verdict on the recording before; `inside`: whether it is known that a change came within this one.
    """
    recording, baseline, last = exam.recording, exam.baseline, exam.evaluations - 1
    told = Account(baseline).verdict(exam, before, inside=inside)
    verdict, is_above, at, features = told.kind, told.kind in FOUND, last, exam.features
    alarm = first_alarm(exam, progress) if is_above else None
    intervals: tuple[FaultInterval, ...] = ()
    onset: Onset | None = None
    if alarm is not None:
        at = alarm.evaluation
        intervals, onset, doubts = _explain_alarm(exam, alarm, progress)
        if baseline.thresholds.hypotheses and not intervals[-1].from_start:  # healthy recordings do not scatter
            verdict = "fault"
        verdict = "healthy" if is_repaired(exam, intervals) else verdict
        warnings = _all_warnings(exam, doubts)
        headline = build_headline(verdict, intervals, {}, warnings, baseline.point)
    elif is_above and (change := next(findings(exam, "change"), None)) is not None:
        unknown = (Candidate(name=UNKNOWN, probability=1.0),)
        intervals = (FaultInterval(detected_at_s=change.from_s, probability=1.0, candidates=unknown),)
        headline, warnings = change.text, _all_warnings(exam, [])
    else:
        verdict, headline, warnings = judge_without_alarm(exam)
    if verdict == "suspect":
        headline = suspect_headline(intervals[-1], headline, baseline.point)
    interval = next(
        (known for known in intervals if covers(known, float(exam.t(at)))), intervals[-1] if intervals else None
    )
    correction = estimate_bias_correction(exam, interval.candidates if interval else (), onset, at)
    end = corrected_trace(exam, correction, slice(max(last, 0), last + 1))
    explained = end if at == last else corrected_trace(exam, correction, slice(at, at + 1))
    reasons = build_reasons(exam, explained, interval) if alarm is not None and interval is not None else ()
    if is_above and features is not None and (changed := features.changed) is not None:
        reasons = (*reasons, *features.reasons(changed, alone=alarm is None))
    if verdict in FOUND and told.recordings:
        reasons = (*reasons, how_sure(told))
    diagnosis = Diagnosis(
        **recording_facts(recording),
        verdict=verdict,
        headline=headline,
        reasons=reasons,
        checks=what_to_check(baseline.loop, interval),
        intervals=intervals,
        parameters=final_coefficients(end),
        ifrf=final_response(end),
        warnings=tuple(sorted(warnings, key=lambda warning: warning.from_s)),
        point=baseline.point or None,
    )
    return diagnosis, correction


def judge_without_alarm(exam: Examination) -> tuple[VerdictKind, Message, list[DiagnosisWarning]]:
    """Return the verdict, the headline and the warnings of an examination that has found no change."""
    detectable = detectable_sizes(exam)
    doubts = power_warnings(exam, detectable)
    withheld = exam.apparent_alarm.any() and Account(exam.baseline).verdict(exam).kind in FOUND
    verdict: VerdictKind = "undetermined" if doubts or withheld else "healthy"
    warnings, unwatched = _all_warnings(exam, doubts), unwatched_changes(exam.baseline.plant, detectable)
    return verdict, build_headline(verdict, (), detectable, warnings, exam.baseline.point, unwatched), warnings


def _all_warnings(exam: Examination, doubts: Sequence[DiagnosisWarning]) -> list[DiagnosisWarning]:
    defects = [DiagnosisWarning.of(defect) for defect in exam.recording.defects]
    told = [DiagnosisWarning.of(finding) for finding in findings(exam, "doubt")]
    return [*defects, *told, *estimate_warnings(exam), *doubts]


def _explain_alarm(
    exam: Examination, alarm: RecordingAlarm, progress: Callable[[str], None]
) -> tuple[tuple[FaultInterval, ...], Onset, list[DiagnosisWarning]]:
    """Return the intervals that begin with an alarm, the onset of the explained one, and doubts about explanations."""
    if (change := exam.change) is not None and change.vibration is not None:
        return (ml_refit.vibration_interval(exam, change.vibration),), alarm.onset, []
    if change is not None and not change.may_be_single:
        several = segment_intervals(exam, MIN_CERTAINTY)
        return several, onset_of(several, exam, alarm), []
    onset, refit, doubts = alarm.onset, None, list[DiagnosisWarning]()
    recursive = candidates = isolate(*isolation_inputs(exam, onset, alarm.evaluation), lambda: progress("isolation"))
    exam.release()
    progress("refit")
    last = int(exam.estimates.index[alarm.evaluation])
    # the refit takes the model for exact, but that of an axis follows the recording; what only a fit to the whole
    # recording tells from healthy is named and sized by that fit
    seen = change is not None or (
        not exam.drifts
        and exam.recursion_alarm.any()
        and (exam.motion_excess(slice(int(exam.alarm.argmax()), alarm.evaluation + 1)) < UNSEEN_EXCESS).all()
    )
    refined = ml_refit.refit_recording(exam, onset, alarm.sample, last, lambda: progress("refit")) if seen else None
    if refined is not None and not _prefers_learned_fault(refined, recursive[0]):
        # one change that is no fault comes before several that are
        outside = find_outside_onset(refined) if refined.is_unknown else None
        trace = partial(trace_timeline, exam, refined, alarm.onset, recursive, MIN_CERTAINTY)
        several = () if outside else trace(lambda: progress("refit"))
        if several:
            return several, onset_of(several, exam, alarm), []
        candidates = ml_refit.refit_candidates(refined)
        refit = ml_refit.summarise_refit(refined, exam, recursive, outside=outside)
        if outside or not refined.is_unknown:
            onset = ml_refit.refit_onset(refined, exam, outside)
        doubts = ml_refit.disagreement_warnings(exam, candidates, refit, MIN_CERTAINTY)
    elif (axis := exam.baseline.axis) is not None:
        assert isinstance(exam.baseline.loop.plant, AxisPlant)
        plant = axis.plant(exam.baseline.loop.plant)
        candidates = tuple(candidate.weighed(plant) for candidate in candidates)
    best, t = candidates[0], exam.recording.t
    doubts += (implausible := implausible_warnings(exam, best))
    wait_s = exam.pipeline.bank.wait / exam.recording.sample_rate
    interval = FaultInterval(
        detected_at_s=float(t[alarm.sample]),
        onset_s=(onset.low_s, onset.likely_s, onset.high_s),
        end_s=None if exam.alarm[-1] else float(exam.t(int(np.flatnonzero(exam.alarm)[-1]) + 1)),
        from_start=onset.likely_s - float(t[0]) <= 3.0 * wait_s,
        probability=best.probability,
        faults=best.faults if best.probability >= MIN_CERTAINTY and best.name != UNKNOWN and not implausible else (),
        candidates=candidates,
        refit=refit,
        coefficients=() if change is None else moved_coefficients(exam, change.segments[-1]),
    )
    return (interval,), onset, doubts


def _prefers_learned_fault(refined: RefitResult, recursive: Candidate) -> bool:
    """Return whether a fault learned from labelled recordings explains more than the refit, which knows none."""
    sure = recursive.is_learned and recursive.probability >= MIN_CERTAINTY
    return sure and (refined.is_unknown or len(refined.best.fitted.faults) > 1)
