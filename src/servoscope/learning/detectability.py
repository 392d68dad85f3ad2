"""What a baseline can promise: the smallest change it sees, the budget its data support, the model error they show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.plant_fit import can_simulate, fault_directions
from servoscope.baseline.records import AlarmThresholds, Detectability, DetectableChange
from servoscope.baseline.threshold import SECONDS_PER_YEAR, threshold
from servoscope.core.arrays import FloatArray
from servoscope.core.messages import Message, message
from servoscope.detection.statistic import noncentrality, required_noncentrality, t2_statistic
from servoscope.estimation.pipeline import Estimates, Pipeline
from servoscope.evidence.kind import HealthyRecordings
from servoscope.fit.tuning import TuningFit
from servoscope.learning.healthy_plant import PlantKnowledge
from servoscope.learning.inspection.rules import GOOD_EXPLAINED_SHARE, MIN_MEMORIES
from servoscope.learning.instrument import noise_moments
from servoscope.learning.scatter import HealthyPaths, Scatter, forecast_covariance
from servoscope.models.loop import Loop
from servoscope.models.lti import solve_scaled

MAX_SUPPORTED_BUDGET = 8766.0  # false alarms per year, one an hour: above, nothing is supported
MIN_USELESS_CHANGE = 1.0  # relative change: where only larger ones can be detected, nothing can
MAX_SILENT_BIAS_STDS = 1.0 / 3.0  # standard deviations that noise in phi may move the iFRF in silence
MAX_T2_PER_COEFFICIENT = 2.0  # T^2 per coefficient on healthy data above which the model is said to be wrong


def learn_detectability(
    healthy: HealthyRecordings,
    plant: PlantKnowledge,
    paths: HealthyPaths,
    scatter: Scatter,
    covariance: FloatArray,
    transient: FloatArray,
    thresholds: AlarmThresholds,
) -> tuple[Detectability, list[Message]]:
    """Judge what coefficients with a covariance (n, n), of which a part fades, can show, and note what limits it."""
    loop, fit, monitor = healthy.loop, plant.fit, healthy.loop.monitor
    notes = noise_notes(healthy.pipeline, fit, paths.estimates, can_simulate(loop))
    excess, suggestion = baseline_misfit(paths.estimates, paths.deviations, covariance, fit)
    if fit.explained < GOOD_EXPLAINED_SHARE:
        notes.append(message("learning.hardly_explained", share=fit.explained))
    if excess > MAX_T2_PER_COEFFICIENT and monitor.model_error < suggestion:
        notes.append(message("learning.model_error", excess=excess, model_error=suggestion))
    duration, least = sum(rec.duration_s for rec in healthy.recordings), MIN_MEMORIES * monitor.memory
    if duration < least:
        notes.append(message("learning.short", duration_s=duration, memory_s=monitor.memory, least_s=least))
    supported = supported_budget(len(covariance), loop, fit.dof, excess)
    if supported > max(MAX_SUPPORTED_BUDGET, monitor.false_alarms_per_year):
        notes.append(message("learning.no_budget", excess=excess))
    elif supported > monitor.false_alarms_per_year:
        notes.append(message("learning.budget", supported=supported, budget=monitor.false_alarms_per_year))
    directions = fault_directions(loop, plant.plant, scatter.theta)
    changes, without_scatter = (
        detectable_changes(loop, directions, paths.estimates, C, thresholds.statistic)
        for C in (covariance - np.diag(transient), scatter.theta_covariance + scatter.error)
    )
    smallest, fault = _smallest_change(changes)
    if smallest >= MIN_USELESS_CHANGE:
        key = "scatter" if _smallest_change(without_scatter)[0] < MIN_USELESS_CHANGE else "noise"
        reason = message(f"learning.nothing_{key}")
        notes.append(message("learning.nothing_detectable", reason=reason, smallest=smallest, fault=fault))
    return Detectability(
        explained=fit.explained,
        suggested_model_error=suggestion,
        supported_false_alarms_per_year=supported,
        changes=changes,
    ), notes


def forecast_changes(baseline: Baseline, further: int) -> dict[str, tuple[float, float]]:
    """Return the smallest detectable changes now and with `further` recordings like those before, by fault.

    With forgetting, theta_hat has the covariance P_d/2; what is not detected now is left out.
    """
    S, directions = np.array(baseline.recursion.P_d) / 2.0, baseline.fault_directions
    before, after = baseline.covariance_after(np.array(np.inf)), forecast_covariance(baseline, further)
    changes = {}
    for change in baseline.detectability.changes:
        d = directions[change.parameter]
        if change.change is not None:
            gain = (d @ solve_scaled(S + before, d)) / (d @ solve_scaled(S + after, d))
            changes[change.name] = change.change, change.change * float(np.sqrt(gain))
    return changes


def _smallest_change(changes: Sequence[DetectableChange]) -> tuple[float, str]:
    """Return the smallest change that can be detected, infinite where there is none, and the name of its fault."""
    return min(((change.change or np.inf, change.name) for change in changes), default=(0.0, ""))


def baseline_misfit(
    estimates: Sequence[Estimates], deviations: Sequence[FloatArray], covariance: FloatArray, fit: TuningFit
) -> tuple[float, float]:
    """Return T^2 per coefficient on the healthy data themselves, and the model error that would bring it to one."""
    from scipy.optimize import brentq

    learned = [e.updates > 0 for e in estimates]
    S = np.concatenate([e.S[ok] for e, ok in zip(estimates, learned, strict=True)])
    d = np.concatenate([deviation[ok] for deviation, ok in zip(deviations, learned, strict=True)])
    if not len(d):
        return 0.0, 0.0
    unit = np.diag((fit.rms_eta / fit.tuning.scale) ** 2)

    def mean(rho: float) -> float:
        T2 = t2_statistic(d, np.zeros_like(d), S + covariance + rho**2 * unit)
        return float(T2.mean()) / float(d.shape[1])

    excess = mean(0.0)
    if excess <= 1.0 or mean(0.5) > 1.0:
        return excess, 0.0 if excess <= 1.0 else 0.5
    root = brentq(lambda rho: mean(rho) - 1.0, 0.0, 0.5, xtol=1e-4)
    return excess, float(root)


def supported_budget(n: int, loop: Loop, dof: float, excess: float) -> float:
    """Return the smallest budget that the data speak for [false alarms per year].

    The tail of T^2 is extrapolated from the estimated noise; that is trusted while the noise's own uncertainty raises
    the threshold by less than half, and not at all where healthy data contradict the noise model.
    """
    if excess > MAX_T2_PER_COEFFICIENT:
        return SECONDS_PER_YEAR / loop.monitor.memory
    looks = loop.monitor.evaluation_rate, loop.monitor.memory
    for exponent in np.arange(-3.0, 9.0, 0.5):
        budget = float(10.0**exponent)
        if threshold(n, *looks, budget, dof) <= 1.5 * threshold(n, *looks, budget, 1e9):
            return budget
    return SECONDS_PER_YEAR * looks[0]


def noise_bias(pipeline: Pipeline, fit: TuningFit, estimates: Sequence[Estimates]) -> tuple[FloatArray, FloatArray]:
    """Return what noise in phi does to the iFRF, and the standard deviation of one estimate, both relative to |H|.

    Least squares are off by -(R_phi + S)^-1 S theta, S the covariance that the sensor's white noise has behind the
    filters (errors in variables; Soderstrom, 2007). Shapes (F,), (F,); zeros with an instrument and where the noise is
    not known.
    """
    loop, bank = pipeline.loop, pipeline.bank
    nothing = np.zeros(len(loop.monitor.frequencies))
    last = [e.S[-1] for e in estimates if len(e.S) and e.updates[-1] > 0]
    if bank.has_instrument or fit.noises is None or not last:
        return nothing, nothing
    S = fit.noises.noise.y_std**2 * noise_moments(bank)
    R_phi = np.asarray(fit.tuning.R / pipeline.memory * np.linalg.inv(fit.tuning.P_d), dtype=np.float64)
    E = bank.E(loop.monitor.frequencies)
    H = np.abs(E @ fit.tuning.theta)
    bias = np.abs(E @ solve_scaled(R_phi, S @ fit.tuning.theta))
    spread = np.mean(last, axis=0)
    std = np.sqrt(np.einsum("fi,ij,fj->f", E, spread, E.conj()).real)
    return bias / H, std / H


def noise_notes(pipeline: Pipeline, fit: TuningFit, estimates: Sequence[Estimates], simulated: bool) -> list[Message]:
    """Note where noise in phi moves the iFRF by more than a third of its standard deviation, and what helps."""
    loop = pipeline.loop
    bias, std = noise_bias(pipeline, fit, estimates)
    if not np.any(bias > MAX_SILENT_BIAS_STDS * std):
        return []
    at = int(np.argmax(bias / np.maximum(std, 1e-12)))
    if simulated:
        remedy = message("learning.bias_corrected")
    elif loop.controller is not None:
        remedy = message("learning.bias_instrument")
    else:
        remedy = message("learning.bias_cutoff", cutoff_hz=loop.cutoff / 2.0)
    values = {"bias": float(bias[at]), "std": float(std[at]), "frequency_hz": loop.monitor.frequencies[at]}
    return [message("learning.noise_bias", remedy=remedy, **values)]


def detectable_changes(
    loop: Loop, directions: dict[str, FloatArray], estimates: Sequence[Estimates], covariance: FloatArray, limit: float
) -> tuple[DetectableChange, ...]:
    """Return the smallest change of each fault's parameter that the baseline's own excitation shows."""
    rows = np.array(list(directions.values()))
    seen = []
    for e in estimates:
        half = slice(len(e.theta) // 2, None)
        if len(e.theta[half]):
            seen.append(np.median(noncentrality(e.S[half] + covariance, e.Psi[half], rows), axis=0))
    needed = required_noncentrality(covariance.shape[0], limit)
    best = np.max(seen, axis=0) if seen else np.zeros(len(rows))
    return tuple(
        DetectableChange(
            name=fault.name,
            parameter=fault.parameter,
            change=float(np.sqrt(needed / information)) if information > 0.0 else None,
        )
        for fault, information in zip(loop.plant.faults, best, strict=True)
    )
