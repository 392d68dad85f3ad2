"""One picture that shows a change: u for the same motion before and after, or the coefficient that moved most."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.figure import Figure

from servoscope.detection.trace import Trace
from servoscope.diagnosis.motion_signature import MotionSignature
from servoscope.diagnosis.result import Diagnosis
from servoscope.report.diagnosis_figures import plot_coefficients, plot_signature

MIN_DISTANCE_STDS = 3.0  # standard deviations between two friction bands that are seen to be apart


def plot_change(
    trace: Trace,
    diagnosis: Diagnosis,
    before: MotionSignature | None,
    after: MotionSignature | None,
    *,
    units: tuple[str, str] = ("", ""),
    coefficient_units: tuple[str, ...] = (),
) -> Figure:
    """Draw what changed of a diagnosis with a fault; parameters are those of `plot_signature` and `plot_coefficients`.

    Over position and speed where the friction band differs there, else the coefficient over time.
    """
    if shows_change(before, after) and after is not None:
        return plot_signature(before, after, units=units)
    return plot_coefficients(trace, diagnosis, units=coefficient_units, only=most_changed(trace))


def shows_change(before: MotionSignature | None, after: MotionSignature | None) -> bool:
    """Return whether the friction bands before and after are certainly apart."""
    if before is None or after is None:
        return False
    (old, old_std), (new, new_std) = before.friction_band, after.friction_band
    return abs(new - old) > MIN_DISTANCE_STDS * math.hypot(old_std, new_std)


def most_changed(trace: Trace) -> int:
    """Return which coefficient is farthest from healthy at the end, in standard deviations of the estimate."""
    std = np.sqrt(np.maximum(np.diagonal(trace.covariance, axis1=1, axis2=2), 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.nan_to_num(np.abs(trace.theta - trace.expected) / std, posinf=0.0)
    usable = np.flatnonzero(trace.ready & np.isfinite(trace.theta).all(axis=1))
    return int(np.argmax(distance[usable[-1]])) if usable.size else 0
