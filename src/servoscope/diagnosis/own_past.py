"""A recording against its own beginning: scatter between days must not hide a change within one of them."""

from __future__ import annotations

import numpy as np

from servoscope.core.errors import ServoscopeError
from servoscope.core.messages import message
from servoscope.diagnosis.result import DiagnosisWarning
from servoscope.evidence.examination import Examination
from servoscope.learning.learn import learn_baseline

SHARE = 1.0 / 3.0  # of the recording that counts as its past
BUDGET = 0.1  # of the budget of false alarms, which this second test adds to that of the first
# of a change that the baseline promises to see: what the past has to promise, or it is not worth asking
MAX_PROMISE_RATIO = 0.7


def examine_by_own_past(exam: Examination) -> Examination | None:
    """Return the examination of the same recording by a baseline learned from its beginning.

    None unless the baseline knows scatter between recordings that makes it blunter than the recording's own past, that
    past raises no alarm by the baseline, and the exact plant explains it down to white noise: only then is the scatter
    within a recording what its noise says.
    """
    baseline, recording = exam.baseline, exam.recording
    # where the exact plant explains all healthy recordings, the refit lets its parameters follow each of them anyway
    if len(baseline.sources) < 2 or baseline.exact is None or baseline.exact.misfit <= 1.0:
        return None
    end_s = float(recording.t[0]) + SHARE * recording.duration_s
    if (exam.alarm & (exam.t(slice(None)) <= end_s)).any():
        return None
    settings = baseline.loop.monitor
    budget = {"false_alarms_per_year": BUDGET * settings.false_alarms_per_year}
    loop = baseline.loop.model_copy(update={"monitor": settings.model_copy(update=budget)})
    try:
        past = learn_baseline(loop, [recording.part(float(recording.t[0]), end_s)])
    except (ServoscopeError, np.linalg.LinAlgError):  # too short, too little motion
        return None
    known = {promise.parameter: promise.change or np.inf for promise in baseline.detectability.changes}
    sharper = any(
        promise.change and promise.change < MAX_PROMISE_RATIO * known[promise.parameter]
        for promise in past.detectability.changes
    )
    if past.exact is None or past.exact.misfit > 1.0 or not sharper:
        return None
    return Examination.from_recording(past.model_copy(update={"point": baseline.point}), recording)


def own_past_warning(exam: Examination) -> DiagnosisWarning:
    """Return what a reader has to know: which past the recording was compared with."""
    recording = exam.recording
    from_s, to_s = float(recording.t[0]), float(recording.t[0]) + SHARE * recording.duration_s
    text = message("warning.own_past", duration=to_s - from_s)
    return DiagnosisWarning(kind="own_past", from_s=from_s, to_s=to_s, count=1, description=text)
