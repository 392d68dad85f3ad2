"""From what was measured on a recording to findings in words, and a verdict."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from servoscope.inspection.excitation import Excited
from servoscope.inspection.leftover import Residual
from servoscope.inspection.levels import Said, percent
from servoscope.inspection.measured import Fit, Measured, described
from servoscope.loop import Loop

Severity = Literal["stop", "care", "note"]
Verdict = Literal["usable", "usable with care", "not usable"]

LEAST_EXPLAINED, WELL_EXPLAINED = 0.5, 0.9
STILL, MOSTLY_STILL, HALF_STILL = 0.97, 0.8, 0.5
SNR = 3.0
PRECISE = 0.05  # relative standard deviation of the iFRF that the estimator's memory should allow
CONDITION = 1e3
FEW_BITS = 8.0
DELAY_TOLERANCE = 0.1  # samples
DELAY_GAIN = 0.1  # share of the residual variance below which a delay is not worth a word
LEAST_MEMORIES = 10.0
MODEL_ERROR = 0.005
SEEN = 7.0  # root of a usual threshold: so many standard deviations is a change that is seen


class Finding(Said):
    """A reason: ``stop`` makes a recording not usable, ``care`` usable with care, ``note`` just informs."""

    kind: str
    severity: Severity
    message: str


def judge(m: Measured, loop: Loop | None, constant: tuple[str, ...] = ()) -> tuple[Finding, ...]:
    """Turn measurements into findings, the worst first.

    Parameters
    ----------
    m
        What was measured.
    loop
        The loop, if there is one.
    constant
        Signals that never change.
    """
    found = [*_of_signals(m, loop, constant)]
    if still(m):
        # Of a machine that does not move, spectra and models say nothing.
        share = percent(m.rest.share) if m.rest is not None else ""
        found.append(("rest", "stop", f"the output rests {share} of the time: record while the machine moves"))
    else:
        found += [*_of_excitation(m, loop), *_of_model(m, loop)]
    rank = {"stop": 0, "care": 1, "note": 2}
    return tuple(sorted((Finding(kind=k, severity=s, message=w) for k, s, w in found), key=lambda f: rank[f.severity]))


def verdict_of(findings: tuple[Finding, ...]) -> Verdict:
    """Return the verdict that the worst finding asks for."""
    severities = {finding.severity for finding in findings}
    return "not usable" if "stop" in severities else "usable with care" if "care" in severities else "usable"


def headline_of(findings: tuple[Finding, ...]) -> str:
    """Return the verdict in words, with what a short recording is good for."""
    verdict = verdict_of(findings)
    if verdict == "not usable" or not any(finding.kind == "short" for finding in findings):
        return verdict
    return "usable to diagnose; short to learn from" if verdict == "usable" else f"{verdict}; short to learn from"


def weak(m: Measured, at: Excited) -> bool:
    """Return whether a frequency is too weak; without a period the regression may vouch for it, coherence says less."""
    known = at.relative_std_memory is not None and at.relative_std_memory <= PRECISE
    return at.snr is not None and at.snr < SNR and not (m.periods is None and known)


def still(m: Measured) -> bool:
    """Return whether the output rests nearly all the time, or mostly, and noise alone makes up the remainder."""
    if m.rest is None:
        return False
    commanded = not any(q.signal == "r" and q.values < 2 for q in m.quantisation)
    noise = m.band is None and (m.fit is None or m.fit.explained < LEAST_EXPLAINED)
    return m.rest.share > STILL or (noise and m.rest.share > (MOSTLY_STILL if commanded else HALF_STILL))


_Said = tuple[str, Severity, str]


def _of_signals(m: Measured, loop: Loop | None, constant: tuple[str, ...]) -> Iterator[_Said]:
    s = m.sampling
    for signal in constant:
        severity: Severity = "care" if signal == "r" else "stop"
        yield (
            "constant",
            severity,
            f"{signal} never changes: choose another column, or record while the machine moves",
        )
    if m.swapped is not None:
        yield "swapped", "stop", f"u and y seem to be swapped: {m.swapped}; swap the two columns"
    if s.jitter_percent > 5.0:
        words = f"time stamps jitter by {s.jitter_percent:.2g} % of a sample (standard deviation)"
        yield (
            "jitter",
            "care",
            f"{words}: phases at high frequencies suffer, log with the controller's own clock",
        )
    if s.missing_percent > 0.0:
        severity = "care" if s.missing_percent > 10.0 else "note"
        words = f"{s.missing_percent:.2g} % of the rows are missing, in {s.stretches - s.runs} gaps"
        yield "missing", severity, f"{words}; after each the filters have to settle anew"
    for defect in m.defects:
        if defect.kind not in ("saturation", "jitter"):
            severity = "care" if defect.rows > 0.1 * s.samples and defect.kind != "clock" else "note"
            events = f"{defect.events} times, first: " if defect.events > 1 else ""
            yield defect.kind, severity, f"{events}{defect.first}"
    for q in m.quantisation:
        if q.signal != "r" and q.step is not None and q.effective_bits is not None and q.effective_bits < 14.0:
            severity = "care" if q.effective_bits < FEW_BITS else "note"
            words = f"{q.signal} comes in steps of {q.step:.4g}, {q.effective_bits:.1f} bits over its range"
            yield (
                "quantisation",
                severity,
                f"{words}, {percent(q.repeated)} of the samples repeat the one before",
            )
    at = m.saturation
    share = at.share_low + at.share_high if at is not None else 0.0
    if at is not None and share > 0.0:
        limits = " and ".join(f"{x:g}" for x, part in ((at.low, at.share_low), (at.high, at.share_high)) if part)
        words = f"u is at {limits} for {percent(share)} of the time, {at.longest_s:.3g} s at most"
        before = loop is not None and loop.input_logged == "before_limiter"
        yield "saturation", "care" if share > 0.05 and not before else "note", words
    if m.dead_zone is not None:
        z = m.dead_zone
        known = loop is not None and loop.input_deadzone is not None
        words = f"the output does not move while u is between {z.low:.4g} and {z.high:.4g}"
        yield "dead_zone", "note" if known else "care", f"{words} (dead zone, or friction at rest)"


def _of_excitation(m: Measured, loop: Loop | None) -> Iterator[_Said]:
    if m.rest is not None and m.rest.share > MOSTLY_STILL:
        yield (
            "rest",
            "care",
            f"the output rests {percent(m.rest.share)} of the time: record while the machine moves",
        )
    elif m.rest is not None and m.rest.share > 0.05:
        unit = (loop.plant.units[0] if loop is not None else "") or "units of y"
        yield (
            "rest",
            "note",
            f"the output rests {percent(m.rest.share)} of the time (speed below {m.rest.speed:.2g} {unit}/s)",
        )
    if not m.coherent:
        words = f"the recording holds {m.periods:.2g} periods of the reference: too few periods to judge coherence"
        yield "coherence", "note", f"{words}; the standard deviations of the iFRF come from the regression"
    elif m.band is None:
        words = "no band of frequencies in which both u and y follow the reference"
        yield "band", "care", f"{words}: it excites little, does not repeat, or the loop is not linear"
    else:
        yield (
            "band",
            "note",
            f"u and y follow the reference from {m.band.low_hz:.3g} to {m.band.high_hz:.3g} Hz",
        )
    asked: Severity = "care" if loop is not None else "note"
    for at in m.frequencies:
        if at.snr is not None and at.snr < SNR:
            words = f"{at.frequency_hz:g} Hz is hardly excited, or u and y do not follow the reference there"
            yield (
                "frequency",
                asked if weak(m, at) else "note",
                f"{words} (signal to noise {at.snr:.2g}): estimates there rest on other frequencies",
            )
        elif at.relative_std_memory is not None and at.relative_std_memory > 2.0 * PRECISE:
            precision = percent(at.relative_std_memory)
            words = f"at {at.frequency_hz:g} Hz the memory of the estimator allows {precision}"
            yield "frequency", asked, f"{words} (standard deviation of the inverse frequency response)"
    if m.fit is not None and m.fit.condition > CONDITION:
        words = f"the motion hardly tells apart {m.fit.weakest} (condition number {m.fit.condition:.2g})"
        yield "conditioning", "care", words
    memory = loop.monitor.memory if loop is not None else 5.0
    if m.sampling.duration_s < LEAST_MEMORIES * memory:
        wanted = f"{LEAST_MEMORIES * memory:g} s or more, ten times the memory of {memory:g} s"
        lasts = f"{m.sampling.duration_s:.3g} s"
        if m.sampling.duration_s < memory:
            yield "short", "care", f"{lasts} are less than the memory of the estimator; to learn from, record {wanted}"
        else:
            yield "short", "note", f"{lasts} are enough to diagnose; to learn from, record {wanted}"


def _of_model(m: Measured, loop: Loop | None) -> Iterator[_Said]:
    if m.fit is None:
        yield (
            "short",
            "stop",
            "too few samples in motion to fit any model: record longer, and while the machine moves",
        )
        return
    explained = m.fit.explained
    if explained < WELL_EXPLAINED:
        severity: Severity = "stop" if explained < LEAST_EXPLAINED else "care"
        words = f"the motion of y explains only {percent(explained)} of u ({m.fit.model})"
        yield (
            "explained",
            severity,
            f"{words}: wrong columns, a load that changes, or a plant of another kind",
        )
    else:
        yield "explained", "note", f"the motion of y explains {percent(explained)} of u ({m.fit.model})"
    if m.fit.wrong_sign is not None:
        yield "sign", "care", f"{m.fit.wrong_sign} is negative: u or y seems to have the wrong sign"
    if m.best_order is not None and loop is not None:
        better = (1.0 - m.best_order.explained) / max(1.0 - explained, 1e-12)
        if better < 0.7 and explained < 0.99:
            words = f"{described(m.best_order)} would leave only {percent(better)}"
            yield "plant", "care", f"{words} of what the loop's model leaves over"
    d = m.delay
    if d is not None and not d.identifiable:
        yield "delay", "note", f"delay from u to y {d.words}"
    elif d is not None and d.samples is not None and d.low_samples is not None and d.high_samples is not None:
        off = d.samples - d.configured_samples
        outside = not d.low_samples <= d.configured_samples <= d.high_samples
        if abs(off) > DELAY_TOLERANCE and outside and d.gain > DELAY_GAIN:
            words = f"u acts {d.words} after it is logged, and not {d.configured_samples:.2g} samples"
            if d.samples < 0.0:
                words += "; a negative delay means that u is logged late, or y early"
            yield "delay", "care", words
        else:
            yield "delay", "note", f"delay from u to y {d.words}"
    if m.free_run is not None:
        yield "free_run", "note", m.free_run.words
    if m.residual is not None:
        yield from _of_residual(m.residual, m.fit)


def _of_residual(left: Residual, fit: Fit) -> Iterator[_Said]:
    missing = False
    if left.repeating is not None and left.repeating_std is not None and left.period_s is not None:
        rest = f"of the {100.0 * max(1.0 - fit.explained, 0.0):.2g} % of u that are left over"
        spread = f"{100.0 * max(left.repeating, 0.0):.0f} ± {200.0 * left.repeating_std:.0f} %"
        words = f"{rest}, {spread} repeat with the reference every {left.period_s:.4g} s"
        missing = left.repeating > 2.0 * left.repeating_std and left.model_error > MODEL_ERROR
        if missing:
            yield (
                "residual",
                "care" if left.model_error > 0.05 else "note",
                f"{words}: this is what the model lacks, for example in friction, and no noise",
            )
        else:
            yield "residual", "note", words if left.white is False else f"{words}: it is noise"
    if left.model_error > MODEL_ERROR:
        hidden = SEEN * left.model_error / max(fit.leading_share, 1e-3)
        size = f"below about {100.0 * hidden:.2g} %" if hidden < 1.0 else "of less than a factor of two"
        words = (
            f"only if healthy recordings raise alarms: a model_error up to {left.model_error:.1g} would silence them"
        )
        yield "model_error", "note", f"{words}; it hides changes of {fit.leading.replace('_', ' ')} {size}"
    if left.white is False and not missing:
        words = "the residual is structured beyond the filters' memory"
        if left.repeating is not None and left.repeating < 0.1:
            words += ", but does not repeat with the reference: something changed during the recording"
        yield "structure", "note", f"{words} (p = {left.p_value:.1g})"
