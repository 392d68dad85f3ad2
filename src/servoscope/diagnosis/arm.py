"""The diagnosis of an arm: what changed, in which joint, by how much and since when; pushes; what cannot be told."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from servoscope.baseline.arm import SERVICE_ODDS, UNKNOWN, ArmBaseline, ArmCause
from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.blas import with_one_blas_thread
from servoscope.core.messages import Message, message
from servoscope.detection.arm_events import ArmEvent, find_events, outside_events, outside_torque
from servoscope.detection.arm_evidence import INTERVAL, MIN_END_BLOCKS, CauseEvidence, ChangeEvidence, ChangeTest
from servoscope.diagnosis.result import Diagnosis, DiagnosisWarning, FaultInterval, FinalCoefficient, Verdict
from servoscope.estimation.arm_regression import (
    MIN_MOVING_S,
    ArmSignals,
    Information,
    block_information,
    filter_arm_log,
)
from servoscope.isolation.candidate import Candidate, FaultEstimate
from servoscope.signals.readers.arm_log import ArmRecording

MIN_CERTAINTY = 0.9  # probability from which a cause is named
MIN_EXPLAINED = 0.5  # share of the evidence of an unknown change from which one cause is named all the same
MIN_PROBABILITY = 0.01  # of a cause that is listed
MIN_RIVAL_PROBABILITY = 0.05  # of a cause that the headline of an open answer lists
MAX_FACTOR = 20.0  # power of ten up to which evidence is written
ONSET_TAIL = 0.025  # probability on either side of an onset's interval
ONSET_STEP_S = 0.2  # to which an onset is found: the filters leave no more
MAX_ONSET_STEPS = 60  # of an onset's interval, longer ones where that is long
Rows = tuple[
    FloatArray, FloatArray, FloatArray
]  # times, weighted columns and residuals, as `block_information` has them
UNITS = {"offset": "N m", "counterbalance": "N m", "gear ripple": "N m", "encoder offset": "rad"}


class ArmExamination(NamedTuple):
    """What the diagnosis of an arm rests on, for reports."""

    signals: ArmSignals
    outside: FloatArray  # torque that friction cannot explain, over half a second (n, M) [N m]
    evidence: ChangeEvidence | None
    events: list[ArmEvent]


@with_one_blas_thread
def diagnose_arm(baseline: ArmBaseline, recording: ArmRecording) -> Diagnosis:
    """Say what changed in an arm, in which joint, by how much and since when; raises what reading and filtering do."""
    return examine_arm(baseline, recording)[0]


def examine_arm(baseline: ArmBaseline, recording: ArmRecording) -> tuple[Diagnosis, ArmExamination]:
    """Return the diagnosis of a recording, and what it rests on."""
    model, noise = baseline.model, np.array(baseline.noise)
    signals = filter_arm_log(recording, model)
    design, theta = baseline.design(signals), np.array(baseline.theta)
    residual = signals.tau - np.einsum("jpm,p->jm", design, theta)
    outside = outside_torque(signals, design, residual, model, theta)
    events = find_events(signals.t, outside, np.array(baseline.event_limits) * noise, model.arm.names)
    columns = np.concatenate([design, baseline.deviations(signals, design)], axis=1)
    moved, rows, information, evidence = _weigh(baseline, signals, columns, residual, events)
    if events and evidence is not None and evidence.log_factor > baseline.limit:
        # what differs without them is a change, of which they are the peaks
        events = []
        moved, rows, information, evidence = _weigh(baseline, signals, columns, residual, events)
    warnings = [*_event_warnings(events), *_still_warnings(model.arm.names, moved, recording)]
    if evidence is None or information is None:
        headline = message("arm.undetermined_pushed" if events else "arm.undetermined")
        return _result(recording, "undetermined", headline, warnings), ArmExamination(signals, outside, None, events)
    examination = ArmExamination(signals, outside, evidence, events)
    parameters = _coefficients(baseline, information)
    if evidence.log_factor <= baseline.limit:
        smallest = _smallest_changes(baseline, information, moved)
        headline = message("arm.healthy_pushed" if events else "arm.healthy", smallest=smallest)
        return _result(recording, "healthy", headline, warnings, parameters), examination
    verdict, headline, interval, reasons = _explain(baseline, evidence, rows)
    if interval.faults and interval.faults[0].mass_kg is not None and baseline.loop.gains == "data sheet":
        warnings.append(_warning("relative", recording.t[0], recording.t[-1], message("arm.relative_mass")))
    checks = tuple(message(f"arm.check.{kind.replace(' ', '_')}") for kind in _named_kinds(interval))
    diagnosis = _result(recording, verdict, headline, warnings, parameters)
    update = {"intervals": (interval,), "reasons": reasons, "checks": checks if verdict == "fault" else ()}
    return diagnosis.model_copy(update=update), examination


def _weigh(
    baseline: ArmBaseline,
    signals: ArmSignals,
    columns: FloatArray,
    residual: FloatArray,
    events: list[ArmEvent],
) -> tuple[BoolArray, Rows, Information | None, ChangeEvidence | None]:
    """Return which joints moved (n,) outside of events, the weighted rows, and what they say; None where none did."""
    clear = outside_events(signals.t, events)
    moved = (signals.moving & clear).sum(1) * float(np.median(np.diff(signals.t))) >= MIN_MOVING_S
    w = signals.moving * clear / (np.array(baseline.noise) * np.sqrt(baseline.inflation))[:, None]
    rows = signals.t, columns * w[:, None], residual * w
    if not moved.any():
        return moved, rows, None, None
    information = block_information(*rows)
    return moved, rows, information, _change_test(baseline, information).weigh()


def _change_test(baseline: ArmBaseline, information: Information, causes: Sequence[ArmCause] = ()) -> ChangeTest:
    scale, drift = np.array(baseline.scale), np.array(baseline.drift)
    return ChangeTest(information, baseline.random_effect, causes or baseline.causes, scale, drift)


def _result(
    recording: ArmRecording,
    verdict: Verdict,
    headline: Message,
    warnings: Sequence[DiagnosisWarning],
    parameters: dict[str, FinalCoefficient] | None = None,
) -> Diagnosis:
    return Diagnosis(
        recording=recording.name,
        samples=recording.rows,
        duration_s=recording.duration_s,
        verdict=verdict,
        headline=headline,
        parameters=parameters or {},
        ifrf=(),
        warnings=tuple(sorted(warnings, key=lambda warning: warning.from_s)),
    )


def _warning(kind: str, from_s: float, to_s: float, text: Message) -> DiagnosisWarning:
    return DiagnosisWarning(kind=kind, from_s=float(from_s), to_s=float(to_s), count=1, description=text)


def _event_warnings(events: Sequence[ArmEvent]) -> Iterator[DiagnosisWarning]:
    for event in events:
        text = message("arm.event", joints=event.joints, torque=event.torque, joint=event.joints[0])
        yield _warning("event", event.from_s, event.to_s, text)


def _still_warnings(names: Sequence[str], moved: BoolArray, recording: ArmRecording) -> Iterator[DiagnosisWarning]:
    still = [name for name, each in zip(names, moved, strict=True) if not each]
    if still:
        yield _warning("rest", recording.t[0], recording.t[-1], message("arm.still", joints=still))


def _coefficients(baseline: ArmBaseline, information: Information) -> dict[str, FinalCoefficient]:
    """Return friction and offset of each joint as the whole recording shows them."""
    covariance = np.linalg.inv(information.A.sum(0) + baseline.random_effect)
    shift, first = covariance @ information.g.sum(0), len(baseline.theta)
    found = {}
    for cause in baseline.causes:
        name = f"{cause.joint}.{cause.parameter}"
        if name in baseline.names and len(cause.columns) == 1:
            pair = [baseline.names.index(name), first + cause.columns[0]]
            value = baseline.theta[pair[0]]
            std = float(np.sqrt(covariance[np.ix_(pair, pair)].sum()))
            found[name] = FinalCoefficient(value=value + float(shift[pair].sum()), std=std, nominal=value)
    return found


def _smallest_changes(baseline: ArmBaseline, information: Information, moved: BoolArray) -> list[Message]:
    """Return the smallest payload and friction that would have been found in this recording from its start on."""
    first, scale = len(baseline.theta), np.array(baseline.scale)
    A = information.A.sum(0)
    known = A - A @ np.linalg.solve(A + baseline.random_effect, A)
    variance = 1.0 / np.maximum(np.diag(known)[first:], 1e-300) + np.array(baseline.drift) ** 2
    # of one column alone: c^2 / 2 over its variance has to exceed the limit and what the choice among causes, onsets
    # and sizes costs
    choice = sum(cause.odds for cause in baseline.causes) / SERVICE_ODDS * len(information.A)
    smallest = np.sqrt(2.0 * (baseline.limit + np.log(choice * np.sqrt(1.0 + scale**2 / variance))) * variance)
    messages = [message("arm.smallest_mass", mass=float(smallest[0]))] if smallest[0] < scale[0] else []
    for joint, moves in zip(baseline.model.arm.names, moved, strict=True):
        cause = next(cause for cause in baseline.causes if cause.joint == joint)
        healthy = abs(baseline.coefficient(f"{joint}.{cause.parameter}")[0])
        if moves and healthy > 0.0:
            messages.append(message("arm.smallest", joint=joint, size=float(smallest[cause.columns[0]]) / healthy))
    return messages


def _explain(
    baseline: ArmBaseline, evidence: ChangeEvidence, rows: Rows
) -> tuple[Verdict, Message, FaultInterval, tuple[Message, ...]]:
    """Return verdict, headline, interval and reasons of a change."""
    named = [index for index, cause in enumerate(evidence.causes) if cause.cause.kind != UNKNOWN]
    explained = evidence.causes[named[0]].log_factor / max(evidence.log_factor, 1e-9)
    remains = explained >= MIN_EXPLAINED and evidence.probability[named].sum() < 1.0 - MIN_RIVAL_PROBABILITY
    if remains:  # one cause explains most: what remains is told, and hides no name
        causes = tuple(evidence.causes[index] for index in named)
        logs = np.array([cause.log_factor for cause in causes])
        evidence = evidence._replace(causes=causes, probability=np.exp(logs - np.logaddexp.reduce(logs)))
    groups: dict[tuple[str, str], list[int]] = defaultdict(list)
    for index, cause_evidence in enumerate(evidence.causes):
        groups[cause_evidence.cause.kind, cause_evidence.cause.joint].append(index)
    odds = {key: float(evidence.probability[indices].sum()) for key, indices in groups.items()}
    ranked = sorted(odds, key=lambda key: -odds[key])
    best = evidence.causes[groups[ranked[0]][0]]
    onset, from_start = _onset(baseline, evidence, best, rows)
    since = message("diagnosis.since_start") if from_start else message("diagnosis.since", t=onset[1], growth=None)
    candidates = []
    for key in ranked:
        if odds[key] >= MIN_PROBABILITY:
            likeliest = evidence.causes[groups[key][0]]
            fault = _fault(baseline, likeliest)
            faults = () if fault is None else (fault,)
            candidates.append(Candidate(name=likeliest.cause.name, probability=odds[key], faults=faults))
    certain = odds[ranked[0]] >= MIN_CERTAINTY and best.cause.kind != UNKNOWN
    interval = FaultInterval(
        onset_s=onset,
        from_start=from_start,
        probability=odds[ranked[0]],
        faults=candidates[0].faults if certain else (),
        candidates=tuple(candidates),
    )
    factor = min(np.floor(evidence.log_factor / np.log(10.0)), MAX_FACTOR)
    reasons: tuple[Message, ...] = (message("arm.evidence", factor=float(factor), limit=float(np.exp(baseline.limit))),)
    reasons += (message("arm.remains"),) if remains else ()
    if certain and best.cause.kind == "payload" and baseline.loop.payload == "change":
        return "healthy", message("arm.payload_changed", size=_size(baseline, best), since=since), interval, reasons
    if certain:
        name = {"kind": best.cause.kind, "joint": _of(best.cause)}
        return "fault", message("arm.fault", **name, size=_size(baseline, best), since=since), interval, reasons
    if best.cause.kind == UNKNOWN:
        return "fault", message("arm.unknown", since=since), interval, reasons
    likely = [key for index, key in enumerate(ranked) if index < 2 or odds[key] >= MIN_RIVAL_PROBABILITY]
    rivals = [
        message("arm.rival", kind=kind, joint=_joint(joint), probability=odds[kind, joint]) for kind, joint in likely
    ]
    joints = sorted({joint for _, joint in likely if joint})
    told = message(
        "arm.would_tell_joints" if len(joints) > 1 else "arm.would_tell", joints=joints or [message("arm.last_link")]
    )
    return "fault", message("arm.ambiguous", rivals=rivals, since=since, told=told), interval, reasons


def _joint(name: str) -> Message | None:
    return message("arm.of_joint", joint=name) if name else None


def _of(cause: ArmCause) -> Message | None:
    return _joint(cause.joint)


def _named_kinds(interval: FaultInterval) -> list[str]:
    """Return the kinds of what is named, or may be."""
    likely = [candidate for candidate in interval.candidates if candidate.probability >= MIN_RIVAL_PROBABILITY]
    return list(dict.fromkeys(candidate.name.partition(" of ")[0] for candidate in likely))


def _onset(
    baseline: ArmBaseline, evidence: ChangeEvidence, best: CauseEvidence, rows: Rows
) -> tuple[tuple[float, float, float], bool]:
    """Return lower end, likeliest, upper end of the onset's 95 % interval [s], and whether it may be older."""
    (first, likely, last), from_start = _onset_interval(evidence.t, best.onset)
    if not from_start:  # again, in finer blocks
        step = max(ONSET_STEP_S, (last - first) / MAX_ONSET_STEPS)
        edges = np.arange(first, last + (MIN_END_BLOCKS + 1) * step, step)
        fine = _change_test(baseline, block_information(*rows, edges=edges), [best.cause]).weigh()
        (first, likely, last), _ = _onset_interval(fine.t, fine.causes[0].onset)
    return (first, likely, last), from_start


