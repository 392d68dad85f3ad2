"""The diagnosis of an arm: what changed, in which joint, by how much and since when; pushes; what cannot be told."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from servoscope.arm.baseline import SERVICE_ODDS, UNKNOWN, ArmBaseline, ArmCause
from servoscope.arm.dynamics import joint_positions
from servoscope.arm.events import ArmEvent, find_events, outside_events, outside_torque, target_jumps
from servoscope.arm.evidence import INTERVAL, MIN_END_BLOCKS, CauseEvidence, ChangeEvidence, ChangeTest
from servoscope.arm.log import ArmRecording, read_arm_log
from servoscope.arm.regression import (
    MIN_MOVING_S,
    ArmSignals,
    Information,
    Rows,
    block_information,
    filter_arm_log,
)
from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.blas import with_one_blas_thread
from servoscope.core.errors import RecordingError
from servoscope.core.messages import Message, message
from servoscope.core.verdict import VerdictKind
from servoscope.diagnosis.result import Diagnosis, DiagnosisWarning, FaultInterval, FinalCoefficient
from servoscope.isolation.candidate import Candidate, FaultEstimate

MIN_CERTAINTY = 0.9  # probability from which a cause is named
MIN_EXPLAINED = 0.5  # share of the evidence of an unknown change from which one cause is named all the same
MIN_PROBABILITY = 0.01  # of a cause that is listed
MIN_RIVAL_PROBABILITY = 0.05  # of a cause that the headline of an open answer lists
MAX_FACTOR = 20.0  # power of ten up to which evidence is written
YEAR_S = 365.25 * 86400.0  # in which one healthy window may be called changed
ONSET_TAIL = 0.025  # probability on either side of an onset's interval
ONSET_STEP_S = 0.2  # to which an onset is found: the filters leave no more
MAX_ONSET_STEPS = 60  # of an onset's interval, longer ones where that is long
UNITS = {"offset": "N m", "counterbalance": "N m", "gear ripple": "N m", "encoder offset": "rad"}


class ArmExamination(NamedTuple):
    """What the diagnosis of an arm rests on, for reports."""

    signals: ArmSignals
    outside: FloatArray  # torque that friction cannot explain, over half a second (n, M) [N m]
    evidence: ChangeEvidence | None
    events: list[ArmEvent]

    def picture(self, baseline: ArmBaseline, diagnosis: Diagnosis) -> dict[str, Any]:
        """Return where the joints are in the middle of the recording [m], and how likely each has changed."""
        arm, q = baseline.model.arm, self.signals.q
        odds = [
            sum(candidate.probability for candidate in diagnosis.candidates if candidate.name.endswith(f" of {name}"))
            for name in arm.names
        ]
        places = joint_positions(arm, q[len(q) // 2]).tolist()
        return {"names": arm.names, "parents": arm.parents, "places": places, "odds": odds}


class ArmWindow(NamedTuple):
    """The diagnosis of one of many windows of samples."""

    diagnosis: Diagnosis
    examination: ArmExamination
    start: float  # when the diagnosis' time is 0 [s]
    excess: float | None  # evidence of a change over its limit; None where the arm did not move


@with_one_blas_thread
def examine_window(baseline: ArmBaseline, name: str, t: FloatArray, signals: Mapping[str, FloatArray]) -> ArmWindow:
    """Examine one of the windows that follow each other without end; the limit is for one false alarm a year.

    `t`: (N,) [s]; `signals`: by their names in `ArmLoop.channels`, (N,) each. Evidence is a Bayes factor,
    so that no more than 1/k of healthy windows pass a limit that is k times as high. Raises RecordingError if the
    samples cannot be used.
    """
    if lacking := [signal for signal in baseline.loop.channels if signal not in signals]:
        raise RecordingError(f"{name}: has no {', '.join(lacking)}, name columns as in the loop file of the arm")
    whole = np.isfinite([t, *signals.values()]).all(axis=0)
    if not whole.any():
        raise RecordingError(f"{name}: no sample has all signals of all joints")
    start, end = t[whole][[0, -1]].tolist()
    looks = YEAR_S / max(end - start, 1.0)
    limit = baseline.limit + max(0.0, float(np.log(looks * baseline.loop.false_alarms)))
    raised = baseline.model_copy(update={"limit": limit})
    try:
        recording = read_arm_log({"t": t - start, **signals}, baseline.loop.of_channels(), baseline.model.arm)
    except RecordingError as error:
        raise RecordingError(f"{name}: {str(error).removeprefix('arrays: ')}") from None
    diagnosis, exam = examine_arm(raised, replace(recording, name=name))
    excess = None if exam.evidence is None else max(exam.evidence.log_factor, 0.0) / limit
    return ArmWindow(diagnosis, exam, start, excess)


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
    outside = outside_torque(signals, design, residual, noise, model, theta)
    events = find_events(signals.t, outside, np.array(baseline.event_limits) * noise, model.arm.names)
    columns = np.concatenate([design, baseline.deviations(signals, design)], axis=1)
    moved, rows, information, evidence = _weigh(baseline, signals, columns, residual, events)
    if events and evidence is not None and evidence.log_factor > baseline.limit:
        # what differs without them is a change, of which they are the peaks
        events = []
        moved, rows, information, evidence = _weigh(baseline, signals, columns, residual, events)
    warnings = [*_event_warnings(events, recording), *_still_warnings(model.arm.names, moved, recording)]
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
    used = replace(signals, moving=signals.moving & outside_events(signals.t, events))
    moved = used.moving.sum(1) * float(np.median(np.diff(signals.t))) >= MIN_MOVING_S
    rows = used.weighted(columns, residual, baseline.torque_std)
    if not moved.any():
        return moved, rows, None, None
    information = block_information(*rows)
    return moved, rows, information, _change_test(baseline, information).weigh()


def _change_test(baseline: ArmBaseline, information: Information, causes: Sequence[ArmCause] = ()) -> ChangeTest:
    scale, drift = np.array(baseline.scale), np.array(baseline.drift)
    return ChangeTest(information, baseline.random_effect, causes or baseline.causes, scale, drift)


def _result(
    recording: ArmRecording,
    verdict: VerdictKind,
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


def _event_warnings(events: Sequence[ArmEvent], recording: ArmRecording) -> Iterator[DiagnosisWarning]:
    for event, jump in zip(events, target_jumps(recording.t, recording.target, events), strict=True):
        kind = "arm.event_trajectory" if jump else "arm.event"
        text = message(kind, joints=event.joints, torque=event.torque, joint=event.joints[0])
        yield _warning("event", event.from_s, event.to_s, text)


def _still_warnings(names: Sequence[str], moved: BoolArray, recording: ArmRecording) -> Iterator[DiagnosisWarning]:
    still = [name for name, has_moved in zip(names, moved, strict=True) if not has_moved]
    if still:
        yield _warning("rest", recording.t[0], recording.t[-1], message("arm.still", joints=still))


def _coefficients(baseline: ArmBaseline, information: Information) -> dict[str, FinalCoefficient]:
    """Return friction and offset of each joint as the whole recording shows them."""
    covariance = np.linalg.inv(information.A.sum(0) + baseline.random_effect)
    shift, first = covariance @ information.g.sum(0), len(baseline.theta)
    values = {}
    for cause in baseline.causes:
        name = f"{cause.joint}.{cause.parameter}"
        if name in baseline.names and len(cause.columns) == 1:
            pair = [baseline.names.index(name), first + cause.columns[0]]
            value = baseline.theta[pair[0]]
            std = float(np.sqrt(covariance[np.ix_(pair, pair)].sum()))
            values[name] = FinalCoefficient(value=value + float(shift[pair].sum()), std=std, nominal=value)
    return values


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
) -> tuple[VerdictKind, Message, FaultInterval, tuple[Message, ...]]:
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
    best = _pool(evidence, groups[ranked[0]])
    onset, from_start = _onset(baseline, evidence, best, rows)
    since = message("diagnosis.since_start") if from_start else message("diagnosis.since", t=onset[1], growth=None)
    candidates = []
    for key in ranked:
        if odds[key] >= MIN_PROBABILITY:
            fault = _fault(baseline, likeliest := _pool(evidence, groups[key]))
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
        name = {"kind": best.cause.kind, "joint": _joint(best.cause.joint)}
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


def _pool(evidence: ChangeEvidence, indices: Sequence[int]) -> CauseEvidence:
    """Return the likeliest of causes of one kind, its first size averaged over those that have it by probability."""
    likeliest = evidence.causes[indices[0]]
    same = [index for index in indices if evidence.causes[index].cause.parameter == likeliest.cause.parameter]
    share = evidence.probability[same] / evidence.probability[same].sum()
    sizes = np.array([evidence.causes[index].size[0] for index in same])
    variances = np.array([evidence.causes[index].covariance[0, 0] for index in same])
    size, covariance = likeliest.size.copy(), likeliest.covariance.copy()
    size[0] = share @ sizes
    covariance[0, 0] = share @ (variances + (sizes - size[0]) ** 2)
    return likeliest._replace(size=size, covariance=covariance)


def _joint(name: str) -> Message | None:
    return message("arm.of_joint", joint=name) if name else None


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
    first, last = t[max(0, low - 1)], t[min(high + 1, t.size - 1)]
    return (float(first), float(t[int(onset.argmax())]), float(last)), low == 0


def _fault(baseline: ArmBaseline, evidence: CauseEvidence) -> FaultEstimate | None:
    """Return a cause with its size; None of a change that is not known."""
    kind, joint, name = evidence.cause.kind, evidence.cause.joint, evidence.cause.name
    if kind == UNKNOWN:
        return None
    value, low, high = _interval(baseline, evidence)
    if kind == "payload":
        link = float(baseline.model.arm.inertial[-1, 0])
        ratios = 1.0 + np.array([value, low, high]) / link
        return FaultEstimate(
            name=name, parameter="payload", ratio=ratios[0], interval=tuple(ratios[1:]), mass_kg=(value, low, high)
        )
    own = f"{joint}.{evidence.cause.parameter}"
    if kind == "friction":
        unit = baseline.coefficient(own)[0]
    elif kind == "drive gain":  # torque per current that is logged: the residual grows as the gain falls
        ratio, least, most = (1.0 / (1.0 + x) for x in (value, high, low))
        return FaultEstimate(name=name, parameter=own, ratio=ratio, interval=(least, most))
    else:  # without a healthy value of its own
        unit = baseline.torque[baseline.model.arm.names.index(joint)] if kind != "encoder offset" else 1.0
    ratios = 1.0 + np.array([value, low, high]) / unit
    return FaultEstimate(
        name=name, parameter=own, ratio=ratios[0], interval=(float(ratios[1:].min()), float(ratios[1:].max()))
    )


def _interval(baseline: ArmBaseline, evidence: CauseEvidence) -> tuple[float, float, float]:
    """Return the size of a cause with its 95 % interval: of its first column, or the amplitude of several."""
    size = evidence.size
    if evidence.cause.kind in ("counterbalance", "gear ripple"):  # sine and cosine
        value = float(np.hypot(size[0], size[1]))
        gradient = np.zeros(size.size)
        gradient[:2] = size[:2] / max(value, 1e-300)
        half = INTERVAL * float(np.sqrt(gradient @ evidence.covariance @ gradient))
    else:
        value, std = float(size[0]), float(np.sqrt(evidence.covariance[0, 0]))
        if evidence.cause.kind == "friction":  # it is a ratio to a healthy value, which differs between recordings
            healthy = baseline.coefficient(f"{evidence.cause.joint}.{evidence.cause.parameter}")[0]
            std = float(np.hypot(std, value * baseline.between[evidence.cause.columns[0]] / healthy))
        half = INTERVAL * std
    return value, value - half, value + half


def _size(baseline: ArmBaseline, evidence: CauseEvidence) -> Message:
    """Return the size of a cause as a sentence."""
    kind = evidence.cause.kind
    value, low, high = _interval(baseline, evidence)
    if kind == "payload":
        return message("arm.size_mass", value=value, low=low, high=high)
    fault = _fault(baseline, evidence)
    if kind in ("friction", "drive gain") and fault is not None:
        least, most = fault.interval
        parameter = evidence.cause.parameter.replace("_", " ")
        return message("arm.size_ratio", parameter=parameter, ratio=fault.ratio, low=least, high=most)
    return message("arm.size", value=value, low=low, high=high, unit=UNITS[kind])
