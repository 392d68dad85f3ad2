"""The refit of the seconds around an onset as part of a diagnosis, and where it contradicts the recursion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from servoscope.core.messages import message
from servoscope.core.number_format import ratio_digits
from servoscope.detection.onset import Onset
from servoscope.diagnosis.result import VIBRATION, DiagnosisWarning, FaultInterval, Mimic, RefitSummary
from servoscope.diagnosis.warnings import warning_throughout
from servoscope.evidence.examination import Examination
from servoscope.isolation.candidate import UNKNOWN, Candidate, FaultEstimate
from servoscope.isolation.ml import (
    MAX_WINDOW_SAMPLES,
    Hypothesis,
    OnsetEstimate,
    RefitResult,
    find_other_causes,
    fit_hypotheses,
)
from servoscope.isolation.ml.axis_vibration import AxisVibration
from servoscope.isolation.ml.search import OUTSIDE_PRIOR
from servoscope.models.plants import Plant

MIN_PAIR_PROBABILITY = 1e-3  # probability from which a pair of faults is listed
MAX_EQUAL_MISFIT = 6.0  # squared standard deviations by which a pair may fit worse: its likelihood is a twentieth
MAX_SIZE_DISTANCE = 3.0  # standard deviations between two sizes that are called different


def refit_recording(
    exam: Examination, onset: Onset, alarm: int, last: int, progress: Callable[[], None]
) -> RefitResult | None:
    """Refit the seconds around an onset; None where the exact predictor does not even explain healthy recordings."""
    exact, axis = exam.baseline.exact, exam.baseline.axis
    if axis is None and (exact is None or exact.misfit > 1.0):
        return None
    most = MAX_WINDOW_SAMPLES * (1 if axis is None else axis.stride)
    begin = max(onset.sample - most, 0)
    near = exam.recording.rows(slice(begin, onset.sample + most))
    hypotheses = fit_hypotheses(exam.baseline, near, onset.sample - begin, alarm - begin, last - begin, progress)
    return replace(hypotheses, window=replace(hypotheses.window, first_sample=hypotheses.window.first_sample + begin))


def vibration_interval(exam: Examination, vibration: AxisVibration) -> FaultInterval:
    """Return the interval of an axis that swings or rattles: no coefficient changed, so nothing is refitted."""
    t = exam.recording.t
    low, likely, high = (float(t[k]) for k in vibration.onset)
    fault = FaultEstimate(name=VIBRATION, parameter=VIBRATION, ratio=vibration.ratio, interval=vibration.interval)
    named = Candidate(name=VIBRATION, probability=1.0 - OUTSIDE_PRIOR, faults=(fault,))
    assert exam.change is not None
    return FaultInterval(
        detected_at_s=float(t[exam.change.detected]),
        onset_s=(low, likely, high),
        probability=named.probability,
        faults=(fault,),
        candidates=(named, Candidate(name=UNKNOWN, probability=OUTSIDE_PRIOR)),
    )


def refit_candidates(refined: RefitResult) -> tuple[Candidate, ...]:
    """Return all single faults, the pairs worth listing and ``unknown``, the most probable first."""
    least = min(hypothesis.fitted.cost for hypothesis in refined.hypotheses)
    plant = refined.window.plant
    every = [_candidate(hypothesis, plant, least, refined.noise_variance) for hypothesis in refined.hypotheses]
    candidates = [
        candidate
        for candidate in every
        if len(candidate.faults) == 1
        or candidate.probability >= MIN_PAIR_PROBABILITY
        or is_equal_pair(plant, every[0], candidate)
    ]
    candidates.append(Candidate(name=UNKNOWN, probability=refined.unknown_probability))
    # where probabilities vanish, the closest comes first
    return tuple(sorted(candidates, key=lambda candidate: (-candidate.probability, candidate.misfit or 0.0)))


def is_equal_pair(plant: Plant, best: Candidate, other: Candidate) -> bool:
    """Return whether a pair of other parameters does the same to u and y as a fault that takes one parameter."""
    if len(best.faults) != 1 or len(other.faults) < 2 or best.misfit is None or other.misfit is None:
        return False
    own = plant.expand_rays({fault.parameter: 1.0 for fault in best.faults})
    return other.misfit < best.misfit + MAX_EQUAL_MISFIT and own.keys().isdisjoint(f.parameter for f in other.faults)


def refit_onset(refined: RefitResult, exam: Examination, outside: OnsetEstimate | None = None) -> Onset:
    """Return the onset in the recording's time, of the refit or of the cause outside the list that explains it."""
    t, first, stride = exam.recording.t, refined.window.first_sample, refined.window.stride
    onset = outside or refined.onset
    last = len(t) - 1
    low, likely, high = (min(first + k * stride, last) for k in (onset.low, onset.profile.onset, onset.high))
    high = min(high + stride - 1, last)  # it may come anywhere within a sample of the window
    # the first changed sample ends the interval in which the change came
    return Onset(float(t[max(low - stride, 0)]), float(t[likely]), float(t[high]), likely)


