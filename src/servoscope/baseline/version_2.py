"""Baselines of version 2, whose fields were not grouped: where each of them is now."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

FLAT_VERSION = 2

# record -> its field -> the name that it had
GROUPS: dict[str, dict[str, str]] = {
    "recursion": {
        name: name
        for name in (
            *("scale", "P_d", "R", "noise_a", "noise_b", "noise_gamma", "noise_variance"),
            *("stage_one", "instrument", "still_speed"),
        )
    },
    "healthy": {
        "noise": "noise",
        "loudest": "loudest",
        "ratios": "ratios",
        "std": "ratios_std",
        "covariance": "ratios_covariance",
        "theta": "model_theta",
    },
    "scatter": {"between": "scatter", "left_out": "left_out"},
    "thresholds": {"dof": "dof", "statistic": "limit", "calibration": "rehearsed", "hypotheses": "members"},
    "detectability": {
        "explained": "explained",
        "suggested_model_error": "suggested_model_error",
        "supported_false_alarms_per_year": "supported_false_alarms_per_year",
        "changes": "promises",
    },
}


def group_flat_fields(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a baseline of version 2 as they are grouped now, those of other operating points too."""
    grouped = {
        record: {field: flat[old] for field, old in fields.items() if old in flat} for record, fields in GROUPS.items()
    }
    between = grouped["scatter"].get("between", ())
    if any(isinstance(value, float) for value in between):  # the first files had its diagonal
        grouped["scatter"]["between"] = np.diag(between).tolist()
    moved = {old for fields in GROUPS.values() for old in fields.values()}
    kept = {name: value for name, value in flat.items() if name not in moved}
    if isinstance(flat.get("others"), list):
        kept["others"] = [group_flat_fields(other) if isinstance(other, Mapping) else other for other in flat["others"]]
    return kept | grouped
