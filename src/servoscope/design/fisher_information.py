"""Fisher information: how surely each change could be sized, and how alike any two look."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.design.scenario import Scenario
from servoscope.isolation.ml.least_squares import normalise_columns

MISNAMED = 0.005  # probability of a wrong name at the isolability radius; as much is left for pairs and "unknown"


def fisher_matrix(scene: Scenario, seconds: float | None = None, exact: bool = True) -> FloatArray:
    """Return the Fisher information about the logarithms of the k ratios, shape (k, k).

    From the innovations of the exact sampled plant (Ljung, 1999, section 7.4); information in the noise's colour is
    left out.

    `seconds`: after the onset that count; None: all; `exact`: whether the healthy parameters are known exactly, or
    as the baseline and the healthy seconds before the onset know them.
    """
    m, end = scene.healthy.nuisance_count, scene.healthy.samples
    if seconds is not None:
        end = min(end, scene.lead_samples + round(seconds * scene.loop.sample_rate))
    J = np.delete(scene.jacobian, slice(end, scene.healthy.samples), axis=0)
    H = J.T @ J
    if exact or not m:
        return np.asarray(H[m:, m:])
    return np.asarray(H[m:, m:] - H[m:, :m] @ np.linalg.solve(H[:m, :m], H[:m, m:]))


def cosines(columns: FloatArray, others: FloatArray) -> FloatArray:
    """Return the cosines between columns (N, p) and others (N, q), shape (p, q)."""
    first, other = (normalise_columns(x)[0] for x in (columns, others))
    return np.asarray(first.T @ other)


def misnaming_probability(squared: FloatArray) -> float:
    """Return the probability that one of some hypotheses wins against the truth, given squared distances (q,).

    The log-likelihood ratio of two hypotheses D standard deviations apart is Gaussian with mean D^2/2 and variance
    D^2 (Kay, 1998, section 4.3), so each wins with Q(D/2); their sum bounds the whole.
    """
    from scipy import special

    return float(special.ndtr(-0.5 * np.sqrt(np.maximum(squared, 0.0))).sum())


def equivalent_distance(probability: float) -> float:
    """Return at which distance a single other hypothesis wins with a probability."""
    from scipy import special

    return max(float(-2.0 * special.ndtri(max(probability, 1e-300))), 0.0)


def linear_isolability_radius(F: FloatArray, i: int) -> float:
    """Return the isolability radius of fault i that an information (k, k) allows, as a logarithm; may be infinite.

    The same rule as for `servoscope.design.isolability.isolable`, but with distances as they are for small changes:
    D_ij = x sqrt(F_ii (1 - rho_ij^2)).
    """
    others = np.arange(len(F)) != i
    if not F[i, i] > 0.0:
        return np.inf
    with np.errstate(invalid="ignore", divide="ignore"):
        shared = np.where(np.diag(F) > 0.0, F[i] ** 2 / np.diag(F), 0.0)
    per_unit = np.maximum(F[i, i] - shared, 0.0)[others]
    return bisect_threshold(lambda x: misnaming_probability(x**2 * per_unit) <= MISNAMED, 1e-9, 1e3)


def bisect_threshold(holds: Callable[[float], bool], low: float, high: float) -> float:
    """Return from where on a condition holds, by bisection on a logarithmic scale; infinity if not even at `high`."""
    if not holds(high):
        return np.inf
    for _ in range(50):
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high
