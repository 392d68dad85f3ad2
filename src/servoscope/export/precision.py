"""What single precision does to an exported monitor, measured on its golden samples."""

from __future__ import annotations

import math

import numpy as np

from servoscope.core.errors import BaselineError
from servoscope.export.constants import ExportConstants
from servoscope.export.golden import GoldenRun

__all__ = ["describe_rounding"]

MAX_FACTOR = 1.1  # in the rate of false alarms


def describe_rounding(made: ExportConstants, only_coefficients: bool, golden: GoldenRun) -> str:
    """Return what single precision does to the golden samples; raise BaselineError where that eats the promise.

    T^2 and the sequential test are log-likelihoods: an error of d multiplies the rate of false alarms by exp(d/2), or
    by exp(d h) where d is in units of a CUSUM's limit h.
    """
    double = ExportConstants.from_baseline(made.baseline, only_coefficients)
    exact = GoldenRun.from_baseline(double)
    limit = made.baseline.thresholds.statistic
    near = exact.rows[:, 1] < 2.0 * limit  # far above it, nothing hangs on an error
    watch = double.recursion.constants[0].watch
    h = 0.0 if watch is None else float(watch.limits.max())
    errors = np.abs(golden.rows.astype(np.float64) - exact.rows)[near][:, 1:3].max(axis=0, initial=0.0)
    factor = math.exp(max(0.5 * errors[0], h * errors[1]))
    if not factor <= MAX_FACTOR:
        raise BaselineError(
            f"{made.baseline.loop.name}: in single precision T^2 is off by up to {errors[0]:.2g} on golden samples, "
            f"and the rate of false alarms by a factor of {factor:.2g}: export double precision"
        )
    return (
        f"\n * Numbers are of single precision. On the golden samples that moves T^2 by no more than {errors[0]:.2g}"
        f" near its limit\n * {limit:.4g}, and the level of the sequential test by no more than"
        f" {errors[1]:.2g}: a factor of {factor:.4g} in the rate of false alarms.\n *"
    )
