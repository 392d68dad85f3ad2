"""Covariates in an exported monitor: their constants."""

from __future__ import annotations

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.export.constants import ExportConstants

__all__ = ["covariate_tables"]


def covariate_tables(made: ExportConstants) -> dict[str, FloatArray]:
    """Return the constants that a monitor with covariates has beside those of its recursion, by name."""
    if made.covariates is None:
        return {}
    model, c = made.covariates.model, made.recursion.constants[0]
    half = 0.5 * (np.array(model.high) - np.array(model.low))
    E = made.baseline.pipeline().bank.E(made.baseline.loop.monitor.frequencies)
    return {
        "known_range": np.column_stack(model.known),
        "learned": np.column_stack([model.origin, half]),
        "slopes": np.array(model.slopes),
        "slope_covariance": np.array(model.covariance),
        "to_state": np.linalg.inv(c.basis),
        "to_response": np.stack([E.real, E.imag], axis=1).reshape(-1, len(made.expected)),
        "theta_middle": np.array(made.baseline.theta),
        "theta_expected": made.expected,
        "theta_origin": c.origin,
    }
