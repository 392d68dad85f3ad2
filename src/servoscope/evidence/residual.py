"""A step of learning: what the healthy coefficients leave of u, and how much of it a healthy recording may have.

Of plants whose stretches are fitted, how far the coefficients of a healthy recording may be off as well.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.residual_model import (
    POSITIONS,
    SPEED_SHARES,
    ResidualLayout,
    ResidualModel,
    fit_coefficients,
    mean_t2,
)
from servoscope.baseline.threshold import score_limit
from servoscope.core.arrays import FloatArray, to_tuples
from servoscope.detection.homogeneity import prediction_factor
from servoscope.estimation.pipeline import Pipeline
from servoscope.evidence.features import PAST_BUDGET
from servoscope.evidence.kind import EvidenceKind, HealthyRecordings, Learned
from servoscope.signals import Recording

MIN_RECORDINGS = 6  # so that five judge each: fewer do not tell a drift from scatter
MAX_FOLDS = 8  # of recordings that are left out, some together where there are more
TOP_SPEED_QUANTILE = 0.99  # of the speed of a recording
SHIFT_MARGIN = 2.0  # of the limit: differences of halves scatter with heavier tails than features
ACCELERATION_QUANTILES = (1.0 / 3.0, 2.0 / 3.0)  # braking, neither, accelerating


def _learn(healthy: HealthyRecordings, draft: Baseline) -> Learned:
    """Learn the residual, unless an exact plant leaves noise alone: the tests of the coefficients know its size.

    That of an axis is scanned for changes sample by sample, and has its own scatter.
    """
    exact = draft.exact is not None and draft.exact.misfit <= 1.0
    if exact or draft.axis is not None or healthy.loop.monitor.hidden_warm_up:
        return None, ()
    return learn_residuals(healthy, np.array(draft.theta)), ()


def learn_residuals(healthy: HealthyRecordings, theta: FloatArray) -> ResidualModel | None:
    """Learn the residuals about coefficients (n,), and limits from each recording judged by the others.

    None where too few recordings have another one of their motion.
    """
    share, recordings, pipeline = healthy.loop.monitor.feature_false_alarms, healthy.recordings, healthy.pipeline
    names = tuple(healthy.loop.columns.covariates)
    if not share or len(recordings) < MIN_RECORDINGS + len(names):
        return None
    origin = float(np.mean([rec.y.mean() for rec in recordings]))
    positions = [rec.y - origin for rec in recordings]
    moved = [pipeline.kinematics.regression(y, y, y, rec.restart) for y, rec in zip(positions, recordings, strict=True)]
    phi = [g.phi[g.ok] for g in moved]
    if not all(map(len, phi)):
        return None
    top = max(float(np.quantile(np.abs(x[:, 1]), TOP_SPEED_QUANTILE)) for x in phi)
    speeds = top * np.array(SPEED_SHARES)
    y, _, a = np.concatenate(phi).T
    layout = ResidualLayout(
        theta=tuple(theta.tolist()),
        origin=origin,
        speeds=(*-speeds[::-1], *speeds),
        positions=tuple(np.linspace(y.min(), y.max(), POSITIONS + 1)[1:-1].tolist()),
        accelerations=tuple(np.quantile(a, ACCELERATION_QUANTILES).tolist()),
        covariates=names,
    )
    left_out = _left_out_ratios(layout, healthy)
    whole, shift = left_out[np.isfinite(left_out).all(axis=1)].T.tolist()
    if len(whole) < MIN_RECORDINGS:
        return None
    limits = score_limit(whole, share), SHIFT_MARGIN * score_limit(shift, PAST_BUDGET * share)
    fits = _learn_fits(healthy, theta, share) if healthy.loop.plant.fits_stretches else {}
    return _learn_model(layout, pipeline, recordings).model_copy(update={"limits": limits, **fits})


def _learn_fits(healthy: HealthyRecordings, theta: FloatArray, share: float) -> dict[str, object]:
    """Return how fits to halves of recordings scatter about theta (n,), and a limit from each recording left out."""
    regressions, m = healthy.regressions, len(healthy.regressions)
    rms = np.sqrt(np.mean([(g.phi[g.ok] ** 2).mean(axis=0) for g in regressions], axis=0))
    halves = np.array([[fit_coefficients(half, rms) for half in g.halves] for g in regressions]) - theta
    fits = {"halves": to_tuples(further_covariance(halves, m)), "rms": tuple(rms.tolist())}
    if healthy.covariates is not None:  # how they move coefficients is fitted to the same few recordings
        return fits
    # theta without a recording is off by as much more from it
    whole = (np.array([fit_coefficients(g, rms) for g in regressions]) - theta) * m / (m - 1.0)
    others = (further_covariance(np.delete(halves, i, axis=0), m - 1) for i in range(m))
    scores = [mean_t2(deviation, C) for deviation, C in zip(whole, others, strict=True)]
    return {**fits, "fit_limit": score_limit(scores, share)}


def further_covariance(left: FloatArray, recordings: int) -> FloatArray:
    """Return the covariance (n, n) of a further fit from what fits of so many recordings are off by, shape (..., n).

    Of few fits, correlations count the less, as if as many fits without any as there are coefficients had been seen.
    NaN: not known of that fit; a coefficient of which no fit knows is taken to be sure within 1.
    """
    left = left.reshape(-1, left.shape[-1])
    known = np.isfinite(left)
    left, n = np.where(known, left, 0.0), left.shape[1]
    counts = 1.0 * known.T @ known
    size = np.sqrt((left**2).sum(axis=0) / counts.diagonal().clip(1.0))
    size[~known.any(axis=0)] = 1.0
    correlations = (left.T @ left / np.outer(size, size) + n * np.eye(n)) / (counts + n)
    return np.asarray(prediction_factor(recordings) * correlations * np.outer(size, size))


def _learn_model(layout: ResidualLayout, pipeline: Pipeline, recordings: Sequence[Recording]) -> ResidualModel:
    layout = layout.with_means(pipeline, recordings)
    return ResidualModel.of(layout, [layout.features(pipeline, recording) for recording in recordings])


def _left_out_ratios(layout: ResidualLayout, healthy: HealthyRecordings) -> FloatArray:
    """Return the ratios of each recording, shape (n, 2), by means and scatter of recordings that do not hold it."""
    recordings, pipeline = healthy.recordings, healthy.pipeline
    models = [
        _learn_model(layout, pipeline, [rec for i, rec in enumerate(recordings) if i % MAX_FOLDS != k])
        for k in range(min(MAX_FOLDS, len(recordings)))
    ]
    return np.array([models[i % MAX_FOLDS].ratios_of(pipeline, rec) for i, rec in enumerate(recordings)])


RESIDUAL = EvidenceKind("residual", _learn)
