"""A step of learning: what the healthy coefficients leave of u, and how much of it a healthy recording may have."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.residual_model import POSITIONS, SPEED_SHARES, ResidualLayout, ResidualModel
from servoscope.baseline.threshold import score_limit
from servoscope.core.arrays import FloatArray
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
    return _learn_model(layout, pipeline, recordings).model_copy(update={"limits": limits})


def _learn_model(layout: ResidualLayout, pipeline: Pipeline, recordings: Sequence[Recording]) -> ResidualModel:
    layout = layout.with_means(pipeline, recordings)
    return ResidualModel.of(layout, [layout.features(pipeline, recording) for recording in recordings])


def _left_out_ratios(layout: ResidualLayout, healthy: HealthyRecordings) -> FloatArray:
    """Return the ratios of each recording, shape (n, 2), by means and scatter of recordings that do not hold it."""
    recordings, pipeline = healthy.recordings, healthy.pipeline
    fold = np.arange(len(recordings)) % MAX_FOLDS
    ratios = np.empty((len(recordings), 2))
    for k in range(min(MAX_FOLDS, len(recordings))):
        model = _learn_model(layout, pipeline, [rec for rec, own in zip(recordings, fold, strict=True) if own != k])
        for i in np.flatnonzero(fold == k).tolist():
            ratios[i] = model.ratios_of(pipeline, recordings[i])
    return ratios


RESIDUAL = EvidenceKind("residual", _learn)