def summarise_refit(
    refined: RefitResult,
    exam: Examination,
    recursive: tuple[Candidate, ...],
    first: int = 0,
    outside: OnsetEstimate | None = None,
) -> RefitSummary:
    """Return the part of a refit that a diagnosis keeps; its samples are counted from sample `first` on.

    `outside`: when a cause outside the list of faults came that explains everything.
    """
    t, window = exam.recording.t, refined.window
    over = refined.onset.profile.duration
    of_y, of_u = exam.baseline.plant.units
    units = {"of y": of_y or "in units of y", "of u": of_u or "in units of u"}
    return RefitSummary(
        from_s=float(t[first + window.first_sample]),
        to_s=float(t[first + window.first_sample + (window.samples - 1) * window.stride]),
        over_s=over / window.sample_rate if over > refined.onset.high - refined.onset.low else 0.0,
        noise=float(np.sqrt(refined.noise_variance)),
        misfit=refined.goodness.statistic,
        limit=refined.goodness.limit,
        recursive=recursive,
        mimics=tuple(
            Mimic(name=cause.name, description=cause.cause, value=cause.value, unit=units.get(cause.unit, cause.unit))
            for cause in find_other_causes(refined, outside.profile if outside else None)
        ),
    )


def disagreement_warnings(
    exam: Examination, candidates: tuple[Candidate, ...], refit: RefitSummary, sure: float
) -> list[DiagnosisWarning]:
    """Return a warning where the refit and the recursion contradict each other, both with probability `sure`."""
    candidate, other = candidates[0], refit.recursive[0]
    if min(candidate.probability, other.probability) < sure or (len(candidate.faults) > 1 and other.name == UNKNOWN):
        return []  # the recursion knows no pairs
    reason = message("warning.disagreement_recency")
    if len(candidate.faults) > 1:
        reason = message("warning.disagreement_pairs")
    elif refit.over_s > 0.0:
        reason = message("warning.disagreement_growth", over_s=refit.over_s)
    if candidate.name != other.name:
        messages = [message("warning.disagreement_faults", refit=candidate.names, recursion=other.names, reason=reason)]
    else:
        messages = [
            message(
                "warning.disagreement_size",
                parameter=a.parameter,
                refit=a.ratio,
                refit_digits=ratio_digits(a.ratio, *a.interval),
                recursion=b.ratio,
                recursion_digits=ratio_digits(b.ratio, *b.interval),
                reason=reason,
            )
            for a, b in zip(candidate.faults, other.faults, strict=True)
            if size_distance_std(a, b) > MAX_SIZE_DISTANCE
        ]
    return [warning_throughout(exam, "disagreement", text) for text in messages[-1:]]


def size_distance_std(a: FaultEstimate, b: FaultEstimate) -> float:
    """Return how many standard deviations the logarithms of two sizes are apart, as if they shared no data."""
    spread = float(np.hypot(*(np.log(fault.interval[1] / fault.interval[0]) / 3.92 for fault in (a, b))))
    return abs(float(np.log(a.ratio / b.ratio))) / max(spread, 1e-12)


def _candidate(hypothesis: Hypothesis, plant: Plant, least: float, noise_variance: float) -> Candidate:
    fitted = hypothesis.fitted
    ratios, intervals = np.exp(fitted.x), np.exp(np.array(hypothesis.evidence.intervals))
    faults = tuple(
        FaultEstimate(
            name=fault.name, parameter=fault.parameter, ratio=float(ratio), interval=(float(low), float(high))
        ).weighed(plant)
        for fault, ratio, (low, high) in zip(fitted.faults, ratios, intervals, strict=True)
    )
    covariance = tuple(tuple(row) for row in (noise_variance * fitted.covariance).tolist()) if len(faults) > 1 else None
    return Candidate(
        name=hypothesis.name,
        probability=hypothesis.probability,
        faults=faults,
        misfit=max(fitted.cost - least, 0.0) / noise_variance,
        covariance=covariance,
    )
