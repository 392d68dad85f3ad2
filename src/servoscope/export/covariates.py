"""Covariates in an exported monitor: their constants, and what its functions do with them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.core.jit.c_source import c_literal
from servoscope.estimation.kernel.sample_steps import HEADER_SIZE
from servoscope.export.constants import ExportConstants, plain_text
from servoscope.export.golden import TOLERANCE

__all__ = ["covariate_words"]

COMMENT = """/*
 * Say what the covariates are from the next sample on, in the units of the recordings; NaN is no new value of one.
 * Call it before each sample, or as often as there are new values.
 */
"""
WITHOUT = {
    "taken": "r",
    "agreement": "bit by bit",
    **dict.fromkeys(("and_exp", "covariate_field", "covariate_function", "covariate_locals", "covariate_compare"), ""),
}


def covariate_words(made: ExportConstants, name: str, words: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the templates name of a baseline's covariates, or in their place, beside other `words`."""
    if made.covariates is None:
        return WITHOUT | {"ready": f"q->updates > {words['zero']}"}
    model, upper = made.covariates.model, name.upper()
    c, n = made.recursion.constants[0], len(made.expected)
    half = 0.5 * (np.array(model.high) - np.array(model.low))
    E = made.baseline.pipeline().bank.E(made.baseline.loop.monitor.frequencies)
    tables: dict[str, npt.ArrayLike] = {
        "known_range": np.column_stack(model.known),
        "learned": np.column_stack([model.origin, half]),
        "slopes": model.slopes,
        "slope_covariance": model.covariance,
        "to_state": np.linalg.inv(c.basis),
        "to_response": np.stack([E.real, E.imag], axis=1).reshape(-1, n),
    }
    vectors: dict[str, npt.ArrayLike] = {
        "theta_middle": made.baseline.theta,
        "theta_expected": made.expected,
        "theta_origin": c.origin,
    }
    count = sum(np.size(numbers) for numbers in (*tables.values(), *vectors.values()))
    return {
        "constant_bytes": words["constant_bytes"] + 8 * count + 4 * (len(model.names) + n),
        **{key: ",\n".join(f"    {{{_list(row)}}}" for row in np.asarray(table)) for key, table in tables.items()},
        **{key: _list(vector) for key, vector in vectors.items()},
        "degrees": ", ".join(map(str, model.degrees)),
        "proportional": ", ".join(str(int(moves)) for moves in model.proportional),
        "powers": str(len(model.slopes)),
        "keep": c_literal(made.covariates.average.keep),
        "covariate_count": str(len(model.names)),
        "covariate_names": plain_text(", ".join(model.names)),
        "covariate_hold": c_literal(made.covariates.hold),
        "places": f"{words['places']}#define AT_COVARIATES {made.recursion.size - HEADER_SIZE}\n",
        "ready": f"(q->updates > 0.0) && (q->place == {upper}_KNOWN)",
        "taken": "(known != 0) ? r : (double)NAN",
        "agreement": f"T^2 within {TOLERANCE:.0e}",
        "and_exp": ", exp",
        "covariate_field": f"    {name}_place place;\n",
        "covariate_function": f"{COMMENT}void {name}_covariates({name}_state *state, "
        f"const double values[{upper}_COVARIATES]);\n\n",
        "covariate_locals": f"    double average[{upper}_COVARIATES];\n"
        "    const int known = follow_covariates(state, average);\n",
        "covariate_compare": "        compare_covariates(average, known, q);\n",
    }


def _list(numbers: npt.ArrayLike) -> str:
    return ", ".join(map(c_literal, np.asarray(numbers, dtype=np.float64).tolist()))