def _onset_interval(t: FloatArray, onset: FloatArray) -> tuple[tuple[float, float, float], bool]:
    """Return lower end, likeliest, upper end of an onset [s] by its blocks, and whether it may be the start."""
    below = onset.cumsum()
    ends = np.searchsorted(below, [ONSET_TAIL, 1.0 - ONSET_TAIL])
    low, high = (min(int(end), below.size - 1) for end in ends)
    # a change within a block: either this or the next is the first that is better explained with it
    first, last = t[max(0, low - 1)], t[min(high + 1, below.size - 1)]
    return (float(first), float(t[int(onset.argmax())]), float(last)), low == 0


def _fault(baseline: ArmBaseline, found: CauseEvidence) -> FaultEstimate | None:
    """Return a cause with its size; None of a change that is not known."""
    kind, joint = found.cause.kind, found.cause.joint
    if kind == UNKNOWN:
        return None
    value, low, high = _interval(baseline, found)
    if kind == "payload":
        link = float(baseline.model.arm.inertial[-1, 0])
        ratios = 1.0 + np.array([value, low, high]) / link
        return FaultEstimate(
            name=kind, parameter="payload", ratio=ratios[0], interval=tuple(ratios[1:]), mass_kg=(value, low, high)
        )
    own = f"{joint}.{found.cause.parameter}"
    if kind == "friction":
        unit = baseline.coefficient(own)[0]
    elif kind == "drive gain":  # torque per current that is logged: the residual grows as the gain falls
        ratio, least, most = (1.0 / (1.0 + x) for x in (value, high, low))
        return FaultEstimate(name=kind, parameter=own, ratio=ratio, interval=(least, most))
    else:  # without a healthy value of its own
        unit = baseline.torque[baseline.model.arm.names.index(joint)] if kind != "encoder offset" else 1.0
    ratios = 1.0 + np.array([value, low, high]) / unit
    return FaultEstimate(
        name=kind, parameter=own, ratio=ratios[0], interval=(float(ratios[1:].min()), float(ratios[1:].max()))
    )


