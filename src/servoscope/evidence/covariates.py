"""How the coefficients of healthy recordings move with logged covariates, and where these leave what was learned."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from servoscope.baseline.covariates import CovariateModel, CovariatePath
from servoscope.core.arrays import FloatArray, to_tuples
from servoscope.core.errors import NotEnoughError
from servoscope.core.messages import message
from servoscope.detection.statistic import t2_statistic
from servoscope.estimation.pipeline import Pipeline, Regression
from servoscope.evidence.examination import Examination
from servoscope.evidence.kind import EvidenceKind, Finding
from servoscope.fit.tuning import TuningFit, coloured_covariance, fit_tuning, least_squares
from servoscope.signals import Recording

STRETCH = 2.0  # memories over which coefficients count as constant
DISTINCT_VALUES_SHARE = 0.05  # share of the range, by which two values count as two
MAX_DEGREE = 2
# standard deviations from zero from which a coefficient changes in proportion, as physics do
MIN_PROPORTIONAL_STDS = 10.0
ROUNDS = 3  # the first finds the noise, in which the covariates had still counted
MIN_SAMPLES_PER_COEFFICIENT = 20  # usable samples of a recording, or of a stretch of it
GRID_SIZE = 201  # values of a covariate that are tried


def fit_covariates(
    pipeline: Pipeline, recordings: Sequence[Recording], regressions: Sequence[Regression], fit: TuningFit
) -> tuple[CovariateModel, Sequence[Regression], TuningFit, Sequence[Recording]]:
    """Return what `refer_to_covariates` does for those that the loop file names, and the recordings."""
    names = tuple(pipeline.loop.columns.covariates)
    return *refer_to_covariates(pipeline, recordings, regressions, fit, names), recordings


def refer_to_covariates(
    pipeline: Pipeline,
    recordings: Sequence[Recording],
    regressions: Sequence[Regression],
    fit: TuningFit,
    names: Sequence[str],
) -> tuple[CovariateModel, Sequence[Regression], TuningFit]:
    """Return the model of the covariates, and regressions and tuning as if these had stayed at its origin.

    Errors are those of `learn_covariates`.
    """
    referred = regressions
    for _ in range(ROUNDS):
        model = learn_covariates(pipeline, recordings, regressions, fit, names)
        referred = at_origin(model, fit.tuning.theta, recordings, regressions)
        fit = fit_tuning(pipeline, referred)
    return model, referred, fit


def learn_covariates(
    pipeline: Pipeline,
    recordings: Sequence[Recording],
    regressions: Sequence[Regression],
    fit: TuningFit,
    names: Sequence[str],
) -> CovariateModel:
    """Fit the coefficients of short stretches as polynomials of the covariates (generalised least squares).

    What noise does not explain of their scatter widens the covariance (dispersion; McCullagh and Nelder, 1989, 4.5).

    Raises NotEnoughError if a covariate is missing or hardly varies, or if the stretches are too few.
    """
    for name in names:
        for rec in recordings:
            if name not in rec.channels or np.isnan(rec.channels[name]).all():
                raise NotEnoughError(f"{rec.name}: no values of covariate {name}, which the loop file names")
    c, theta, covariance = _stretches(pipeline, recordings, regressions, fit, names)
    low, high = c.min(axis=0), c.max(axis=0)
    degrees = []
    for j, name in enumerate(names):
        steps = np.diff(np.sort(c[:, j])) if high[j] > low[j] else np.zeros(0)
        levels = 1 + int((steps > DISTINCT_VALUES_SHARE * (high[j] - low[j])).sum())
        wide = high[j] - low[j] > 1e-9 * max(abs(high[j]), abs(low[j]))
        if not wide:
            raise NotEnoughError(
                f"covariate {name} is {low[j]:.4g} in all that is learned from: record while it varies, or leave it out"
            )
        degrees.append(MAX_DEGREE if levels == 1 else min(MAX_DEGREE, levels - 1))
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    same_sign = (np.sign(theta) == np.sign(theta[0])).all(axis=0)
    proportional = same_sign & (np.abs(theta) > MIN_PROPORTIONAL_STDS * std).all(axis=0)
    n, p = theta.shape[1], sum(degrees)
    if len(theta) <= 1 + p:
        raise NotEnoughError(f"{len(theta)} stretches are too few to tell what {', '.join(names)} do: record longer")
    blank = CovariateModel(
        names=tuple(names),
        low=tuple(low.tolist()),
        high=tuple(high.tolist()),
        degrees=tuple(degrees),
        proportional=tuple(proportional.tolist()),
        slopes=((0.0,) * n,) * p,
        covariance=((0.0,) * (p * n),) * (p * n),
    )
    X = np.hstack([np.ones((len(c), 1)), blank.basis(c)])
    target = np.where(proportional, np.log(np.abs(np.where(proportional, theta, 1.0))), theta)
    scale = 1.0 / np.where(proportional, theta, 1.0)
    size = std.mean(axis=0) * np.abs(scale).mean(axis=0)  # keeps units apart
    W = np.linalg.inv(covariance * scale[:, :, None] * scale[:, None, :] / np.outer(size, size))
    normal = np.einsum("ma,mb,mij->aibj", X, X, W).reshape((1 + p) * n, (1 + p) * n)
    known = np.linalg.inv(normal)
    B = known @ np.einsum("ma,mij,mj->ai", X, W, target / size).ravel()
    left = target / size - X @ B.reshape(1 + p, n)
    dispersion = float(np.einsum("mi,mij,mj->", left, W, left)) / (len(theta) * n - B.size)
    sizes = np.tile(size, p)
    spread = max(dispersion, 1.0) * known[n:, n:] * np.outer(sizes, sizes)
    slopes = to_tuples(B.reshape(1 + p, n)[1:] * size)
    return blank.model_copy(update={"slopes": slopes, "covariance": to_tuples(spread)})


def _stretches(
    pipeline: Pipeline,
    recordings: Sequence[Recording],
    regressions: Sequence[Regression],
    fit: TuningFit,
    names: Sequence[str],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return covariates (m, k), coefficients (m, n) and their covariances (m, n, n) of all stretches."""
    length = round(STRETCH * pipeline.loop.monitor.memory * pipeline.loop.sample_rate)
    longest = max(rec.samples for rec in recordings)
    stretches = _stretches_of(length, recordings, regressions, fit, names)
    while not stretches and length < longest:  # between rests, at a low cutoff, few samples of a stretch count
        length = min(2 * length, longest)
        stretches = _stretches_of(length, recordings, regressions, fit, names)
    if not stretches:
        raise NotEnoughError(f"no stretch of {length} samples with {', '.join(names)}: record longer")
    c, theta, covariance = (np.array(column) for column in zip(*stretches, strict=True))
    return c, theta, covariance


