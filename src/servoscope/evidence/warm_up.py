"""Healthy recordings without a thermometer -> how a warm-up that nobody measures moves the coefficients."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from servoscope.baseline.covariates import CovariateModel, WarmUp
from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.errors import NotEnoughError
from servoscope.core.messages import message
from servoscope.detection.warm_up import BLOCK_MEMORIES, NAME, BlockSums, WarmUpFit, fit_course
from servoscope.estimation.pipeline import Pipeline, Regression
from servoscope.evidence.covariates import MIN_PROPORTIONAL_STDS, STRETCH, refer_to_covariates
from servoscope.evidence.examination import Examination
from servoscope.evidence.kind import EvidenceKind, Finding
from servoscope.fit.search import minimise_from_grid
from servoscope.fit.tuning import TuningFit
from servoscope.models.lti import solve_scaled
from servoscope.signals import Recording

TIME_CONSTANT_GRID_SIZE = 16  # time constants before the best is refined
MAX_DURATIONS = 20.0  # durations of a recording
ROUNDS = 2  # courses make a model of the coefficients, which makes better courses
MIN_SQUARED_COSINE = 0.95  # squared cosine from which on a change counts as looking like another temperature
MIN_WARMING_STDS = 5.0  # standard deviations by which the warmest recording has to warm


def fit_warm_up(
    pipeline: Pipeline, recordings: Sequence[Recording], regressions: Sequence[Regression], fit: TuningFit
) -> tuple[CovariateModel, Sequence[Regression], TuningFit, Sequence[Recording]]:
    """Return what `fit_covariates` does for a warm-up that nobody measured, and recordings that carry it as a channel.

    The coefficients of short
    stretches move along one direction (the first principal component in the metric of their noise); the time constant
    is that with which courses along it explain the recordings best.

    Raises NotEnoughError if no recording warms up, or what `fit_covariates` raises.
    """
    sums = [BlockSums.of(pipeline, rec) for rec in recordings]
    power = max(float(np.mean([block_sums.losses.mean() for block_sums in sums])), 0.0)
    blank = WarmUp(time_constant_s=1.0, power=power, variance=fit.tuning.R)
    theta, model = _principal_direction(sums, fit)
    warm_up = _with_time_constant(blank, sums, theta, model, max(rec.duration_s for rec in recordings))
    for _ in range(ROUNDS):
        courses = [fit_course(block_sums, warm_up, theta, model) for block_sums in sums]
        warm_up = warm_up.model_copy(update={"variance": _variance(sums, courses)})
        courses = [fit_course(block_sums, warm_up, theta, model) for block_sums in sums]
        carried = [
            replace(rec, channels={**rec.channels, NAME: block_sums.at_samples(course.course, rec.samples)})
            for rec, block_sums, course in zip(recordings, sums, courses, strict=True)
        ]
        model, referred, fit_there = refer_to_covariates(pipeline, carried, regressions, fit, (NAME,))
        theta = fit_there.tuning.theta
    if max(np.ptp(course.course) / course.std.max() for course in courses) < MIN_WARMING_STDS:
        raise NotEnoughError("no recording warms up enough to tell what warmth does: record a start from cold")
    return model.model_copy(update={"warm_up": warm_up}), referred, fit_there, carried


def _principal_direction(sums: Sequence[BlockSums], fit: TuningFit) -> tuple[FloatArray, CovariateModel]:
    """Return the coefficients in the middle of what the stretches show, and a straight line through them."""
    estimates, whose = [], []
    for i, block_sums in enumerate(sums):
        blocks = max(round(STRETCH / BLOCK_MEMORIES), 1)
        for first in range(0, len(block_sums.first) - blocks + 1, blocks):
            A, b = (
                block_sums.normal[first : first + blocks].sum(axis=0),
                block_sums.moment[first : first + blocks].sum(axis=0),
            )
            if np.linalg.matrix_rank(A / np.sqrt(np.outer(np.diag(A), np.diag(A)))) == len(A):
                estimates.append((solve_scaled(A, b), A))
                whose.append(i)
    if len(estimates) < 3:
        raise NotEnoughError("too short to show what a warm-up does: record longer, from a cold start on")
    theta, A = (np.array(column) for column in zip(*estimates, strict=True))
    std = np.sqrt(fit.tuning.R * np.array([np.diag(np.linalg.inv(information)) for information in A]))
    proportional = (np.sign(theta) == np.sign(theta[0])).all(axis=0) & (
        np.abs(theta) > MIN_PROPORTIONAL_STDS * std
    ).all(axis=0)
    size = np.where(proportional, theta.mean(axis=0), 1.0)
    y = np.where(proportional, np.log(np.abs(np.where(proportional, theta, 1.0))), theta)
    root = np.linalg.cholesky((A * np.outer(size, size)).mean(axis=0)).T
    off = y - y.mean(axis=0)
    direction = np.linalg.svd(off @ root.T, full_matrices=False)[2][0]
    w, v = off @ root.T @ direction, np.linalg.solve(root, direction)
    if sum(float(np.diff(w[np.array(whose) == i]).sum()) for i in set(whose)) < 0.0:
        w, v = -w, -v  # warmer is later
    half, middle = 0.5 * float(np.ptp(w)), 0.5 * float(w.max() + w.min())
    origin = y.mean(axis=0) + middle * v
    return np.where(proportional, np.sign(theta[0]) * np.exp(origin), origin), _line(half * v, proportional)


def _line(slope: FloatArray, proportional: BoolArray) -> CovariateModel:
    n = len(slope)
    return CovariateModel(
        names=(NAME,),
        low=(0.0,),
        high=(1.0,),
        degrees=(1,),
        proportional=tuple(proportional.tolist()),
        slopes=(tuple(slope.tolist()),),
        covariance=((0.0,) * n,) * n,
    )


def _with_time_constant(
    blank: WarmUp, sums: Sequence[BlockSums], theta: FloatArray, model: CovariateModel, duration_s: float
) -> WarmUp:
    """Return the warm-up with the time constant that leaves least of the recordings unexplained."""

    def made(log_s: float) -> WarmUp:
        return blank.model_copy(update={"time_constant_s": float(np.exp(log_s))})

    def cost(log_s: float) -> float:
        return sum(fit_course(block_sums, made(log_s), theta, model).cost for block_sums in sums)

    tried = np.linspace(np.log(sums[0].seconds), np.log(MAX_DURATIONS * duration_s), TIME_CONSTANT_GRID_SIZE)
    return made(minimise_from_grid(cost, tried, 0.01))


def _variance(sums: Sequence[BlockSums], courses: Sequence[WarmUpFit]) -> float:
    """Return the variance of eta's residual that sums over blocks show, whatever its colour within them."""
    parts = [
        np.trace(np.linalg.solve(block_sums.normal.sum(axis=0), fit.residual.T @ fit.residual))
        / block_sums.moment.shape[1]
        for block_sums, fit in zip(sums, courses, strict=True)
    ]
    return float(np.mean(parts))


