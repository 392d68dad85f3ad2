"""From an examination to the verdict: since when, which fault, how large, and what the estimates mean."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servoscope.detection import Onset, onset
from servoscope.diagnosis import (
    UNKNOWN,
    Candidate,
    Diagnosis,
    FoundFault,
    Parameter,
    Refit,
    ResponsePoint,
    Trace,
    Verdict,
    Warning,
)
from servoscope.doubts import blind_to, doubts, seen_by
from servoscope.examination import Examination
from servoscope.isolation import isolate
from servoscope.meaning import Meaning, meaning, trace
from servoscope.reasons import reasons
from servoscope.refit import candidates_of, disagreements, onset_of, refit, said
from servoscope.sentence import summary
from servoscope.steady import isolation_inputs

if TYPE_CHECKING:
    from servoscope.refinement import Refined

SURE = 0.95  # probability from which a fault is named


def judge(x: Examination, progress: Callable[[str], None] = lambda _: None) -> tuple[Diagnosis, Meaning | None]:
    """Return the verdict on an examination, and what its estimates mean; `progress` is told what is being done."""
    recording = x.recording
    warnings = [Warning.of(defect) for defect in recording.defects] + doubts(x)
    alarm = alarm_of(x, progress)
    seen: dict[str, tuple[float, float]] = {}
    candidates: tuple[Candidate, ...] = ()
    faults: tuple[FoundFault, ...] = ()
    since: Onset | None = None
    told: Refit | None = None
    last = x.evaluations - 1
    at, detected_at = last, None
    if alarm is not None:
        at, since = alarm.at, alarm.since
        detected_at = float(recording.t[alarm.announced])
        recursive = candidates = isolate(*isolation_inputs(x, since, at), lambda: progress("isolation"))
        progress("refit")
        refined = refit(x, since, alarm.announced, int(x.estimates.index[at]), lambda: progress("refit"))
        if refined is not None and not _labelled(refined, recursive[0]):
            candidates, told = candidates_of(refined), said(refined, x, recursive)
            since = since if refined.is_unknown else onset_of(refined, x)
            warnings += disagreements(x, candidates, told, SURE)
        if candidates[0].probability >= SURE and candidates[0].name != UNKNOWN:
            faults = candidates[0].faults
    else:
        seen = seen_by(x)
        blind = blind_to(x, seen)
        span = float(recording.t[0]), float(recording.t[-1])
        warnings += [Warning(kind="power", from_s=span[0], to_s=span[1], count=1, message=text) for text in blind]
    verdict: Verdict = "fault" if alarm else "undetermined" if blind else "healthy"
    meant = meaning(x, candidates, since, at)
    end = trace(x, meant, slice(max(last, 0), last + 1))
    explained = end if at == last else trace(x, meant, slice(at, at + 1))
    found = Diagnosis(
        recording=recording.name,
        samples=recording.samples,
        duration_s=recording.duration_s,
        verdict=verdict,
        summary=summary(verdict, faults, candidates, _since(x, since, told), seen, warnings, told, x.baseline.point),
        detected_at_s=detected_at,
        onset_s=(since.low_s, since.likely_s, since.high_s) if since is not None else None,
        probability=candidates[0].probability if candidates else None,
        faults=faults,
        candidates=candidates,
        explanation=reasons(x, explained, detected_at, candidates, told) if detected_at is not None else (),
        refit=told,
        parameters=_parameters(end),
        ifrf=_ifrf(end),
        warnings=tuple(sorted(warnings, key=lambda warning: warning.from_s)),
        point=x.baseline.point or None,
    )
    return found, meant


@dataclass(frozen=True)
class Alarm:
    """The alarm of a recording: its sample, the evaluation that is judged, and since when, by the recursion."""

    announced: int
    at: int
    since: Onset


def alarm_of(x: Examination, progress: Callable[[str], None] = lambda _: None) -> Alarm | None:
    """Return the first alarm of an examination; None if there was none."""
    alarms = np.flatnonzero(x.alarm)
    if not alarms.size:
        return None
    first = int(alarms[0])
    announced = _announced(x, first)
    # the last evaluation has forgotten most of the healthy past; where the alarm has gone, the strongest one
    at = x.evaluations - 1 if x.alarm[-1] else first + int(np.argmax(x.statistic[first:]))
    progress("onset")
    return Alarm(announced, at, _onset(x, announced, at))


def _labelled(refined: Refined, recursive: Candidate) -> bool:
    """Return whether a fault learned from labelled recordings says more than the refit, which knows none."""
    sure = recursive.is_learned and recursive.probability >= SURE
    return sure and (refined.is_unknown or len(refined.best.fitted.faults) > 1)


def _announced(x: Examination, first: int) -> int:
    """Return the sample of the alarm: the sequential test speaks at once, T^2 at its evaluations."""
    crossed = int(x.estimates.crossed[first]) - 1
    return crossed if crossed >= 0 and not x.baseline.loop.monitor.on_delay else int(x.estimates.index[first])


def _onset(x: Examination, announced: int, at: int) -> Onset:
    return onset(
        x.pipeline,
        x.tuning,
        x.recording,
        x.estimates,
        x.expected[at],
        x.estimates.theta[at],
        announced,
        max(int(x.estimates.index[at]), announced),
    )


def _since(x: Examination, found: Onset | None, told: Refit | None) -> str:
    if found is None:
        return ""
    start = float(x.recording.t[0])
    if found.likely_s - start <= 3.0 * x.pipeline.bank.wait / x.recording.sample_rate:
        return "since the start of the recording or before"
    drifting = told is not None and told.over_s > 0.0 and told.misfit <= told.limit
    return f"since {found.likely_s:.1f} s{f', growing over {told.over_s:.3g} s' if told and drifting else ''}"


def _parameters(trace: Trace) -> dict[str, Parameter]:
    if not len(trace.t):
        return {}
    theta, expected = trace.theta[-1], trace.expected[-1]
    std = np.sqrt(np.diag(trace.covariance[-1]))
    return {
        name: Parameter(value=float(value), std=float(s), nominal=float(nominal))
        for name, value, s, nominal in zip(trace.names, theta, std, expected, strict=True)
    }


def _ifrf(trace: Trace) -> tuple[ResponsePoint, ...]:
    if not len(trace.t):
        return ()
    now, healthy = trace.ifrf, trace.ifrf_expected
    std = np.sqrt(np.diagonal(now.covariance[-1], axis1=-2, axis2=-1))
    return tuple(
        ResponsePoint(
            frequency_hz=float(f),
            real=float(H.real),
            imag=float(H.imag),
            real_std=float(s[0]),
            imag_std=float(s[1]),
            nominal_real=float(H0.real),
            nominal_imag=float(H0.imag),
        )
        for f, H, s, H0 in zip(now.frequencies, now.H[-1], std, healthy.H[-1], strict=True)
    )