def _stretches_of(
    length: int,
    recordings: Sequence[Recording],
    regressions: Sequence[Regression],
    fit: TuningFit,
    names: Sequence[str],
) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Return covariates (k,), coefficients (n,) and their covariance (n, n) of each stretch of `length` samples."""
    stretches = []
    for rec, g in zip(recordings, regressions, strict=True):
        columns = np.column_stack([rec.channels[name] for name in names])
        for first in range(0, max(rec.samples - length, 0) + 1, length):
            rows = slice(first, first + length)
            part = g.rows(rows)
            c = columns[rows][part.ok]
            if part.ok.sum() < MIN_SAMPLES_PER_COEFFICIENT * g.phi.shape[1] or np.isnan(c).all(axis=0).any():
                continue
            if not part.phi[part.ok].any(axis=0).all():  # a motion that never asks for a coefficient
                continue
            theta = least_squares(part)
            stretches.append((np.nanmean(c, axis=0), theta, coloured_covariance(part, fit.tuning)))
    return stretches


def at_origin(
    model: CovariateModel, theta: FloatArray, recordings: Sequence[Recording], regressions: Sequence[Regression]
) -> list[Regression]:
    """Return the regressions as if the covariates had been at the origin: eta less phi' (theta(c) - theta)."""
    referred = []
    for rec, g in zip(recordings, regressions, strict=True):
        path = CovariatePath.of(model, theta, rec.channels, 1.0)
        # the curve is not continued to confirm itself: what lies beyond its stretches counts as scatter
        shift = model.theta(theta, np.clip(path.values, model.low, model.high)) - theta
        referred.append(replace(g, eta=g.eta - np.einsum("ki,ki->k", g.phi, shift)))
    return referred


def _judge(exam: Examination) -> Iterator[Finding]:
    """Yield that covariates are outside of what was learned or too old; after an alarm, what else would explain it."""
    if exam.along is None:
        return
    rate, hold_s = exam.recording.sample_rate, exam.baseline.loop.monitor.covariate_hold_s
    unknown = exam.along.outside or exam.along.model.describe_stale(exam.recording.channels, hold_s, rate)
    if unknown is not None:
        yield Finding.throughout(exam, "undetermined", "signals", unknown)
    elif exam.alarm.any():
        yield from _doubt_values(exam, exam.along)


def _doubt_values(exam: Examination, along: CovariatePath) -> Iterator[Finding]:
    """Yield that another value of a covariate, within its range, would explain the alarm as well.

    The value as logged speaks against it: only its sensor can settle what motion cannot tell apart.
    """
    model, at = along.model, exam.explained
    logged = along.averages[exam.estimates.index[at]]
    for j, name in enumerate(model.names):
        values = np.linspace(model.low[j], model.high[j], GRID_SIZE)
        c = np.tile(logged, (len(values), 1))
        c[:, j] = values
        expected = exam.expected[at] + model.theta(along.theta, c) - model.theta(along.theta, logged)
        theta, C = (np.broadcast_to(x, (len(c), *x.shape)) for x in (exam.estimates.theta[at], exam.covariance(at)))
        T2 = t2_statistic(theta, expected, C)
        best = int(np.argmin(T2))
        if T2[best] <= exam.baseline.thresholds.statistic:
            other, said = float(values[best]), float(logged[j])
            if along.std is None:
                text = message("warning.covariate", covariate=name, other=f"{other:.3g}", logged=f"{said:.3g}")
            else:
                text = message("warning.warm_up_jump", before=f"{said:.3g}", after=f"{other:.3g}")
            yield Finding.throughout(exam, "doubt", "point", text)


COVARIATES = EvidenceKind("covariates", judge=_judge)
