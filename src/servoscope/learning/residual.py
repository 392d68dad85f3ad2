"""A step of learning: what the healthy coefficients leave of u, and how much of it a healthy recording may have."""

from __future__ import annotations

import numpy as np

from servoscope.baseline.feature_model import score_limit
from servoscope.baseline.residual_model import POSITIONS, SPEED_SHARES, ResidualLayout, ResidualModel
from servoscope.core.arrays import FloatArray
from servoscope.learning.features import PAST_BUDGET
from servoscope.learning.recursion import HealthyRecordings

MIN_RECORDINGS = 6  # so that five judge each: fewer do not tell a drift from scatter
TOP_SPEED_QUANTILE = 0.99  # of the speed of a recording
SHIFT_MARGIN = 2.0  # of the limit: differences of halves scatter with heavier tails than features
ACCELERATION_QUANTILES = (1.0 / 3.0, 2.0 / 3.0)  # braking, neither, accelerating


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
    ).with_means(pipeline, recordings)
    residuals = [layout.features(pipeline, rec) for rec in recordings]
    others = [residuals[:i] + residuals[i + 1 :] for i in range(len(residuals))]
    left_out = np.array(
        [ResidualModel.of(layout, rest).ratios(one) for rest, one in zip(others, residuals, strict=True)]
    )
    whole, shift = left_out[np.isfinite(left_out).all(axis=1)].T.tolist()
    if len(whole) < MIN_RECORDINGS:
        return None
    limits = score_limit(whole, share), SHIFT_MARGIN * score_limit(shift, PAST_BUDGET * share)
    return ResidualModel.of(layout, residuals).model_copy(update={"limits": limits})
