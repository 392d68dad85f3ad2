"""Is this log usable for servoscope, and if not, why: all that is measured, and the verdict."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pydantic import PrivateAttr

from servoscope.inspection import alignment, excitation, freerun, leftover, levels, modelfit
from servoscope.inspection.advice import recommend
from servoscope.inspection.excitation import Excited, Spectra
from servoscope.inspection.judgement import Finding, Verdict, headline_of, judge, still, verdict_of
from servoscope.inspection.levels import BoolArray, Said
from servoscope.inspection.measured import Coefficient, Fit, Measured, described
from servoscope.inspection.modelfit import Fitted, IndexArray, Regressors
from servoscope.inverse import cutoff_of
from servoscope.linear import settling
from servoscope.loop import DEFAULT_FREQUENCIES, Loop
from servoscope.plants import FloatArray
from servoscope.recording import LEAST_SAMPLES, Recording

__all__ = ["Finding", "Inspection", "Traces", "inspect"]

LEAST_USED = 0.1  # share of the samples that must be left when rest is left out
MEMORY = 5.0  # s, without a loop


@dataclass(frozen=True, eq=False)
class Traces:
    """What figures need and no summary holds: spectra, residual v (N,) where used, autocorrelation rho."""

    spectra: Spectra | None
    v: FloatArray
    used: BoolArray
    rho: FloatArray


class Inspection(Measured):
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

    verdict: Verdict
    summary: str
    findings: tuple[Finding, ...]
    recommendations: tuple[str, ...]
    _traces: Traces | None = PrivateAttr(default=None)

    @property
    def headline(self) -> str:
        """The verdict, and whether the recording is short to learn from."""
        return headline_of(self.findings)

    @property
    def traces(self) -> Traces | None:
        """What figures are drawn from; None when the inspection was read back from JSON."""
        return self._traces


def inspect(recording: Recording, loop: Loop | None = None) -> Inspection:
    """Say whether a recording is usable, and if not, why; never raises because of what is in the recording.

    Parameters
    ----------
    recording
        The recording.
    loop
        The loop it was taken from. Without it a generic inverse (a polynomial in s of order 1 to 3 with
        offset, and with stiffness and Coulomb friction as far as they explain anything) takes its place.

    Returns
    -------
    Inspection
        ``model_dump(mode="json")`` of it is one JSON object without NaN.
    """
    quantisation = tuple(levels.quantisation(name, getattr(recording, name)) for name in ("r", "u", "y"))
    basics: dict[str, Said | str | tuple[Said, ...] | None] = {
        "recording": recording.name,
        "loop": loop.name if loop is not None else None,
        "sampling": levels.sampling(recording),
        "defects": levels.defect_counts(recording),
        "quantisation": quantisation,
    }
    constant = tuple(q.signal for q in quantisation if q.values < 2)
    if recording.samples < LEAST_SAMPLES or {"u", "y"} & set(constant):
        return _concluded(Measured.model_validate(basics), loop, constant, None)
    basics["saturation"] = levels.saturation(recording, loop)
    basics["swapped"] = levels.swapped(recording)
    measured, traces = _modelled(recording, loop, Measured.model_validate(basics))
    return _concluded(measured, loop, constant, traces)


def _concluded(m: Measured, loop: Loop | None, constant: tuple[str, ...], traces: Traces | None) -> Inspection:
    if still(m):  # what was measured around them is noise
        m = m.model_copy(update={"frequencies": (), "suggested_cutoff_hz": None})
    findings = judge(m, loop, constant)
    verdict = verdict_of(findings)
    severity = {"not usable": "stop", "usable with care": "care", "usable": "none"}[verdict]
    reasons = [finding.message for finding in findings if finding.severity == severity]
    more = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
    inspection = Inspection(
        **{name: getattr(m, name) for name in Measured.model_fields},
        verdict=verdict,
        summary=f"{m.recording}: {headline_of(findings)}" + (f": {reasons[0]}{more}" if reasons else ""),
        findings=findings,
        recommendations=recommend(m, loop),
    )
    inspection._traces = traces
    return inspection


def _modelled(recording: Recording, loop: Loop | None, m: Measured) -> tuple[Measured, Traces]:
    """Add spectra and all that needs a model."""
    period = leftover.period_of(recording)
    spectra = excitation.spectra(recording, period)
    periods = recording.samples / period if period is not None else None
    m = m.model_copy(update={"periods": periods})
    judged = spectra if m.coherent else None
    rate, traces = recording.sample_rate, Traces(spectra, np.zeros(0), np.zeros(0, dtype=bool), np.zeros(0))
    noise = levels.noise_of(recording.y, recording.restart, m.quantisation[2].step)
    band = excitation.usable_band(spectra) if spectra is not None else None
    suggested = _suggested_cutoff(spectra, band.high_hz if band else None, noise, rate)
    cutoff = cutoff_of(loop) if loop is not None else suggested
    # Variance of white noise behind a second-order differentiator, and behind the filter's own s F(s).
    sign_rate = 2.0 * math.pi * min(modelfit.FAST_SIGN, rate / 4.0)
    own_rate = 2.0 * math.pi * cutoff
    generic = modelfit.generic_loop(rate, cutoff, 3.0 * noise * math.sqrt(sign_rate**3 / (4.0 * rate)))
    g = modelfit.regressors(recording, generic)
    v = g.phi[:, 1]
    at_rest, rest = levels.resting(recording, v, noise * math.sqrt(own_rate**3 / (32.0 * rate)))
    moving = _moving(g, at_rest)
    block = settling(cutoff, 4, 1.0 / rate)
    orders, best = modelfit.try_orders(g, g.ok & moving, block)
    m = m.model_copy(
        update={
            "rest": rest,
            "dead_zone": levels.dead_zone(recording.u, v, rest.speed),
            "band": band if m.coherent else None,
            "frequencies": _excited(judged, loop, rate, None, m.coherent),
            "cutoff_hz": cutoff,
            "suggested_cutoff_hz": suggested,
            "orders": orders,
            "best_order": best,
        }
    )
    if best is None:
        return m, traces
    which = modelfit.columns_of(g, best.order, best.friction, best.stiffness)
    model = described(best)
    if loop is not None:
        g = modelfit.regressors(recording, loop)
        which, model = np.arange(g.bank.n, dtype=np.intp), f"the loop's {loop.plant.kind} plant"
    names = tuple(g.bank.names[i] for i in which)
    used = g.ok & moving
    fitted = modelfit.fit(names, g.eta, g.columns(which), used, block)
    if fitted is None:
        return m, traces
    ungated = modelfit.fit(names, g.eta, g.columns(which), g.ok, block) or fitted
    residual, independent, rho = leftover.describe(recording, fitted.v, g.eta, used, block, period)
    m = m.model_copy(
        update={
            "frequencies": _excited(judged, loop, rate, (g, which, fitted), m.coherent),
            "fit": _told(model, g, which, fitted, ungated),
            "residual": residual,
            "delay": alignment.estimate(recording, g, which, fitted, independent),
            "free_run": freerun.free_run(recording, g, which, fitted),
        }
    )
    return m, Traces(spectra, fitted.v, used, rho)


def _suggested_cutoff(spectra: Spectra | None, coherent: float | None, noise: float, rate: float) -> float:
    """Return a tenth of the sample rate, or up to where y is more than noise and follows r, if less."""
    if spectra is None:
        return rate / 10.0
    edge = min(rate / 10.0, excitation.information_edge(spectra, noise, rate), coherent or math.inf)
    return float(f"{min(max(edge, 4.0 * float(spectra.f[0])), rate / 10.0):.3g}")


def _moving(g: Regressors, at_rest: BoolArray) -> BoolArray:
    """Return where neither the output rests nor the filters remember a rest, if enough is left then."""
    last = np.where(at_rest, np.arange(at_rest.size), -g.bank.wait - 1)
    moving = np.arange(at_rest.size) - np.maximum.accumulate(last) > g.bank.wait
    for mask in (moving, ~at_rest):
        if (g.ok & mask).sum() >= max(LEAST_USED * at_rest.size, 100):
            return np.asarray(mask)
    return np.ones_like(at_rest)


def _told(model: str, g: Regressors, which: IndexArray, fitted: Fitted, ungated: Fitted) -> Fit:
    std = np.sqrt(np.maximum(np.diag(fitted.covariance), 0.0))
    rms = np.sqrt((g.columns(which)[fitted.used] ** 2).mean(axis=0))
    carried = rms * np.abs(fitted.theta)
    leading = int(np.argmax(carried))
    shares = np.where([name == "offset" for name in fitted.names], 0.0, carried)
    most = int(np.argmax(shares))
    reversed_ = fitted.theta[leading] < -5.0 * std[leading] and fitted.names[leading] != "offset"
    eta_rms = np.sqrt((g.eta[fitted.used] ** 2).mean())
    heavy = [i for i in np.argsort(-np.abs(fitted.weakest)) if abs(fitted.weakest[i]) > 0.3]
    return Fit(
        model=model,
        coefficients={
            name: Coefficient(value=float(value), std=float(s))
            for name, value, s in zip(fitted.names, fitted.theta, std, strict=True)
        },
        used_share=float(fitted.used.mean()),
        explained=fitted.explained,
        explained_ungated=ungated.explained,
        condition=fitted.condition,
        weakest=" and ".join(fitted.names[i] for i in heavy),
        leading=fitted.names[most],
        leading_share=float(shares[most] / max(float(eta_rms), np.finfo(np.float64).tiny)),
        wrong_sign=fitted.names[leading] if reversed_ else None,
    )


def _excited(
    spectra: Spectra | None,
    loop: Loop | None,
    rate: float,
    model: tuple[Regressors, IndexArray, Fitted] | None,
    coherent: bool,
) -> tuple[Excited, ...]:
    frequencies = loop.monitor.frequencies if loop is not None else DEFAULT_FREQUENCIES
    memory = (loop.monitor.memory if loop is not None else MEMORY) * rate
    told = []
    for f in frequencies:
        if f >= rate / 2.0:
            continue
        of_u, of_y, snr = excitation.signal_at(spectra, f) if spectra is not None else (0.0, 0.0, 0.0)
        seen = (of_u, of_y, snr) if coherent else (None, None, None)
        relative = recent = None
        if model is not None:
            g, which, fitted = model
            E = g.bank.E(f)[0, which]
            size = abs(complex(E @ fitted.theta))
            variance = float((E @ fitted.covariance @ E.conj()).real)
            if size > 0.0:
                relative = math.sqrt(max(variance, 0.0)) / size
                # At P = P_d a memory of N weighs the past like 2 N samples of equal weight.
                recent = relative * math.sqrt(max(float(fitted.used.sum()) / (2.0 * memory), 1.0))
        told.append(
            Excited(
                frequency_hz=f,
                coherence_u=seen[0],
                coherence_y=seen[1],
                snr=seen[2],
                relative_std=relative,
                relative_std_memory=recent,
            )
        )
    return tuple(told)
