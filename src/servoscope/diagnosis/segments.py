"""Several changes in one recording of an axis, as sums find them: when it was not healthy, and what explains that."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from servoscope.core.verdict import Explanation, Segment
from servoscope.diagnosis.ml_refit import MIN_PAIR_PROBABILITY
from servoscope.diagnosis.result import FaultInterval
from servoscope.evidence.examination import Examination
from servoscope.isolation.candidate import UNKNOWN, Candidate, CoefficientChange, FaultEstimate
from servoscope.models.plants import Plant
from servoscope.models.plants.axis import AxisPlant

MIN_MOVED_STD = 2.0  # standard deviations from which a coefficient has moved


def segment_intervals(exam: Examination, sure: float) -> tuple[FaultInterval, ...]:
    """Return the times that are not healthy, each with its explanations; named with a probability of `sure`."""
    change = exam.change
    assert change is not None
    segments, t = change.segments, exam.recording.t
    intervals: list[FaultInterval] = []
    for k, segment in enumerate(segments):
        if not segment.changed:
            continue
        candidates, last = _candidates(segment, _plant(exam)), segment is segments[-1]
        best, onset = candidates[0], segment.begin_s
        detected = float(t[change.detected]) if k < 2 and not intervals else onset[2]
        intervals.append(
            FaultInterval(
                # the alarm of a change that follows another one was there already
                detected_at_s=None if k and segments[k - 1].changed else detected,
                onset_s=onset,
                end_s=None if last else segment.end_s[1],
                end_interval_s=None if last else segment.end_s,
                from_start=k == 0,
                probability=best.probability,
                faults=best.faults if best.probability >= sure and best.name != UNKNOWN else (),
                candidates=candidates,
                coefficients=moved_coefficients(exam, segment),
            )
        )
    return tuple(intervals)


def moved_coefficients(exam: Examination, segment: Segment) -> tuple[CoefficientChange, ...]:
    """Return the coefficients of an axis that differ from healthy ones in a segment, with their 95 % intervals."""
    axis = exam.baseline.axis
    assert axis is not None and axis.changes is not None
    std = np.sqrt(np.diag(segment.covariance))
    moved = []
    for name, healthy, off, spread in zip(axis.changes.names, axis.changes.theta, segment.deviation, std, strict=True):
        if name in axis.coefficients and name != "offset" and abs(off) > MIN_MOVED_STD * spread and healthy:
            low, ratio, high = (
                1.0 + float(off + way * 1.96 * spread * np.sign(healthy)) / healthy for way in (-1, 0, 1)
            )
            moved.append(CoefficientChange(name=name, ratio=ratio, interval=(low, high)))
    return tuple(moved)


def _plant(exam: Examination) -> AxisPlant:
    assert exam.baseline.axis is not None and isinstance(exam.baseline.loop.plant, AxisPlant)
    return exam.baseline.axis.plant(exam.baseline.loop.plant)


def _candidates(segment: Segment, plant: Plant) -> tuple[Candidate, ...]:
    """Return what explains a segment, the most probable first; causes that no recording can tell apart share."""
    candidates = [
        Candidate(name=UNKNOWN, probability=told.probability)
        if not told.causes
        else _candidate(rival, plant, told.probability / len(rivals))
        for told in segment.explanations
        for rivals in ([told, *_rivals(told, plant)],)
        for rival in rivals
    ]
    listed = [candidate for candidate in candidates if candidate.probability >= MIN_PAIR_PROBABILITY]
    if all(candidate.name != UNKNOWN for candidate in listed):
        unlisted = 1.0 - sum(candidate.probability for candidate in listed)
        listed.append(Candidate(name=UNKNOWN, probability=max(unlisted, 0.0)))
    return tuple(sorted(listed, key=lambda candidate: -candidate.probability))


def _rivals(told: Explanation, plant: Plant) -> Iterator[Explanation]:
    """Yield the explanations that are alike and move other parameters, not the same ones in other words."""

    def moved(explanation: Explanation) -> frozenset[str]:
        return frozenset(plant.expand_rays({_parameter(plant, cause): 1.0 for cause in explanation.causes}))

    known = {moved(told)}
    for other in told.alike:
        if (parameters := moved(other)) not in known:
            known.add(parameters)
            yield other


def _parameter(plant: Plant, cause: str) -> str:
    return next((fault.parameter for fault in plant.all_faults if fault.name == cause), cause)


def _candidate(told: Explanation, plant: Plant, probability: float) -> Candidate:
    faults = tuple(
        FaultEstimate(name=cause, parameter=_parameter(plant, cause), ratio=ratio, interval=(low, high)).weighed(plant)
        for cause, (low, ratio, high) in told.ratios.items()
    )
    covariance = tuple(map(tuple, told.covariance.tolist())) if len(faults) > 1 else None
    return Candidate(name=" + ".join(told.causes), probability=probability, faults=faults, covariance=covariance)
