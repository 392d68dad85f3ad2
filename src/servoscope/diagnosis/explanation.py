"""The headline of a diagnosis and its reasons, as messages: what changed, what explains it and what does not."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import LoopError
from servoscope.core.messages import Message, message
from servoscope.core.number_format import ratio_digits
from servoscope.core.verdict import VerdictKind
from servoscope.detection.trace import Trace
from servoscope.diagnosis.change_words import change_messages, fault_label
from servoscope.diagnosis.ml_refit import is_equal_pair
from servoscope.diagnosis.result import VIBRATION, DiagnosisWarning, FaultInterval, RefitSummary
from servoscope.estimation.filter_bank import nominal_theta
from servoscope.evidence.examination import Examination
from servoscope.isolation.candidate import UNKNOWN, Candidate, CoefficientChange, FaultEstimate
from servoscope.models.plants import Plant

MIN_CHANGE_STD = 3.0  # standard deviations from which a value has changed
MAX_VALUES_LISTED = 3  # values, and rejected candidates
MAX_PROBABILITY_REJECTED = 0.01  # probability below which a candidate is rejected
MAX_FINE_CHANGE = 0.5  # relative change; a recording that shows only larger ones is no proof of health
MIN_LISTED_PROBABILITY = 0.05  # probability below which a second fault, or an explanation, is not mentioned


def undetermined_headline(reason: Message, point: str = "") -> Message:
    """Return the headline of a verdict that stays open for a reason."""
    at = message("diagnosis.point", name=point) if point else None
    return message("diagnosis.undetermined", point=at, reason=reason)


def build_headline(
    verdict: VerdictKind,
    intervals: Sequence[FaultInterval],
    detectable: Mapping[str, tuple[float, float]],
    warnings: Sequence[DiagnosisWarning],
    point: str = "",
    unwatched: Sequence[Message] = (),
) -> Message:
    """Return the verdict in one sentence.

    `detectable`: by parameter, the smallest change that the recording would have shown, and what the baseline promises;
    `unwatched`: changes of which it would have shown nothing.
    """
    at = message("diagnosis.point", name=point) if point else None
    if verdict == "healthy" and not intervals:
        sizes = sorted((size, parameter) for parameter, (size, _) in detectable.items())
        smallest = tuple(message("diagnosis.smallest", parameter=parameter, size=size) for size, parameter in sizes)
        if sizes and sizes[0][0] > MAX_FINE_CHANGE:
            return message("diagnosis.healthy_coarse", point=at, smallest=smallest)
        if not unwatched:
            return message("diagnosis.healthy", point=at, smallest=smallest)
        return message("diagnosis.healthy_limits", point=at, smallest=smallest, unwatched=tuple(unwatched))
    if verdict == "undetermined" or not intervals:
        reason = next(warning.description for warning in warnings if warning.kind in ("motion", "power"))
        return undetermined_headline(reason, point)
    interval = intervals[-1]
    if interval.end_interval_s is not None or len(intervals) > 1:
        return _timeline_headline("timeline" if verdict == "fault" else "repaired", intervals, at)
    since = _onset_message(interval)
    mimic = interval.refit.mimics[0].description if interval.refit and interval.refit.mimics else None
    if interval.faults:
        alike = message("diagnosis.mimic_alike", cause=mimic) if mimic else None
        first = interval.faults[0]
        if first.learned:
            values = {"names": _labels(fault.name for fault in interval.faults), **_size_values(first)}
            return message("diagnosis.fault_learned", point=at, since=since, mimic=alike, **values)
        changes = change_messages(interval.faults)
        return message("diagnosis.fault", point=at, changes=changes, since=since, mimic=alike)
    likely = [c for c in interval.candidates if c.probability >= MIN_LISTED_PROBABILITY]
    if likely[0].name == UNKNOWN and (likely[0].probability >= 0.5 or len(likely) == 1):
        instead = message("diagnosis.mimic_instead", cause=mimic) if mimic else None
        if interval.refit:
            return message("diagnosis.unknown", point=at, since=since, mimic=instead)
        return message("diagnosis.unknown_singles", point=at, since=since, mimic=instead)
    return _ambiguous_headline(likely, at, since)


def unwatched_changes(plant: Plant, detectable: Mapping[str, tuple[float, float]]) -> tuple[Message, ...]:
    """Return the changes of which a healthy verdict says nothing: without a size that would have shown."""
    hidden = [
        fault.parameter for fault in plant.faults if not np.isfinite(detectable.get(fault.parameter, (np.inf,))[0])
    ]
    parameters = tuple(message("cause.change_of", parameter=parameter) for parameter in dict.fromkeys(hidden))
    return (*parameters, *(message(f"cause.{kind}") for kind in plant.unwatched))


def _timeline_headline(key: str, intervals: Sequence[FaultInterval], at: Message | None) -> Message:
    """Say what happened from when to when, and whether it is over."""
    last = intervals[-1]
    now = None if last.end_s is None else message("diagnosis.healed", t=last.end_s)
    return message(f"diagnosis.{key}", point=at, stretches=tuple(map(_stretch_message, intervals)), now=now)


def _stretch_message(interval: FaultInterval) -> Message:
    assert interval.onset_s is not None
    begin = interval.onset_s[1]
    if interval.from_start:
        when = message(
            "diagnosis.stretch_start" if interval.end_s is None else "diagnosis.stretch_until", to_s=interval.end_s
        )
    elif interval.end_s is None:
        when = message("diagnosis.stretch_since", from_s=begin)
    else:
        when = message("diagnosis.stretch_when", from_s=begin, to_s=interval.end_s)
    if not interval.faults and interval.coefficients:
        changes = (
            message("diagnosis.stretch_size", parameter=moved.name, **_size_values(moved))
            for moved in interval.coefficients
        )
        return message("diagnosis.stretch_moved", sizes=tuple(changes), when=when)
    if not interval.faults:
        best = interval.candidates[0]
        return message("diagnosis.stretch_open", names=_labels(best.names), probability=best.probability, when=when)
    names = _labels(fault.name for fault in interval.faults)
    sizes = tuple(
        message("diagnosis.stretch_size", parameter=fault.parameter, **_size_values(fault)) for fault in interval.faults
    )
    return message("diagnosis.stretch", names=names, sizes=sizes, when=when)


def _labels(names: Iterable[str]) -> tuple[str, ...]:
    return tuple(map(fault_label, names))


def _onset_message(interval: FaultInterval) -> Message | None:
    if interval.onset_s is None:
        return None
    if interval.from_start:
        return message("diagnosis.since_start")
    refit = interval.refit
    growth = message("diagnosis.growth", over_s=refit.over_s) if refit is not None and refit.drifting else None
    return message("diagnosis.since", t=interval.onset_s[1], growth=growth)


def _ambiguous_headline(likely: Sequence[Candidate], at: Message | None, since: Message | None) -> Message:
    """Say which explanations remain, and which parameters they confuse."""
    known = [c for c in likely if c.name != UNKNOWN]
    unknown = [message("diagnosis.candidate_unknown", probability=c.probability) for c in likely if c.name == UNKNOWN]
    listed = [message("diagnosis.candidate", names=_labels(c.names), probability=c.probability) for c in known]
    if len(known) == 1 and unknown:
        return message("diagnosis.fault_or_unknown", point=at, since=since, candidate=listed[0], unknown=unknown[0])
    if len(known) == 1:
        return message("diagnosis.fault_uncertain", point=at, since=since, candidate=listed[0])
    pairs = [{fault.parameter for fault in c.faults} for c in known if len(c.faults) > 1]
    every = [parameter for pair in pairs for parameter in pair]
    confused = sorted(parameter for parameter in set(every) if every.count(parameter) < len(pairs))
    values = {"point": at, "since": since, "candidates": (*listed, *unknown)}
    if len(pairs) == len(known):
        return message("diagnosis.fault_ambiguous_pairs", parameters=tuple(confused), **values)
    return message("diagnosis.fault_ambiguous", **values)


def _size_values(fault: FaultEstimate | CoefficientChange) -> dict[str, float | str]:
    low, high = fault.interval
    return {"ratio": fault.ratio, "low": low, "high": high, "digits": ratio_digits(fault.ratio, low, high)}


def _size_messages(faults: Sequence[FaultEstimate]) -> tuple[Message, ...]:
    first, *others = faults
    if first.mass_kg is not None:
        mass, low, high = first.mass_kg
        size = message(
            "diagnosis.size_mass",
            mass=mass,
            mass_low=low,
            mass_high=high,
            parameter=first.parameter,
            **_size_values(first),
        )
    else:
        size = message("diagnosis.size", parameter=first.parameter, **_size_values(first))
    return (
        size,
        *(message("diagnosis.size_next", parameter=other.parameter, **_size_values(other)) for other in others),
    )


def build_reasons(exam: Examination, trace: Trace, interval: FaultInterval) -> tuple[Message, ...]:
    """Return the explanation of an alarm; `trace`: the evaluation that is explained, without bias."""
    reasons = (
        _size_reason(interval),
        _alarm_reason(exam, interval),
        _coefficients_reason(exam, trace),
        _response_reason(exam, trace),
        _fit_reason(interval.candidates, interval.refit),
        _rejection_reason(exam, trace, interval.candidates),
        _second_fault_reason(interval.candidates),
        _equal_pairs_reason(exam.baseline.plant, interval.candidates),
        _mimics_reason(interval.candidates, interval.refit),
    )
    return tuple(reason for reason in reasons if reason is not None)


def _size_reason(interval: FaultInterval) -> Message | None:
    if not interval.faults or interval.faults[0].learned:
        return None
    return message("diagnosis.sizes", sizes=_size_messages(interval.faults))


def _alarm_reason(exam: Examination, interval: FaultInterval) -> Message | None:
    if interval.detected_at_s is None:
        return None  # the alarm was there already
    if interval.candidates[0].name == VIBRATION:
        return message("diagnosis.alarm_vibration", t=interval.detected_at_s)
    # a change of an axis may be detected after the last evaluation
    sample = np.searchsorted(exam.recording.t, interval.detected_at_s)
    first = min(int(np.searchsorted(exam.estimates.index, sample)), exam.evaluations - 1)
    if exam.estimates.level[first] >= 1.0:
        return message("diagnosis.alarm_cusum", t=interval.detected_at_s)
    if exam.pressures is not None and exam.pressures.excess > 1.0:
        return message("diagnosis.alarm_pressures", excess=exam.pressures.excess)
    value, limit = float(exam.statistic[first]), exam.baseline.thresholds.statistic
    if value <= limit:  # then the other tests alone may have raised it
        excess = float(np.nanmax(exam.residual_ratios, initial=0.0))
        if exam.change is None and excess > 1.0:
            kind = ("residual", "shift", "fit")[int(np.nanargmax(exam.residual_ratios))]
            return message(f"diagnosis.alarm_{kind}", excess=excess)
        kind = "cusum" if exam.change is None else "change"
        return message(f"diagnosis.alarm_{kind}", t=interval.detected_at_s)
    return message("diagnosis.alarm_t2", t=interval.detected_at_s, value=value, limit=limit)


def _distance_message(deviations: float, first: bool) -> Message:
    """Return a number of standard deviations; the first of several spells out the unit."""
    return message("diagnosis.deviations" if first else "diagnosis.deviations_next", value=deviations)


def _largest_changes(
    names: Sequence[str | Message],
    values: Sequence[float],
    expected: Sequence[float],
    std: Sequence[float],
    units: Sequence[str],
) -> tuple[Message, ...]:
    """Return what changed most, the most significant first."""
    by = [abs(v - e) / s if s > 0.0 else 0.0 for v, e, s in zip(values, expected, std, strict=True)]
    most = sorted((i for i in range(len(by)) if by[i] >= MIN_CHANGE_STD), key=lambda i: -by[i])[:MAX_VALUES_LISTED]
    return tuple(
        message(
            "diagnosis.risen" if values[i] > expected[i] else "diagnosis.fallen",
            name=names[i],
            value=values[i],
            expected=expected[i],
            unit=message("diagnosis.unit", unit=units[i]) if units[i] else None,
            distance=_distance_message(by[i], i == most[0]),
        )
        for i in most
    )


def _coefficients_reason(exam: Examination, trace: Trace) -> Message:
    plant, std = exam.baseline.plant, np.sqrt(np.diag(trace.covariance[0])).tolist()
    units = plant.coefficient_units if plant.units[1] else ("",) * len(std)
    changes = _largest_changes(trace.names, trace.theta[0].tolist(), trace.expected[0].tolist(), std, units)
    t = float(trace.t[0])
    return (
        message("diagnosis.coefficients", t=t, changes=changes)
        if changes
        else message("diagnosis.coefficients_unmoved", t=t)
    )


def _response_reason(exam: Examination, trace: Trace) -> Message | None:
    of_y, of_u = exam.baseline.plant.units
    names: list[Message] = []
    for f in trace.ifrf.frequencies.tolist():
        names += [message("diagnosis.real_part", hz=f), message("diagnosis.imaginary_part", hz=f)]
    values, expected = (H[0].view(np.float64).tolist() for H in (trace.ifrf.H, trace.ifrf_expected.H))
    std = np.sqrt(np.diagonal(trace.ifrf.covariance[0], axis1=-2, axis2=-1)).ravel().tolist()
    units = [f"{of_u}/{of_y}" if of_u else ""] * len(names)
    changes = _largest_changes(names, values, expected, std, units)
    return message("diagnosis.response", changes=changes) if changes else None


def _fit_reason(candidates: Sequence[Candidate], refit: RefitSummary | None) -> Message | None:
    """Say how well the closest explanation fits."""
    best = next((c for c in candidates if c.faults), None)
    if refit is None or best is None:
        return None
    values = {"from_s": refit.from_s, "to_s": refit.to_s, "misfit": refit.misfit, "limit": refit.limit}
    if refit.misfit > refit.limit:
        return message("diagnosis.unexplained", **values)
    return message("diagnosis.explained", names=_labels(best.names), **values)


def _rejection_reason(exam: Examination, trace: Trace, candidates: Sequence[Candidate]) -> Message | None:
    singles = [c for c in candidates[1:] if len(c.faults) == 1 and c.probability < MAX_PROBABILITY_REJECTED]
    closest = sorted(singles, key=lambda c: c.misfit or 0.0)[:MAX_VALUES_LISTED]
    spelled = next((c for c in closest if c.misfit), None)
    listed = tuple(_rejection(exam, trace, c, c is spelled) for c in closest)
    return message("diagnosis.rejected", candidates=listed) if closest else None


def _rejection(exam: Examination, trace: Trace, other: Candidate, first: bool) -> Message:
    """Say by how much a candidate fits worse, and where it shows."""
    (fault,) = other.faults
    if fault.parameter == fault.name:
        size = message("diagnosis.rejected_size", ratio=fault.ratio)
    elif fault.learned:
        size = message("diagnosis.rejected_size_learned", ratio=fault.ratio)
    else:
        size = message("diagnosis.rejected_size_parameter", parameter=fault.parameter, ratio=fault.ratio)
    values = {"name": fault_label(other.name), "size": size}
    if other.misfit:
        values["distance"] = _distance_message(float(np.sqrt(other.misfit)), first)
    coefficient, sign = _worst_coefficient(exam, trace, other)
    if not coefficient:
        return message("diagnosis.rejected_fit" if other.misfit else "diagnosis.rejected_closest", **values)
    values["coefficient"] = coefficient
    if sign > 0.0:
        return message("diagnosis.rejected_high" if other.misfit else "diagnosis.rejected_closest_high", **values)
    return message("diagnosis.rejected_low" if other.misfit else "diagnosis.rejected_closest_low", **values)


def _worst_coefficient(exam: Examination, trace: Trace, candidate: Candidate) -> tuple[str, float]:
    """Return the coefficient that a candidate misses most, and by how many standard deviations; or nothing."""
    theta = _candidate_theta(exam, candidate)
    if theta is None:
        return "", 0.0
    off = (theta - trace.theta[0]) / np.sqrt(np.diag(trace.covariance[0]))
    worst = int(np.argmax(np.abs(off)))
    return (trace.names[worst], float(off[worst])) if abs(off[worst]) >= MIN_CHANGE_STD else ("", 0.0)


def _candidate_theta(exam: Examination, candidate: Candidate) -> FloatArray | None:
    if not exam.baseline.loop.plant.has_physics or candidate.is_learned:
        return None
    ratios = {fault.parameter: fault.ratio for fault in candidate.faults}
    try:
        return nominal_theta(exam.pipeline.loop, exam.baseline.plant.with_ratios(ratios))
    except LoopError:
        return None


def _second_fault_reason(candidates: Sequence[Candidate]) -> Message | None:
    best = candidates[0]
    pairs = [c for c in candidates[1:] if len(c.faults) > 1 and set(best.names) < set(c.names)]
    if not pairs or best.name == UNKNOWN or max(c.probability for c in pairs) >= MIN_LISTED_PROBABILITY:
        return None
    others = sorted({name for pair in pairs for name in pair.names} - set(best.names))
    return message("diagnosis.second_fault", names=_labels(others))


def _equal_pairs_reason(plant: Plant, candidates: Sequence[Candidate]) -> Message | None:
    """Name the pairs that do the same to u and y as the fault, which takes one parameter less."""
    pairs = tuple(
        message(
            "diagnosis.equal_pair",
            sizes=tuple(
                message("diagnosis.rejected_size_parameter", parameter=f.parameter, ratio=f.ratio) for f in c.faults
            ),
        )
        for c in candidates[1:]
        if is_equal_pair(plant, candidates[0], c)
    )
    return message("diagnosis.equal_pairs", pairs=pairs) if pairs else None


def _mimics_reason(candidates: Sequence[Candidate], refit: RefitSummary | None) -> Message | None:
    if refit is None or not refit.mimics:
        return None
    mimics = tuple(message("diagnosis.mimic", cause=mimic.description, size=mimic.size) for mimic in refit.mimics)
    unknown = candidates[0].name == UNKNOWN
    return message("diagnosis.mimics_instead" if unknown else "diagnosis.mimics", mimics=mimics)