def _interval(baseline: ArmBaseline, found: CauseEvidence) -> tuple[float, float, float]:
    """Return the size of a cause with its 95 % interval: of its first column, or the amplitude of several."""
    size = found.size
    if found.cause.kind in ("counterbalance", "gear ripple"):  # sine and cosine
        value = float(np.hypot(size[0], size[1]))
        gradient = np.zeros(size.size)
        gradient[:2] = size[:2] / max(value, 1e-300)
        half = INTERVAL * float(np.sqrt(gradient @ found.covariance @ gradient))
    else:
        value, std = float(size[0]), float(np.sqrt(found.covariance[0, 0]))
        if found.cause.kind == "friction":  # it is a ratio to a healthy value, which differs between recordings
            healthy = baseline.coefficient(f"{found.cause.joint}.{found.cause.parameter}")[0]
            std = float(np.hypot(std, value * baseline.between[found.cause.columns[0]] / healthy))
        half = INTERVAL * std
    return value, value - half, value + half


def _size(baseline: ArmBaseline, found: CauseEvidence) -> Message:
    """Return the size of a cause as a sentence."""
    kind = found.cause.kind
    value, low, high = _interval(baseline, found)
    if kind == "payload":
        return message("arm.size_mass", value=value, low=low, high=high)
    fault = _fault(baseline, found)
    if kind in ("friction", "drive gain") and fault is not None:
        least, most = fault.interval
        return message("arm.size_ratio", parameter=found.cause.parameter, ratio=fault.ratio, low=least, high=most)
    return message("arm.size", value=value, low=low, high=high, unit=UNITS[kind])
