"""A step of learning: what the healthy coefficients leave of u, and how much of it a healthy recording may have.

Of plants whose stretches are fitted, how far the coefficients of a healthy recording may be off as well.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.records import Matrix
from servoscope.baseline.residual_model import (
    POSITIONS,
    SPEED_SHARES,
    MotionFits,
    ResidualLayout,
    ResidualModel,
    fit_coefficients,
    mean_t2,
    rms_motion,
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
MOTION_MARGIN = 1.5  # of the limit of fits that are compared by motion: gains that nobody learned change them, too
SHIFT_MARGIN = 2.0  # of the limit: differences of halves scatter with heavier tails than features
ACCELERATION_QUANTILES = (1.0 / 3.0, 2.0 / 3.0)  # braking, neither, accelerating


def _learn(healthy: HealthyRecordings, draft: Baseline) -> Learned:
    """Learn the residual, unless an exact plant leaves noise alone: the tests of the coefficients know its size.

    Of an axis only fits to whole recordings are compared, by their motion: changes within them are scanned for.
    """
    exact, is_axis = draft.exact is not None and draft.exact.misfit <= 1.0, draft.axis is not None
    if exact or healthy.loop.monitor.hidden_warm_up or (is_axis and healthy.covariates is not None):
        return None, ()
    return learn_residuals(healthy, np.array(draft.theta), by_motion=is_axis), ()


def learn_residuals(healthy: HealthyRecordings, theta: FloatArray, *, by_motion: bool = False) -> ResidualModel | None:
    """Learn the residuals about coefficients (n,), and limits from each recording judged by the others.

    `by_motion`: whether what no term explains repeats with the motion, so that fits are compared with those of like it.
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
    fitted = by_motion or healthy.loop.plant.fits_stretches
    fits = _learn_fits(healthy, theta, origin, share, by_motion) if fitted else {}
    return _learn_model(layout, pipeline, recordings).model_copy(update={"limits": limits, **fits})


def _learn_fits(
    healthy: HealthyRecordings, theta: FloatArray, origin: float, share: float, by_motion: bool
) -> dict[str, object]:
    """Return how fits to halves of recordings scatter about theta (n,), and a limit from each recording left out."""
    regressions, m = healthy.regressions, len(healthy.regressions)
    rms = np.sqrt(np.mean([(g.phi[g.ok] ** 2).mean(axis=0) for g in regressions], axis=0))
    fits = np.array([[fit_coefficients(part, rms) for part in (g, *g.halves)] for g in regressions])
    left, known = fits - theta, {"rms": tuple(rms.tolist())}
    if healthy.covariates is not None:  # how they move coefficients is fitted to the same few recordings
        return {**known, "halves": to_tuples(further_covariance(left[:, 1:], m))}
    left[:, 0] *= m / (m - 1.0)  # theta without a recording is off by as much more from it
    like = None
    if by_motion:
        parts = [(rec, *(rec.rows(rows) for rows in _halves(rec.samples))) for rec in healthy.recordings]
        motions = np.array([[rms_motion(healthy.pipeline, part, origin) for part in rec] for rec in parts])
        common = np.where(np.isfinite(left[:, 0]), fits[:, 0] - left[:, 0], theta)
        known_fits = np.where(np.isfinite(fits), fits, theta)
        left = fits - _expected_by_others(known_fits, motions, common)
        # recordings of one load do not show that terms are off: under another one by as much as they leave of u
        unexplained = np.mean([1.0 - np.corrcoef(g.eta[g.ok], g.phi[g.ok] @ theta)[0, 1] ** 2 for g in regressions])
        whole = further_covariance(left[:, :1], m) + np.diag(unexplained * theta**2)
        like = _motion_fits(known_fits[:, 0], motions[:, 0], to_tuples(whole))
    halves = further_covariance(left[:, 1:], m)
    margin = MOTION_MARGIN if like is not None else 1.0
    scores = [mean_t2(left[i, 0], further_covariance(np.delete(left[:, 1:], i, axis=0), m - 1)) for i in range(m)]
    return {**known, "halves": to_tuples(halves), "like": like, "fit_limit": margin * score_limit(scores, share)}


def _expected_by_others(fits: FloatArray, motions: FloatArray, common: FloatArray) -> FloatArray:
    """Return what the motion of m recordings and of their halves lets the others expect, (m, 3, n), as the fits are.

    `motions` (m, 3, 3); `common` (m, n): coefficients of all recordings but each.
    """
    expected, m = np.empty_like(fits), len(fits)
    for i in range(m):
        others = [k for k in range(m) if k != i]
        for own in ([0], [1, 2]):  # wholes by wholes, halves by halves
            like = _motion_fits(fits[np.ix_(others, own)], motions[np.ix_(others, own)])
            expected[i, own] = [like.expected(motion, common[i]) for motion in motions[i, own]]
    return expected


def _halves(samples: int) -> tuple[slice, slice]:
    return slice(samples // 2), slice(samples // 2, None)


def _motion_fits(fits: FloatArray, motions: FloatArray, covariance: Matrix = ()) -> MotionFits:
    """Return fits (..., n) at motions (..., 3)."""
    rows = to_tuples(fits.reshape(-1, fits.shape[-1])), to_tuples(motions.reshape(-1, motions.shape[-1]))
    return MotionFits(fits=rows[0], motions=rows[1], covariance=covariance)


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
