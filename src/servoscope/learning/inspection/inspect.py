"""Is this log usable for servoscope, and if not, why: all that is measured, and the verdict."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import PrivateAttr

from servoscope.core.arrays import BoolArray, FloatArray, IndexArray
from servoscope.core.blas import with_one_blas_thread
from servoscope.core.messages import Message, MessageText, message
from servoscope.core.short_repr import ShortRepr
from servoscope.estimation.reference_period import reference_period
from servoscope.learning.inspection import delay, excitation, model_order, signals, simulation_fit
from servoscope.learning.inspection import residual as leftover
from servoscope.learning.inspection.cutoff import suggest_cutoff
from servoscope.learning.inspection.excitation import FrequencyExcitation, Spectra
from servoscope.learning.inspection.model_order import RegressionFit, Regressors
from servoscope.learning.inspection.result import Coefficient, InspectionMeasurements, InverseModelFit, describe_order
from servoscope.learning.inspection.rules import (
    DELAY_GAIN,
    DELAY_TOLERANCE,
    MEMORY_S,
    InspectionFinding,
    InspectionVerdict,
    derive_findings,
    headline,
    is_at_rest,
    overall_verdict,
    recommend,
)
from servoscope.learning.inspection.signals import InspectionModel
from servoscope.models.loop import DEFAULT_FREQUENCIES, Loop
from servoscope.models.lti import settling_samples
from servoscope.signals import MIN_SAMPLES, Recording
from servoscope.signals.quantisation import white_noise_std
from servoscope.signals.readers import as_recording
from servoscope.signals.readers.frames import Source
from servoscope.signals.recording import thin_out

MAX_ROWS = 250_000  # that are analysed: more take memory and time, and show little more
MIN_STRETCH_ROWS = 30_000  # of which a longer recording's consist


@dataclass(frozen=True, eq=False)
class InspectionTraces:
    """What figures need and no summary holds: spectra, residual v (N,) where used, autocorrelation rho.

    `recording`: the N rows that were analysed.
    """

    recording: Recording
    spectra: Spectra | None
    v: FloatArray
    used: BoolArray
    rho: FloatArray


class Inspection(ShortRepr, InspectionMeasurements):
    """What was measured, what follows from it, and the verdict.

    Parameters
    ----------
    verdict, summary
        In a word, and in a sentence.
    findings
        Reasons, the worst first.
    recommendations
        What to set in the loop file, and what to record differently.
    """

    verdict: InspectionVerdict
    summary: MessageText
    findings: tuple[InspectionFinding, ...]
    recommendations: tuple[MessageText, ...]
    _traces: InspectionTraces | None = PrivateAttr(default=None)

    def _shown_facts(self) -> dict[str, object]:
        return {"recording": self.recording, "verdict": self.verdict, "summary": self.summary}

    @property
    def headline(self) -> str:
        """The verdict, and whether the recording is short to learn from."""
        return str(headline(self.findings))

    @property
    def traces(self) -> InspectionTraces | None:
        """What figures are drawn from; None when the inspection was read back from JSON."""
        return self._traces


@with_one_blas_thread
def inspect(recording: Recording | Source, loop: Loop | str | Path | None = None) -> Inspection:
    """Say whether a recording is usable, and if not, why; never raises because of what is in the recording.

    Parameters
    ----------
    recording
        The recording, or what `read` reads: a path, a frame, arrays by name.
    loop
        The loop it was taken from, or its path. Without it a generic inverse (a polynomial in s of order 1 to 3 with
        offset, and with stiffness and Coulomb friction as far as they explain anything) takes its place.

    Returns
    -------
    Inspection
        ``model_dump(mode="json")`` of it is one JSON object without NaN.

    Examples
    --------
    >>> inspect("monday.csv", "loop.toml").verdict
    'usable'
    """
    loop = Loop.of(loop) if loop is not None else None
    return _inspect(as_recording(recording, loop), loop, with_fit=True)


@with_one_blas_thread
def inspect_motion(recording: Recording, loop: Loop | None) -> Inspection:
    """Inspect a recording as far as its plant is not needed: no coefficients, residual, delay and simulation."""
    return _inspect(recording, loop, with_fit=False)


def _inspect(recording: Recording, loop: Loop | None, *, with_fit: bool) -> Inspection:
    whole = recording
    if whole.samples > MAX_ROWS:
        recording = thin_out(whole, MAX_ROWS, MIN_STRETCH_ROWS)
    quantisation = tuple(signals.quantisation(name, getattr(recording, name)) for name in ("r", "u", "y"))
    basics: dict[str, InspectionModel | Message | str | tuple[InspectionModel, ...] | None] = {
        "recording": recording.name,
        "loop": loop.name if loop is not None else None,
        "sampling": signals.sampling(whole),
        "defects": signals.defect_counts(whole),
        "quantisation": quantisation,
    }
    constant = tuple(q.signal for q in quantisation if q.values < 2)
    if recording.samples < MIN_SAMPLES or {"u", "y"} & set(constant):
        return _conclude(InspectionMeasurements.model_validate(basics), loop, constant, None)
    basics["saturation"] = signals.saturation(recording, loop)
    basics["swapped"] = signals.detect_swapped_channels(recording)
    basis = InspectionMeasurements.model_validate(basics)
    measured, traces = _measure_with_model(recording, loop, basis, with_fit=with_fit)
    return _conclude(measured, loop, constant, traces)


def _conclude(
    m: InspectionMeasurements, loop: Loop | None, constant: tuple[str, ...], traces: InspectionTraces | None
) -> Inspection:
    if is_at_rest(m):  # what was measured around them is noise
        m = m.model_copy(update={"frequencies": (), "suggested_cutoff_hz": None})
    findings = derive_findings(m, loop, constant, None if traces is None else traces.recording.samples)
    verdict = overall_verdict(findings)
    severity = {"not usable": "stop", "usable with care": "care", "usable": "none"}[verdict]
    reasons = [finding.message for finding in findings if finding.severity == severity]
    summary = message(
        "inspection.summary",
        recording=m.recording,
        headline=headline(findings),
        reason=message("inspection.summary_reason", reason=reasons[0]) if reasons else None,
        more=message("inspection.summary_more", count=len(reasons) - 1) if len(reasons) > 1 else None,
    )
    inspection = Inspection(
        **{name: getattr(m, name) for name in InspectionMeasurements.model_fields},
        verdict=verdict,
        summary=summary,
        findings=findings,
        recommendations=recommend(m, loop),
    )
    inspection._traces = traces
    return inspection


def _measure_with_model(
    recording: Recording, loop: Loop | None, m: InspectionMeasurements, *, with_fit: bool
) -> tuple[InspectionMeasurements, InspectionTraces]:
    """Add spectra and what needs a model, of which the order comes before the fit."""
    period = reference_period(recording)
    spectra = excitation.spectra(recording, period)
    m = m.model_copy(update={"periods": recording.samples / period if period is not None else None})
    judged = spectra if m.coherent else None
    rate = recording.sample_rate
    traces = InspectionTraces(recording, spectra, np.zeros(0), np.zeros(0, dtype=np.bool_), np.zeros(0))
    noise = white_noise_std(recording.y, recording.restart, m.quantisation[2].step)
    band = excitation.usable_band(spectra) if spectra is not None else None
    derivative = 0 if loop is None else loop.plant.derivative
    suggested = suggest_cutoff(recording, spectra, noise, derivative > 0)
    cutoff = loop.cutoff if loop is not None else suggested
    # Variance of white noise behind a second-order differentiator, and behind the filter's own s F(s).
    sign_rate = 2.0 * math.pi * min(model_order.FAST_SIGN, rate / 4.0)
    own_rate = 2.0 * math.pi * cutoff
    generic = model_order.generic_loop(rate, cutoff, 3.0 * noise * math.sqrt(sign_rate**3 / (4.0 * rate)))
    g = model_order.form_regressors(recording, generic)
    v = g.phi[:, 1 - derivative]
    at_rest, rest_speed = signals.detect_rest(recording, v, noise * math.sqrt(own_rate**3 / (32.0 * rate)))
    moving = model_order.motion_mask(g, at_rest)
    block = settling_samples(cutoff, 4, 1.0 / rate)
    orders, best = model_order.select_order(g, g.ok & moving, block)
    m = m.model_copy(
        update={
            "rest": rest_speed,
            "dead_zone": signals.dead_zone(recording.u, v, rest_speed.speed),
            "band": band if m.coherent else None,
            "frequencies": _frequency_excitations(judged, loop, rate, None, m.coherent),
            "cutoff_hz": cutoff,
            "suggested_cutoff_hz": suggested,
            "orders": orders,
            "best_order": best,
        }
    )
    if best is None or not with_fit:
        return m, traces
    which = model_order.column_indices(g, best.order, best.friction, best.stiffness)
    model = describe_order(best)
    if loop is not None:
        g = model_order.form_regressors(recording, loop)
        which, model = np.arange(g.bank.n, dtype=np.intp), message("inspection.plant_of_loop", kind=loop.plant.kind)
    names = tuple(g.bank.names[i] for i in which)
    used = g.ok & moving
    fit = model_order.fit_regression(names, g.eta, g.columns(which), used, block)
    if fit is None:
        return m, traces
    ungated = model_order.fit_regression(names, g.eta, g.columns(which), g.ok, block) or fit
    residual, independent, rho = leftover.analyse_residual(recording, fit.v, g.eta, used, block, period)
    m = m.model_copy(
        update={
            "frequencies": _frequency_excitations(judged, loop, rate, (g, which, fit), m.coherent),
            "fit": _summarise_fit(model, g, which, fit, ungated),
            "residual": residual,
            "delay": _check_delay(delay.estimate_delay(recording, g, which, fit, independent), recording, loop, g),
            "free_run": simulation_fit.free_run(recording, g, which, fit),
        }
    )
    return m, InspectionTraces(recording, spectra, fit.v, used, rho)


def _check_delay(estimate: delay.Delay, recording: Recording, loop: Loop | None, g: Regressors) -> delay.Delay:
    """Put the likeliest delay in the place of one that the regression, whose regressors are noisy, dates late."""
    if loop is None or estimate.samples is None or estimate.gain <= DELAY_GAIN:
        return estimate
    if estimate.samples < 0.0 or abs(estimate.samples - estimate.configured_samples) <= DELAY_TOLERANCE:
        return estimate
    from servoscope.learning.inspection.delay_fit import fit_delay  # its kernels are loaded for a doubt, not before

    exact = fit_delay(loop, recording, g)
    if exact is None or not exact.white:
        return estimate
    rate = recording.sample_rate
    samples, half = exact.seconds * rate, 1.96 * exact.std_s * rate
    gain = estimate.gain if exact.significant else 0.0
    return delay.Delay.within(samples, samples - half, samples + half, rate, estimate.configured_samples, gain)


def _summarise_fit(
    model: Message, g: Regressors, which: IndexArray, fit: RegressionFit, ungated: RegressionFit
) -> InverseModelFit:
    std = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    rms = np.sqrt((g.columns(which)[fit.used] ** 2).mean(axis=0))
    carried = rms * np.abs(fit.theta)
    leading = int(np.argmax(carried))
    shares = np.where([name == "offset" for name in fit.names], 0.0, carried)
    most = int(np.argmax(shares))
    reversed_ = fit.theta[leading] < -5.0 * std[leading] and fit.names[leading] != "offset"
    eta_rms = np.sqrt((g.eta[fit.used] ** 2).mean())
    heavy = [i for i in np.argsort(-np.abs(fit.weakest)) if abs(fit.weakest[i]) > 0.3]
    return InverseModelFit(
        model=model,
        coefficients={
            name: Coefficient(value=float(value), std=float(s))
            for name, value, s in zip(fit.names, fit.theta, std, strict=True)
        },
        used_share=float(fit.used.mean()),
        explained=fit.explained,
        explained_ungated=ungated.explained,
        condition=fit.condition,
        weakest=" and ".join(fit.names[i] for i in heavy),
        leading=fit.names[most],
        leading_share=float(shares[most] / max(float(eta_rms), np.finfo(np.float64).tiny)),
        wrong_sign=fit.names[leading] if reversed_ else None,
    )


def _frequency_excitations(
    spectra: Spectra | None,
    loop: Loop | None,
    rate: float,
    model: tuple[Regressors, IndexArray, RegressionFit] | None,
    coherent: bool,
) -> tuple[FrequencyExcitation, ...]:
    frequencies = loop.monitor.frequencies if loop is not None else DEFAULT_FREQUENCIES
    memory = (loop.monitor.memory if loop is not None else MEMORY_S) * rate
    rows = []
    for f in frequencies:
        if f >= rate / 2.0:
            continue
        of_u, of_y, snr = excitation.coherence_and_snr(spectra, f) if spectra is not None else (0.0, 0.0, 0.0)
        coherence = (of_u, of_y, snr) if coherent else (None, None, None)
        relative = recent = None
        if model is not None:
            g, which, fit = model
            E = g.bank.E(f)[0, which]
            size = abs(complex(E @ fit.theta))
            variance = float((E @ fit.covariance @ E.conj()).real)
            if size > 0.0:
                relative = math.sqrt(max(variance, 0.0)) / size
                # At P = P_d a memory of N weighs the past like 2 N samples of equal weight.
                recent = relative * math.sqrt(max(float(fit.used.sum()) / (2.0 * memory), 1.0))
        rows.append(
            FrequencyExcitation(
                frequency_hz=f,
                coherence_u=coherence[0],
                coherence_y=coherence[1],
                snr=coherence[2],
                relative_std=relative,
                relative_std_memory=recent,
            )
        )
    return tuple(rows)
