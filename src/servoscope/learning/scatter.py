"""A step of learning: how recordings scatter beyond their noise, and the limits that follow from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from servoscope.baseline.baseline import SETTLED_MEMORIES, Baseline
from servoscope.baseline.covariates import CovariatePath
from servoscope.baseline.hypothesis import CusumHypothesis
from servoscope.baseline.records import AlarmThresholds
from servoscope.baseline.threshold import CalibrationFactors, t2_threshold
from servoscope.core.arrays import FloatArray
from servoscope.core.messages import Message
from servoscope.detection import homogeneity
from servoscope.estimation.pipeline import Estimates
from servoscope.evidence.kind import HealthyRecordings
from servoscope.learning.healthy_plant import PlantKnowledge

MIN_CERTAIN_STDS = 3.0  # standard deviations from zero from which the scatter of a coefficient is relative
MIN_NOISE_SHARE = 1e-3  # of a variance, that is not scatter
MIN_EIGENVALUE = 1e-9  # of a covariance in units of its diagonal


@dataclass(frozen=True, eq=False)
class Scatter:
    """What is known of the coefficients between recordings."""

    theta: FloatArray  # coefficients, shape (n,), with their covariance (n, n)
    theta_covariance: FloatArray
    own: FloatArray  # covariance between the recordings less that of their noise, shape (n, n)
    between: FloatArray  # variance of a further recording beyond its noise, shape (n, n)
    error: FloatArray  # what the model of the plant may be off by, shape (n, n)
    carried: FloatArray  # variances of a further recording that an earlier baseline knew, (n,), or none
    notes: tuple[Message, ...]


@dataclass(frozen=True, eq=False)
class HealthyPaths:
    """What the recursion makes of the healthy recordings."""

    estimates: Sequence[Estimates]
    deviations: Sequence[FloatArray]  # from what is expected of a healthy loop, shapes (K, n)


def learn_scatter(
    healthy: HealthyRecordings, plant: PlantKnowledge, axis_scatter: FloatArray | None, earlier: Baseline | None
) -> Scatter:
    """Compare the recordings; scatter of an axis counts too, for a change within a recording is told from its past.

    A stretch after a repair shows little of how days differ: the relative scatter of an `earlier` baseline of more
    recordings counts, and twice, for the stretch is one draw, and a further recording is another.
    """
    fit, population, m = healthy.fit, healthy.population, len(healthy.recordings)
    error = np.diag((healthy.loop.monitor.model_error * fit.rms_eta / fit.tuning.scale) ** 2)
    if axis_scatter is not None:
        error += np.diag(axis_scatter**2)
    apart, noise = plant.deviations, fit.each_covariance
    own, between = homogeneity.between_covariance(apart, noise), homogeneity.scatter(apart, noise)
    theta, covariance = plant.theta, nearest_covariance(plant.theta_covariance)
    if population is not None:
        pooled = population.pooled_scatter(own, m)
        between = pooled * (1.0 + 1.0 / m)
        if not plant.ratios:
            theta, covariance = population.theta.combine(theta, covariance + pooled / m)
            between = pooled  # what the mean of m recordings is off by is in the covariance of theta now
    carried = np.zeros(0) if earlier is None else carry_scatter(earlier, theta)
    if carried.size:
        between = between + np.diag(np.maximum(2.0 * carried - np.diag(between), 0.0))
    outliers = homogeneity.find_outliers(apart, noise + error)
    names = [rec.name for rec in healthy.recordings]
    notes = homogeneity.describe_outliers(outliers, names, healthy.pipeline.bank.names)
    return Scatter(theta, covariance, own, between, error, carried, tuple(notes))


def carry_scatter(earlier: Baseline, theta: FloatArray) -> FloatArray:
    """Return the variances (n,) of a further recording that a baseline knows, at coefficients (n,).

    They are relative, but for coefficients that are hardly known.
    """
    known, m = earlier.scatter, len(earlier.sources)
    variances = np.zeros(len(theta))
    if known.between and (m >= homogeneity.MIN_RECORDINGS or not earlier.thresholds.hypotheses):
        variances = np.maximum(np.diag(np.array(known.between)), 0.0) * homogeneity.prediction_factor(m)
    if known.carried:
        variances = np.maximum(variances, known.carried)
    before = np.array(earlier.theta)
    certain = before**2 > MIN_CERTAIN_STDS**2 * np.diag(earlier.covariance_array())
    ratios = np.divide(theta, before, out=np.ones_like(theta), where=certain)
    return np.asarray(variances * ratios**2)


def forecast_covariance(baseline: Baseline, further: int) -> FloatArray:
    """Return the covariance (n, n) to expect of a baseline that learns `further` recordings like those before.

    What is not scatter is noise of the mean, which falls with their number; the scatter is predicted the better, the
    more recordings show it.
    """
    known, m, C = baseline.scatter, len(baseline.sources), baseline.covariance_after(np.array(np.inf))
    own = np.maximum(np.diag(np.array(known.between)), 0.0) if known.between else np.zeros(len(C))
    carried = 2.0 * np.array(known.carried or np.zeros(len(C)))

    def ahead(count: int) -> FloatArray:
        counts = count >= homogeneity.MIN_RECORDINGS or not baseline.thresholds.hypotheses
        scatter = counts * own * homogeneity.prediction_factor(count)
        return np.maximum(scatter, carried) if count < known.carried_from else scatter

    noise = np.maximum(np.diag(C) - ahead(m), MIN_NOISE_SHARE * np.diag(C))
    scale = np.sqrt((noise * m / (m + further) + ahead(m + further)) / np.diag(C))
    return np.asarray(C * np.outer(scale, scale))  # with the correlations that there are: it stays positive definite


def learn_thresholds(
    healthy: HealthyRecordings,
    calibration: CalibrationFactors,
    hypotheses: tuple[CusumHypothesis, ...],
    features: bool,
) -> AlarmThresholds:
    """Share the budget of false alarms between the tests that there are."""
    n, dof = healthy.pipeline.bank.n, healthy.fit.dof
    limit = t2_threshold(healthy.loop, n, dof, calibration, bool(hypotheses), features)
    return AlarmThresholds(dof=dof, statistic=limit, calibration=calibration, hypotheses=hypotheses)


def follow_recordings(healthy: HealthyRecordings, plant: PlantKnowledge, theta: FloatArray) -> HealthyPaths:
    """Run the recursion over the healthy recordings, from the healthy coefficients (n,) on."""
    pipeline, tuning = healthy.pipeline, replace(plant.fit.tuning, theta=theta)
    estimates, deviations = [], []
    for i, rec in enumerate(healthy.recordings):
        path = None
        if healthy.covariates is not None:
            path = CovariatePath.of(healthy.covariates, theta, rec.channels, pipeline.memory_samples)
        e = pipeline.estimate(tuning if path is None else replace(tuning, theta=path.start), rec)
        expected = theta
        if plant.expectations:
            expected = replace(plant.expectations[i], tuning=tuning).healthy_path(plant.plant, plant.model_theta)
        if path is not None:
            expected = expected + (path.expected(e.index) - theta)
        estimates.append(e)
        deviations.append(e.theta - expected)
    return HealthyPaths(estimates, deviations)


def widen_scatter(
    healthy: HealthyRecordings, plant: PlantKnowledge, scatter: Scatter, paths: HealthyPaths, limit: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the covariance of a further recording (n, n), and the T^2 of each over its limit without it, (m,).

    Judged by the others, none of four or more recordings may be an alarm. The third is the part (n,) of the
    covariance's diagonal that covers transients.
    """
    population, noise = healthy.population, healthy.fit.each_covariance
    shares = [e.Psi for e in paths.estimates]
    between = homogeneity.cover_transients(scatter.between, shares)
    others = homogeneity.scatter_of_others(plant.deviations, noise, shares)
    told = others if population is None and not scatter.carried.size else [between] * len(shares)
    known = scatter.theta_covariance + scatter.error
    updated = [e.updates > 0 for e in paths.estimates]
    followed = [(d[at], e.S[at]) for d, e, at in zip(paths.deviations, paths.estimates, updated, strict=True)]
    factor, left_out = homogeneity.leave_one_out(followed, plant.deviations, told, known, limit)
    settled = SETTLED_MEMORIES * healthy.pipeline.memory
    late = [e.Psi[e.updates > settled] for e in paths.estimates]
    transient = np.diag(between - homogeneity.cover_transients(scatter.between, late))
    lasts = all(2 * len(part) >= len(Psi) for part, Psi in zip(late, shares, strict=True))
    return known + factor * between, left_out, factor * np.maximum(transient, 0.0) * lasts


def nearest_covariance(C: FloatArray) -> FloatArray:
    """Return a covariance (n, n) without directions that are negative, or zero, by more than rounding can tell.

    Coefficients that recordings do not tell apart leave such.
    """
    size = np.sqrt(np.maximum(np.diag(C), np.finfo(np.float64).tiny))
    values, directions = np.linalg.eigh((C + C.T) / np.outer(size, size) / 2.0)
    if values[0] > MIN_EIGENVALUE:
        return C
    lifted = (directions * np.maximum(values, MIN_EIGENVALUE)) @ directions.T
    return np.asarray(lifted * np.outer(size, size))
