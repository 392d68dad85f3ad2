"""Faults learned from labelled recordings: which of these show the fault, and in which direction it moves theta."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.learned_fault import LearnedFault
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import BaselineError, NotEnoughError
from servoscope.core.messages import Message, message
from servoscope.detection.homogeneity import scatter
from servoscope.diagnosis.batch_estimate import estimate_batch_deviation, stretch_begin
from servoscope.diagnosis.diagnose import diagnose_examination
from servoscope.evidence.examination import Examination
from servoscope.isolation.candidate import UNKNOWN
from servoscope.isolation.isolate import misfit_limit
from servoscope.signals import Recording

# times the limit of a misfit: less means that the direction is known to worse than 35 degrees
MIN_DISTINCTNESS_FACTOR = 2.0
RANK_ONE_ROUNDS = 50  # of the alternation between direction and shares; five are usual
MIN_PROBABILITY_NOTED = 0.05  # probability from which another explanation of a labelled recording is noted

LabelledRecordings = Mapping[str, Sequence[Recording]]


def add_learned_faults(
    baseline: Baseline, faults: LabelledRecordings, progress: Callable[[str], None] = lambda _: None
) -> Baseline:
    """Return the baseline with faults learned from labelled recordings; its notes say what they may be mistaken for.

    A fault has to last to the end of its recordings; the time before its onset is left out. Raises BaselineError if a
    name is one of the plant's own faults, NotEnoughError if no recording of a fault differs from healthy, one is too
    short, or those of one name do not agree.
    """
    own = {UNKNOWN, *(fault.name for fault in baseline.loop.plant.all_faults)}
    learned, examined, notes = [], {}, list(baseline.notes)
    digest = hashlib.sha256(baseline.hash.encode())
    for name, recordings in faults.items():
        if name in own:
            raise BaselineError(
                f"fault {name}: the name is taken ({', '.join(sorted(own))} are): give the labelled recordings another"
            )
        progress(f"fault {name}")
        exams = [Examination.from_recording(baseline, recording) for recording in recordings]
        examined[name] = faulty = [exam for exam in exams if exam.alarm.any()]
        if not faulty:
            raise NotEnoughError(_undetected_message(name, exams))
        silent = [exam.recording.name for exam in exams if not exam.alarm.any()]
        notes += [message("learning.left_out", recording=rec, fault=name) for rec in silent]
        learned.append(_learn_fault(name, faulty, baseline.covariance_array()))
        for rec in (exam.recording for exam in faulty):
            for array in (rec.t, rec.r, rec.u, rec.y):
                digest.update(np.ascontiguousarray(array).tobytes())
        digest.update(name.encode())
    result = baseline.model_copy(update={"learned": tuple(learned), "hash": digest.hexdigest()[:16]})
    progress("faults compared")
    notes += [note for name, faulty in examined.items() if (note := _confusion_note(result, name, faulty)) is not None]
    return result.model_copy(update={"notes": tuple(notes)})


def _fault_deviation(exam: Examination) -> tuple[FloatArray, FloatArray]:
    onset = diagnose_examination(exam)[0].onset_s
    begin = float(exam.recording.t[0]) if onset is None else stretch_begin(exam.baseline, onset[0], onset[2])
    return estimate_batch_deviation(exam, begin)


def _learn_fault(name: str, faulty: Sequence[Examination], healthy: FloatArray) -> LearnedFault:
    deviations, covariances = map(np.array, zip(*map(_fault_deviation, faulty), strict=True))
    learned_fault = fit_learned_fault(name, [exam.recording.name for exam in faulty], deviations, covariances, healthy)
    if min(learned_fault.shares) <= 0.0:
        odd = learned_fault.recordings[int(np.argmin(learned_fault.shares))]
        raise NotEnoughError(f"{odd} moves theta the other way than the other recordings of {name}: two labels?")
    if learned_fault.distinctness < MIN_DISTINCTNESS_FACTOR * misfit_limit(len(healthy)):
        raise NotEnoughError(
            f"the {len(faulty)} recordings of {name} differ from each other as much as from healthy, so nearly any "
            "change would look like it: give them different labels, or record more"
        )
    return learned_fault


def fit_learned_fault(
    name: str, recordings: Sequence[str], deviations: FloatArray, covariances: FloatArray, healthy: FloatArray
) -> LearnedFault:
    """Learn a direction from recordings that may differ in severity: d_j = a_j s, with a mean of 1 over a_j.

    Direction s and shares a_j minimise the sum of (d_j - a_j s)' (C_j + C)^-1 (d_j - a_j s), a weighted
    approximation of rank one (Gabriel and Zamir, 1979). What is left beside the severities counts as scatter
    between recordings, by the rule for healthy ones.

    `deviations, covariances`: d_j, theta of each recording minus its healthy expectation, shape (m, n), and C_j
    of their noise, (m, n, n); `healthy`: c, the covariance of a healthy recording around the baseline, shape
    (n, n).
    """
    C = covariances + healthy
    size = np.sqrt(np.diagonal(C, axis1=1, axis2=2).mean(axis=0))
    d, W = deviations / size, np.linalg.inv(C / np.outer(size, size))
    s, a = d.mean(axis=0), np.ones(len(d))
    for _ in range(RANK_ONE_ROUNDS):
        a = np.einsum("a,jab,jb->j", s, W, d) / np.einsum("a,jab,b->j", s, W, s)
        known = np.linalg.inv(np.einsum("j,jab->ab", a**2, W))
        s = known @ np.einsum("j,jab,jb->a", a, W, d)
        s, a, known = s * a.mean(), a / a.mean(), known * a.mean() ** 2
    own = known * np.outer(size, size)
    between = scatter(deviations - a[:, None] * (s * size), C)
    return LearnedFault(
        name=name,
        deviation=tuple(float(x) for x in s * size),
        covariance=tuple(tuple(float(x) for x in row) for row in own + between),
        recordings=tuple(recordings),
        shares=tuple(float(x) for x in a),
    )


def _undetected_message(name: str, exams: Sequence[Examination]) -> str:
    if not exams:
        return f"{name}: no recording to learn from, give at least one"
    share = max(float(exam.statistic.max(initial=0.0)) / exam.baseline.thresholds.statistic for exam in exams)
    is_single = len(exams) == 1
    subject = (
        f"{exams[0].recording.name} does not differ" if is_single else f"none of {len(exams)} recordings of it differs"
    )
    return (
        f"{name}: {subject} from healthy (T² reaches {share:.0%} of its limit), and a fault that does not show cannot "
        "be learned: record it more severe, under motion with more excitation or at another load"
    )


def _confusion_note(baseline: Baseline, name: str, faulty: Sequence[Examination]) -> Message | None:
    """Return a note on what else explains the labelled recordings of a fault; None if nothing does."""
    diagnoses = [diagnose_examination(replace(exam, baseline=baseline))[0] for exam in faulty]
    likely = Counter(
        c.name
        for diagnosis in diagnoses
        for c in diagnosis.candidates
        if c.name != name and c.probability >= MIN_PROBABILITY_NOTED
    )
    others = tuple(
        message("learning.mistaken_for", name=other, count=count, recordings=len(faulty))
        for other, count in likely.items()
    )
    return message("learning.mistaken", fault=name, others=others) if others else None
