"""What to set in the loop file, and what to record differently, after an inspection."""

from __future__ import annotations

from collections.abc import Iterator

from servoscope.inspection.judgement import DELAY_GAIN, DELAY_TOLERANCE, FEW_BITS, PRECISE, SNR, still, weak
from servoscope.inspection.measured import Measured
from servoscope.loop import Loop


def recommend(m: Measured, loop: Loop | None) -> tuple[str, ...]:
    """Say what to set in the loop file and what to record differently."""
    return tuple(_recommended(m, loop))


def _recommended(m: Measured, loop: Loop | None) -> Iterator[str]:
    if still(m):
        yield "record while the machine moves"
        return
    if m.fit is None:
        yield "record at least ten times the memory of the estimator, with the machine in motion"
        return
    if loop is None and m.best_order is not None:
        b = m.best_order
        settings = [f"order = {b.order}", f'friction = "{b.friction}"', "offset = true"]
        settings += ["stiffness = true"] * b.stiffness
        yield f'[plant] kind = "polynomial", {", ".join(settings)} explains most with least'
    if m.suggested_cutoff_hz is not None and m.cutoff_hz is not None:
        if loop is None:
            words = "up to there y follows the reference and is more than noise"
            yield f"[monitor] cutoff = {m.suggested_cutoff_hz:.2g}: {words}"
        elif m.coherent and m.cutoff_hz > 1.8 * m.suggested_cutoff_hz:
            words = f"above {m.suggested_cutoff_hz:.2g} Hz y is little but noise, or leaves the reference"
            yield f"[monitor] cutoff = {m.suggested_cutoff_hz:.2g} instead of {m.cutoff_hz:.3g}: {words}"
    d = m.delay
    if d is not None and d.seconds is not None and d.gain > DELAY_GAIN:
        if d.seconds > 0.0 and abs(d.seconds * m.sampling.sample_rate_hz - d.configured_samples) > DELAY_TOLERANCE:
            yield f"delay = {d.seconds:.4g}"
        elif d.samples is not None and d.samples < -DELAY_TOLERANCE:
            yield "log u in the sample in which it is put out: it comes late beside y"
    excess = (1.0 - m.fit.explained_ungated) / max(1.0 - m.fit.explained, 1e-12)
    gated = loop is not None and loop.monitor.update_when == "moving"
    if (
        m.rest is not None
        and not gated
        and (m.dead_zone is not None or (excess > 1.3 and m.fit.explained_ungated < 0.99))
    ):
        words = "at rest u says nothing about the plant"
        if loop is None or not (loop.plant.has_physics and loop.controller is not None):
            words += "; this leaves out short rests too, long ones are left out anyway"
        yield f'[monitor] update_when = "moving", rest_speed = {m.rest.speed:.2g}: {words}'
    if m.dead_zone is not None and (loop is None or loop.input_deadzone is None):
        words = "if it is one rather than friction at rest"
        yield f"input_deadzone = [{m.dead_zone.low:.4g}, {m.dead_zone.high:.4g}], {words}"
    if m.saturation is not None and m.saturation.source == "seen":
        ends = " and ".join(f"{end:g}" for end in (m.saturation.low, m.saturation.high) if end is not None)
        yield f"input_limits, if u is limited at {ends}, and input_logged: before or after that"
    memory = loop.monitor.memory if loop is not None else 5.0
    wide = [at for at in m.frequencies if at.relative_std_memory is not None and (at.snr is None or at.snr >= SNR)]
    worst = max((at.relative_std_memory or 0.0 for at in wide), default=0.0)
    if worst > PRECISE:
        longer = memory * min((worst / PRECISE) ** 2, 20.0)
        yield f"[monitor] memory = {longer:.2g} for 5 % at every frequency that is excited"
    lacking = [f"{at.frequency_hz:g}" for at in m.frequencies if weak(m, at)]
    if lacking and loop is not None:
        yield f"[monitor] frequencies without {', '.join(lacking)} Hz, or record a faster motion"
    coarse = [q.signal for q in m.quantisation if q.signal != "r" and (q.effective_bits or 99.0) < FEW_BITS]
    if coarse:
        yield f"log {' and '.join(coarse)} with more digits, or over a larger stroke"
    if m.residual is not None and m.residual.period_s is None:
        yield "record a motion that repeats: then noise and what the model lacks can be told apart"
