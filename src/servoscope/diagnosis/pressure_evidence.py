"""What logged pressures say of a change: since when, and the curves of its possible causes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servoscope.baseline.pressure_model import EQUATIONS, EXPONENTS, NAMES, PIECE_S, PressureEvidence
from servoscope.core.arrays import FloatArray
from servoscope.detection.onset import Onset
from servoscope.isolation.signature import Signature
from servoscope.isolation.signatures import power_signatures
from servoscope.models.plants import Plant
from servoscope.signals import Recording

ONSET_PIECES = 3  # either way, by which an onset may be off
# by which a fault leaves its curve, in standard deviations of the coefficients [rad], in its own equation and in the
# others: valves are not as symmetric, and forces not as simple, as the equations
ANGLES = {"gain_forward": (0.3, 0.1), "gain_backward": (0.3, 0.1), "load": (0.3, 0.1), "process": (0.35, 0.2)}
ANGLE = 0.05, 0.05  # of all others: the filters pass on a little of one column's change to others


def pressure_onset(pressures: PressureEvidence, recording: Recording) -> Onset:
    """Return since when the pressures differ from healthy ones."""
    begin = pressures.model.onset(pressures.sums)
    last, piece = recording.samples - 1, round(PIECE_S * recording.sample_rate)
    margin = ONSET_PIECES if begin else 0
    low, sample, high = (min(max(k, 0) * piece, last) for k in (begin - margin, begin, begin + margin))
    t = recording.t
    return Onset(float(t[low]), float(t[sample]), float(t[high]), sample)


def pressure_inputs(
    pressures: PressureEvidence, plant: Plant, begin: int
) -> tuple[list[Signature], FloatArray, FloatArray]:
    """Return what isolation compares of the pieces from `begin` on: signatures, deviation (n,), covariance (n, n)."""
    model = pressures.model
    stretch = tuple(S[begin:].sum(axis=0) for S in pressures.sums)
    theta = np.array(model.theta)
    deviation = model.layout.coefficients(stretch) - theta
    known = np.flatnonzero(np.isfinite(deviation))
    names = [NAMES[k] for k in known]
    covariance = model.stretch_covariance(float(stretch[-1][0, 0]))[np.ix_(known, known)]
    signatures = power_signatures(plant, EXPONENTS, names, theta[known], np.eye(len(known)))
    certainty = dict(zip(NAMES, (theta / model.std).tolist(), strict=True))
    placed = []
    for signature in signatures:
        moved, (own, others) = EXPONENTS[parameter := signature.fault.parameter], ANGLES.get(parameter, ANGLE)
        equation = next(names for names in EQUATIONS if not moved.keys().isdisjoint(names))
        angle = np.array([own if name in equation else others for name in names])
        healthy_std = 1.0 / float(np.linalg.norm([certainty[name] for name in moved]))
        placed.append(replace(signature, angle=angle, healthy_std=healthy_std))
    return placed, deviation[known], covariance
