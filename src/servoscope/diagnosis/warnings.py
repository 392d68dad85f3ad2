"""Warnings about an examination: changes too small for this recording to show, and doubts about the estimate."""

from __future__ import annotations

import numpy as np

from servoscope.baseline.plant_fit import MAX_SATURATED_SHARE, saturated_share
from servoscope.core import outofcore
from servoscope.core.arrays import FloatArray
from servoscope.core.messages import Message, message
from servoscope.detection.statistic import noncentrality, required_noncentrality
from servoscope.diagnosis.result import DiagnosisWarning
from servoscope.evidence.examination import MAX_SKIPPED_SHARE, Examination
from servoscope.evidence.warm_up import changes_like_warmth
from servoscope.isolation.candidate import Candidate
from servoscope.learning.plausibility import negative_coefficients

AT_ONCE = 4096  # evaluations
MIN_SKIPPED_SHARE = 0.01  # share of updates without an instrument from which a warning is given
NO_PROMISE = 10.0  # relative change; a baseline that detects nothing smaller promises nothing
MAX_DETECTABLE_RATIO = 3.0  # a recording that shows only changes this much larger than promised is called undetermined


def detectable_sizes(exam: Examination) -> dict[str, tuple[float, float]]:
    """Return, by parameter, the smallest change that would have shown here, and what the baseline promises."""
    baseline, e = exam.baseline, exam.estimates
    promised = {
        p.parameter: p.change for p in baseline.detectability.changes if p.change is not None and p.change < NO_PROMISE
    }
    rows = np.array([baseline.fault_directions[parameter] for parameter in promised])

    def largest(first: int, end: int) -> FloatArray:
        best = np.zeros(len(rows))
        for at in outofcore.iter_chunks(first, end, e.S, e.Psi, at_once=AT_ONCE) if len(rows) else ():
            best = np.maximum(best, noncentrality(exam.covariance(at), e.Psi[at], rows).max(axis=0))
        return best

    begin = int(np.searchsorted(e.updates, 0.0, side="right"))  # they are counted: none comes before the first
    middle = (begin + exam.evaluations) // 2
    with outofcore.second_thread(exam.recording.samples) as second:
        later = second.submit(largest, middle, exam.evaluations)
        best = np.maximum(largest(begin, middle), later.result())
    needed = required_noncentrality(exam.pipeline.bank.n, baseline.thresholds.statistic)
    smallest = {
        name: float(np.sqrt(needed / bound)) if bound > 0.0 else np.inf
        for name, bound in zip(promised, best, strict=True)
    }
    model, fit = baseline.residual, exam.whole_fit
    judged = [] if exam.pressures is None else [exam.pressures.model.detectable_changes]
    if model is not None and fit is not None and np.isfinite([*fit.deviation, *exam.residual_ratios]).all():
        judged.append(model.detectable_changes(baseline.fault_directions, fit.covariance))
    for sizes in judged:
        smallest = {name: min(size, sizes.get(name, np.inf)) for name, size in smallest.items()}
    if exam.along is not None and exam.along.std is not None:
        for name, per_warmth in changes_like_warmth(exam).items():
            smallest[name] = max(smallest.get(name, 0.0), exam.along.jump * per_warmth)
    return {name: (smallest[name], change) for name, change in promised.items()}


def power_warnings(exam: Examination, detectable: dict[str, tuple[float, float]]) -> list[DiagnosisWarning]:
    """Return warnings about what this recording could not have shown although the baseline promises it."""
    if (share := saturated_share(exam.baseline.loop, exam.recording)) > MAX_SATURATED_SHARE:
        reasons = [message("warning.saturated", share=share)]
    elif not detectable:
        reasons = [message("warning.no_promise")]
    elif all(np.isinf(smallest) for smallest, _ in detectable.values()):
        reasons = [message("warning.no_motion")]
    else:
        reasons = [
            message("warning.weak_never", parameter=parameter, promised=promised)
            if np.isinf(smallest)
            else message("warning.weak", parameter=parameter, smallest=smallest, promised=promised)
            for parameter, (smallest, promised) in detectable.items()
            if smallest > MAX_DETECTABLE_RATIO * promised
        ]
    return [warning_throughout(exam, "power", reason) for reason in reasons]


def estimate_warnings(exam: Examination) -> list[DiagnosisWarning]:
    """Return warnings about the estimate itself."""
    warnings = []
    e, t = exam.estimates, exam.recording.t
    if exam.replaced:
        warnings.append(warning_throughout(exam, "instrument", message("warning.instrument_failed")))
    if exam.skipped_share > MIN_SKIPPED_SHARE:
        replaced = exam.skipped_share > MAX_SKIPPED_SHARE
        key = "warning.instrument_replaced" if replaced else "warning.instrument"
        warnings.append(warning_throughout(exam, "instrument", message(key, share=exam.skipped_share)))
    if exam.baseline.axis is not None and exam.baseline.axis.changes is None:
        names = tuple(source.name for source in exam.baseline.sources)
        warnings.append(warning_throughout(exam, "changes", message("warning.no_changes", names=names)))
    if exam.noise_growth > 1.0:
        louder = message("warning.noise", factor=float(np.sqrt(exam.noise_growth)))
        warnings.append(warning_throughout(exam, "noise", louder))
    if len(e.updates) and e.updates[-1] > 0:
        last = int(e.index[int(np.searchsorted(e.updates, e.updates[-1]))])
        if t[-1] - t[last] > exam.baseline.loop.monitor.memory:
            from_s, to_s, count = float(t[last]), float(t[-1]), len(t) - last
            at_rest = message("warning.rest")
            warnings.append(DiagnosisWarning(kind="rest", from_s=from_s, to_s=to_s, count=count, description=at_rest))
    return warnings


def implausible_warnings(exam: Examination, best: Candidate) -> list[DiagnosisWarning]:
    """Return why a cause is not named: its coefficients are none that a machine can have, so u is no force there."""
    names = tuple(name for name, _, _ in negative_coefficients(exam.baseline))
    if not names or not best.faults or best.is_learned:
        return []
    return [warning_throughout(exam, "implausible", message("warning.implausible", names=names, cause=best.names))]


def warning_throughout(exam: Examination, kind: str, description: Message) -> DiagnosisWarning:
    """Return a warning about the whole recording."""
    from_s, to_s = float(exam.recording.t[0]), float(exam.recording.t[-1])
    return DiagnosisWarning(kind=kind, from_s=from_s, to_s=to_s, count=1, description=description)
