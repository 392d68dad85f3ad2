"""A step of learning: what logged pressures say of a healthy cylinder, and how much that scatters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoscope.baseline.pressure_model import PressureLayout, PressureModel, Sums, halves
from servoscope.baseline.threshold import score_limit
from servoscope.core.arrays import to_tuples
from servoscope.detection.homogeneity import prediction_factor
from servoscope.evidence.kind import HealthyRecordings
from servoscope.evidence.residual import MIN_RECORDINGS, SHIFT_MARGIN, further_covariance
from servoscope.models.plants.cylinder import CHANNELS, CylinderPlant


def learn_pressures(healthy: HealthyRecordings) -> PressureModel | None:
    """Learn the pressures of a cylinder whose loop file names them, and limits from each recording left out.

    None where too few recordings have them.
    """
    loop, recordings, plant = healthy.loop, healthy.recordings, healthy.loop.plant
    share = loop.monitor.feature_false_alarms
    if not isinstance(plant, CylinderPlant) or not plant.channels or not share or len(recordings) < MIN_RECORDINGS:
        return None
    if not all(np.isfinite(rec.channels.get(name, np.nan)).all() for rec in recordings for name in CHANNELS):
        return None
    speeds = [np.gradient(rec.y) * rec.sample_rate for rec in recordings]
    layout = PressureLayout(
        cutoff=loop.cutoff,
        delay=loop.delay,
        supply=float(np.mean([rec.channels["p_S"].mean() for rec in recordings])),
        speed=float(np.sqrt(np.mean([np.mean(v**2) for v in speeds]))),
        contact=plant.contact,
    )
    layout = layout.with_columns_of(recordings)
    sums = [layout.sums(rec) for rec in recordings]
    scores = np.array([_model(layout, [*sums[:i], *sums[i + 1 :]]).ratios(sums[i]) for i in range(len(sums))])
    whole, shift = (score_limit(column, share) for column in scores.T.tolist())
    return _model(layout, sums).model_copy(update={"limits": (whole, SHIFT_MARGIN * shift)})


def _model(layout: PressureLayout, sums: Sequence[Sums]) -> PressureModel:
    parts = np.array([[layout.coefficients(half) for half in halves(blocks)] for blocks in sums])
    known = ~np.isnan(parts)
    never = ~known.any(axis=(0, 1))  # no recording asks for it, and none will be judged by it
    theta = np.where(known, parts, 0.0).sum(axis=(0, 1)) / np.maximum(known.sum(axis=(0, 1)), 1)
    both = known.all(axis=1)
    moved = np.where(both, parts[:, 1] - parts[:, 0], 1.0 * never)
    shifts = np.sqrt(prediction_factor(len(sums)) * (moved**2).sum(axis=0) / np.maximum(both.sum(axis=0), 1))
    return PressureModel(
        layout=layout,
        theta=tuple(theta.tolist()),
        halves=to_tuples(further_covariance(parts - theta, len(sums))),
        shifts=tuple(shifts.tolist()),
        rows=float(np.mean([blocks[-1][:, 0, 0].sum() for blocks in sums])),
    )
