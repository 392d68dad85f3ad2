"""What follows from the measurements of a recording: findings, the verdict, and recommendations."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

from servoscope.core.messages import Message, MessageText, message, text_message
from servoscope.learning.inspection.excitation import FrequencyExcitation
from servoscope.learning.inspection.residual import Residual
from servoscope.learning.inspection.result import InspectionMeasurements, InverseModelFit, describe_order
from servoscope.learning.inspection.signals import InspectionModel
from servoscope.models.loop import Loop

FindingSeverity = Literal["stop", "care", "note"]
InspectionVerdict = Literal["usable", "usable with care", "not usable"]

MEMORY_S = 5.0  # of the estimator, without a loop
MIN_EXPLAINED_SHARE, GOOD_EXPLAINED_SHARE = 0.5, 0.9  # share of the variance of u
STILL_SHARE, MOSTLY_STILL_SHARE, HALF_STILL_SHARE = 0.97, 0.8, 0.5
SNR = 3.0
MAX_RELATIVE_STD = 0.05  # relative standard deviation of the iFRF that the estimator's memory should allow
CONDITION = 1e3
MIN_BITS = 8.0
DELAY_TOLERANCE = 0.1  # samples
DELAY_GAIN = 0.1  # share of the residual variance below which a delay is not mentioned
MIN_MEMORIES = 10.0  # memories of the estimator that a recording to learn from should last at least
MODEL_ERROR = 0.005
DETECTABLE_STDS = 7.0  # root of a usual threshold: a change of so many standard deviations is detected

_Finding = tuple[str, FindingSeverity, Message]


class InspectionFinding(InspectionModel):
    """A reason: ``stop`` makes a recording not usable, ``care`` usable with care, ``note`` just informs."""

    kind: str
    severity: FindingSeverity
    message: MessageText


def recommend(m: InspectionMeasurements, loop: Loop | None) -> tuple[Message, ...]:
    """Return what to set in the loop file and what to record differently."""
    return tuple(_recommendations(m, loop))


def derive_findings(
    m: InspectionMeasurements, loop: Loop | None, constant: tuple[str, ...] = (), analysed: int | None = None
) -> tuple[InspectionFinding, ...]:
    """Turn measurements into findings, the worst first.

    `constant` are the signals that never change, `analysed` rows were measured, None for all.
    """
    rows = [*_signal_findings(m, loop, constant)]
    if analysed is not None and analysed < m.sampling.samples:
        rows.append(("long", "note", _inspection("few_rows", analysed=analysed, rows=m.sampling.samples)))
    if is_at_rest(m):
        # Of a machine that does not move, spectra and models say nothing.
        rows.append(("rest", "stop", _inspection("no_motion", share=m.rest.share if m.rest else None)))
    else:
        rows += [*_excitation_findings(m, loop), *_model_findings(m, loop)]
    rank = {"stop": 0, "care": 1, "note": 2}
    findings = [InspectionFinding(kind=kind, severity=severity, message=text) for kind, severity, text in rows]
    return tuple(sorted(findings, key=lambda finding: rank[finding.severity]))


def overall_verdict(findings: tuple[InspectionFinding, ...]) -> InspectionVerdict:
    """Return the verdict that the worst finding asks for."""
    severities = {finding.severity for finding in findings}
    return "not usable" if "stop" in severities else "usable with care" if "care" in severities else "usable"


def headline(findings: tuple[InspectionFinding, ...]) -> Message:
    """Return the verdict in words, with what a short recording is good for."""
    verdict = overall_verdict(findings)
    short = verdict != "not usable" and any(finding.kind == "short" for finding in findings)
    return _inspection(verdict.replace(" ", "_") + ("_short" if short else ""))


def is_at_rest(m: InspectionMeasurements) -> bool:
    """Return whether the output rests nearly all the time, or mostly, and noise alone makes up the remainder."""
    if m.rest is None:
        return False
    commanded = not any(q.signal == "r" and q.values < 2 for q in m.quantisation)
    noise = m.band is None and (m.fit is None or m.fit.explained < MIN_EXPLAINED_SHARE)
    return m.rest.share > STILL_SHARE or (
        noise and m.rest.share > (MOSTLY_STILL_SHARE if commanded else HALF_STILL_SHARE)
    )


def _inspection(key: str, **values: Any) -> Message:
    return message(f"inspection.{key}", **values)


def _is_weakly_excited(m: InspectionMeasurements, at: FrequencyExcitation) -> bool:
    """Return whether a frequency is too weak; without a period the regression may vouch for it, coherence says less."""
    precise = at.relative_std_memory is not None and at.relative_std_memory <= MAX_RELATIVE_STD
    return at.snr is not None and at.snr < SNR and not (m.periods is None and precise)


def _recommendations(m: InspectionMeasurements, loop: Loop | None) -> Iterator[Message]:
    if is_at_rest(m):
        yield _inspection("record_motion")
        return
    if m.fit is None:
        yield _inspection("record_longer")
        return
    if loop is None and m.best_order is not None:
        b = m.best_order
        settings = [f"order = {b.order}", f'friction = "{b.friction}"', "offset = true"]
        yield _inspection("set_plant", settings=settings + ["stiffness = true"] * b.stiffness)
    if m.suggested_cutoff_hz is not None and m.cutoff_hz is not None:
        if loop is None:
            yield _inspection("set_cutoff", cutoff_hz=m.suggested_cutoff_hz)
        elif m.coherent and m.cutoff_hz > 1.8 * m.suggested_cutoff_hz:
            yield _inspection("lower_cutoff", cutoff_hz=m.suggested_cutoff_hz, today_hz=m.cutoff_hz)
    d = m.delay
    if d is not None and d.seconds is not None and d.gain > DELAY_GAIN:
        if d.seconds > 0.0 and abs(d.seconds * m.sampling.sample_rate_hz - d.configured_samples) > DELAY_TOLERANCE:
            yield _inspection("set_delay", delay_s=d.seconds)
        elif d.samples is not None and d.samples < -DELAY_TOLERANCE:
            yield _inspection("log_u_earlier")
    if (speed := advised_rest_speed(m, loop)) is not None:
        simulated = loop is not None and loop.plant.has_physics and loop.controller is not None
        yield _inspection("set_update_when", speed=speed, short_rests=None if simulated else _inspection("short_rests"))
    if m.dead_zone is not None and (loop is None or loop.input_deadzone is None):
        yield _inspection("set_dead_zone", low=m.dead_zone.low, high=m.dead_zone.high)
    if m.saturation is not None and m.saturation.source == "seen":
        ends = [f"{end:g}" for end in (m.saturation.low, m.saturation.high) if end is not None]
        yield _inspection("set_limits", limits=ends)
    excited = [at for at in m.frequencies if at.relative_std_memory is not None and (at.snr is None or at.snr >= SNR)]
    worst = max((at.relative_std_memory or 0.0 for at in excited), default=0.0)
    if worst > MAX_RELATIVE_STD:
        yield _inspection("set_memory", memory_s=_memory_s(loop) * min((worst / MAX_RELATIVE_STD) ** 2, 20.0))
    lacking = [f"{at.frequency_hz:g}" for at in m.frequencies if _is_weakly_excited(m, at)]
    if lacking and loop is not None:
        yield _inspection("drop_frequencies", frequencies=lacking)
    coarse = [q.signal for q in m.quantisation if q.signal != "r" and (q.effective_bits or 99.0) < MIN_BITS]
    if coarse:
        yield _inspection("log_finer", signals=coarse)
    if m.residual is not None and m.residual.period_s is None:
        yield _inspection("record_repeating")


def advised_rest_speed(m: InspectionMeasurements, loop: Loop | None) -> float | None:
    """Return the speed below which the estimator should hold, None where rest does no harm or is left out already."""
    if m.rest is None or m.fit is None or (loop is not None and loop.monitor.update_when == "moving"):
        return None
    excess = (1.0 - m.fit.explained_ungated) / max(1.0 - m.fit.explained, 1e-12)
    sticks = m.dead_zone is not None or (excess > 1.3 and m.fit.explained_ungated < 0.99)
    return m.rest.speed if sticks else None


def _memory_s(loop: Loop | None) -> float:
    return loop.monitor.memory if loop is not None else MEMORY_S


def _signal_findings(m: InspectionMeasurements, loop: Loop | None, constant: tuple[str, ...]) -> Iterator[_Finding]:
    s = m.sampling
    for signal in constant:
        yield "constant", "care" if signal == "r" else "stop", _inspection("constant", signal=signal)
    if m.swapped is not None:
        yield "swapped", "stop", _inspection("swapped", reason=m.swapped)
    if s.jitter_percent > 5.0:
        yield "jitter", "care", _inspection("jitter", percent=s.jitter_percent)
    if s.missing_percent > 0.0:
        gaps = s.stretches - s.runs
        severity: FindingSeverity = "care" if s.missing_percent > 10.0 else "note"
        yield "missing", severity, _inspection("missing", percent=s.missing_percent, gaps=gaps)
    for defect in m.defects:
        if defect.kind not in ("saturation", "jitter"):
            severity = "care" if defect.rows > 0.1 * s.samples and defect.kind not in ("clock", "resampled") else "note"
            several = _inspection("defects", events=defect.events, first=defect.first)
            yield defect.kind, severity, several if defect.events > 1 else text_message(defect.first)
    for q in m.quantisation:
        if q.signal != "r" and q.step is not None and q.effective_bits is not None and q.effective_bits < 14.0:
            values = {"signal": q.signal, "step": q.step, "bits": q.effective_bits, "repeated": q.repeated}
            yield (
                "quantisation",
                "care" if q.effective_bits < MIN_BITS else "note",
                _inspection("quantisation", **values),
            )
    at = m.saturation
    share = at.share_low + at.share_high if at is not None else 0.0
    if at is not None and share > 0.0:
        limits = [f"{x:g}" for x, part in ((at.low, at.share_low), (at.high, at.share_high)) if part]
        before = loop is not None and loop.input_logged == "before_limiter"
        severity = "care" if share > 0.05 and not before else "note"
        yield "saturation", severity, _inspection("saturation", limits=limits, share=share, longest_s=at.longest_s)
    if m.dead_zone is not None:
        configured = loop is not None and loop.input_deadzone is not None
        text = _inspection("dead_zone", low=m.dead_zone.low, high=m.dead_zone.high)
        yield "dead_zone", "note" if configured else "care", text


def _excitation_findings(m: InspectionMeasurements, loop: Loop | None) -> Iterator[_Finding]:
    if m.rest is not None and m.rest.share > MOSTLY_STILL_SHARE:
        yield "rest", "care", _inspection("no_motion", share=m.rest.share)
    elif m.rest is not None and m.rest.share > 0.05:
        unit = (loop.plant.units[0] if loop is not None else "") or _inspection("units_of_y")
        yield "rest", "note", _inspection("rest", share=m.rest.share, speed=m.rest.speed, unit=unit)
    if not m.coherent:
        yield "coherence", "note", _inspection("few_periods", periods=m.periods)
    elif m.band is None:
        yield "band", "care", _inspection("no_band")
    else:
        yield "band", "note", _inspection("band", low_hz=m.band.low_hz, high_hz=m.band.high_hz)
    monitored: FindingSeverity = "care" if loop is not None else "note"
    for at in m.frequencies:
        if at.snr is not None and at.snr < SNR:
            severity = monitored if _is_weakly_excited(m, at) else "note"
            yield "frequency", severity, _inspection("weak_frequency", frequency_hz=at.frequency_hz, snr=at.snr)
        elif at.relative_std_memory is not None and at.relative_std_memory > 2.0 * MAX_RELATIVE_STD:
            values = {"frequency_hz": at.frequency_hz, "relative_std": at.relative_std_memory}
            yield "frequency", monitored, _inspection("imprecise_frequency", **values)
    if m.fit is not None and m.fit.condition > CONDITION:
        text = _inspection("conditioning", weakest=m.fit.weakest, condition=m.fit.condition)
        yield "conditioning", "care", text
    memory, lasts = _memory_s(loop), m.sampling.duration_s
    if lasts < MIN_MEMORIES * memory:
        wanted = _inspection("learning_duration", duration_s=MIN_MEMORIES * memory, memory_s=memory)
        key = "shorter_than_memory" if lasts < memory else "short_to_learn"
        yield "short", "care" if lasts < memory else "note", _inspection(key, duration_s=lasts, wanted=wanted)


def _model_findings(m: InspectionMeasurements, loop: Loop | None) -> Iterator[_Finding]:
    if m.fit is None:
        yield "short", "stop", _inspection("no_fit")
        return
    explained = m.fit.explained
    if explained < GOOD_EXPLAINED_SHARE:
        severity: FindingSeverity = "stop" if explained < MIN_EXPLAINED_SHARE else "care"
        yield "explained", severity, _inspection("hardly_explained", share=explained, model=m.fit.model)
    else:
        yield "explained", "note", _inspection("explained", share=explained, model=m.fit.model)
    if m.fit.wrong_sign is not None:
        yield "sign", "care", _inspection("wrong_sign", coefficient=m.fit.wrong_sign)
    if m.best_order is not None and loop is not None:
        better = (1.0 - m.best_order.explained) / max(1.0 - explained, 1e-12)
        if better < 0.7 and explained < 0.99:
            yield "plant", "care", _inspection("better_order", model=describe_order(m.best_order), share=better)
    d = m.delay
    if d is not None and not d.identifiable:
        yield "delay", "note", _inspection("delay", delay=d.words)
    elif d is not None and d.samples is not None and d.low_samples is not None and d.high_samples is not None:
        off = d.samples - d.configured_samples
        outside = not d.low_samples <= d.configured_samples <= d.high_samples
        if abs(off) > DELAY_TOLERANCE and outside and d.gain > DELAY_GAIN:
            negative = _inspection("negative_delay") if d.samples < 0.0 else None
            values = {"delay": d.words, "configured": d.configured_samples, "negative": negative}
            yield "delay", "care", _inspection("other_delay", **values)
        else:
            yield "delay", "note", _inspection("delay", delay=d.words)
    if m.free_run is not None:
        yield "free_run", "note", m.free_run.words
    if m.residual is not None:
        yield from _residual_findings(m.residual, m.fit)


def _residual_findings(residual: Residual, fit: InverseModelFit) -> Iterator[_Finding]:
    missing = False  # whether the model lacks something that repeats
    if residual.repeating is not None and residual.repeating_std is not None and residual.period_s is not None:
        missing = residual.repeating > 2.0 * residual.repeating_std and residual.model_error > MODEL_ERROR
        noise = None if residual.white is False else _inspection("residual_is_noise")
        text = _inspection(
            "residual_repeats",
            left=100.0 * max(1.0 - fit.explained, 0.0),
            repeating=100.0 * max(residual.repeating, 0.0),
            spread=200.0 * residual.repeating_std,
            period_s=residual.period_s,
            conclusion=_inspection("residual_is_model") if missing else noise,
        )
        yield "residual", "care" if missing and residual.model_error > 0.05 else "note", text
    if residual.model_error > MODEL_ERROR:
        hidden = DETECTABLE_STDS * residual.model_error / max(fit.leading_share, 1e-3)
        below = _inspection("changes_below", percent=100.0 * hidden)
        size = below if hidden < 1.0 else _inspection("changes_below_factor_two")
        coefficient = fit.leading.replace("_", " ")
        text = _inspection("model_error", model_error=residual.model_error, coefficient=coefficient, size=size)
        yield "model_error", "note", text
    if residual.white is False and not missing:
        once = residual.repeating is not None and residual.repeating < 0.1
        changed = _inspection("residual_changed") if once else None
        yield "structure", "note", _inspection("residual_structure", changed=changed, p_value=residual.p_value)