def changes_like_warmth(exam: Examination) -> dict[str, float]:
    """Return, by parameter, the relative change that does nearly what the whole learned warm-up does, if one does."""
    along, last = exam.along, exam.evaluations - 1
    if along is None or along.std is None or last < 0:
        return {}
    c = along.averages[exam.estimates.index[last]]
    step = 0.5 * (np.array(along.model.high) - np.array(along.model.low))
    warmth = (along.model.theta(along.theta, c + 1e-3 * step) - along.model.theta(along.theta, c - 1e-3 * step)) / 2e-3
    slopes = {}
    for name, d in exam.baseline.fault_directions.items():
        known_d, known_w = np.linalg.solve(exam.covariance(last), np.stack([d, warmth], axis=1)).T
        if float(d @ known_w) ** 2 >= MIN_SQUARED_COSINE * float(d @ known_d) * float(warmth @ known_w):
            slopes[name] = 2.0 * abs(float(d @ known_w)) / float(d @ known_d)
    return slopes


def _judge(exam: Examination) -> Iterator[Finding]:
    """Yield that some changes cannot be told from a temperature that nobody has logged."""
    if exam.along is not None and exam.along.std is not None:
        alike = list(changes_like_warmth(exam)) or list(exam.baseline.names)
        yield Finding.throughout(exam, "doubt", "warm_up", message("warning.warm_up", parameters=alike))


WARM_UP = EvidenceKind("covariates", judge=_judge)
