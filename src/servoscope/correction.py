"""What theta_hat means: the actuator whose expected estimate it is, and theta_hat without the biases it must have.

The map from an actuator to the estimate that the recursion is expected to give under this reference holds every bias:
the intersample behaviour of y, the noise in phi, the past that is not forgotten yet. Inverting it removes them all
(indirect inference; Gourieroux, Monfort and Renault, 1993).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from servoscope.errors import SimulationError
from servoscope.inverse import nominal_theta
from servoscope.plants import FloatArray, Plant
from servoscope.signatures import Expectation

FREE = 3.0  # standard deviation of the logarithm of a parameter that nothing tells
STEP = 1e-3  # of the logarithm of a parameter, for derivatives
HOPELESS = 1e6  # stands for the misfit of an actuator that cannot run


@dataclass(frozen=True, eq=False)
class Correction:
    """What separates theta_hat from the actuator's coefficients.

    Parameters
    ----------
    plant
        The actuator whose expected estimate is theta_hat.
    gain
        How an error of theta_hat reaches the corrected coefficients, shape (n, n).
    """

    plant: Plant
    gain: FloatArray


def explain(
    expectation: Expectation,
    healthy: Plant,
    start: FloatArray,
    theta: FloatArray,
    S: FloatArray,
    since: int,
    guess: Mapping[str, float],
) -> Correction:
    """Find the actuator that would give these estimates.

    Parameters
    ----------
    expectation
        Of the recording.
    healthy
        The healthy plant.
    start
        theta_hat before the first sample, shape (n,).
    theta
        Estimate to be explained, that of the last evaluation of `expectation`, shape (n,).
    S
        Its covariance, shape (n, n).
    since
        Sample of the onset of the change.
    guess
        Ratios from which the search starts, for example those of the likeliest fault.
    """
    names = healthy.parameters
    size = np.sqrt(np.diag(S))
    L = np.linalg.cholesky(S / np.outer(size, size) + 1e-9 * np.eye(len(size)))

    def ill(x: FloatArray) -> Plant:
        return healthy.with_ratios(dict(zip(names, np.exp(x).tolist(), strict=True)))

    def expected(x: FloatArray) -> FloatArray:
        last: FloatArray = expectation.path(start, healthy, ill(x), since)[-1]
        return last

    def misfit(x: FloatArray) -> FloatArray:
        try:
            off = np.linalg.solve(L, (theta - expected(x)) / size)
        except SimulationError:
            off = np.full(len(theta), HOPELESS)
        return np.concatenate([off, x / FREE])

    x = _search(misfit, np.log([guess.get(name, 1.0) for name in names]))
    here = expected(x)
    J, T = np.empty((len(theta), len(names))), np.empty((len(theta), len(names)))
    loop = expectation.pipeline.loop
    true = nominal_theta(loop, ill(x))
    for i, e in enumerate(np.eye(len(names))):
        moved = x + STEP * e
        J[:, i] = (expected(moved) - here) / STEP
        T[:, i] = (nominal_theta(loop, ill(moved)) - true) / STEP
    white = np.linalg.solve(L, J / size[:, None])
    fitted = np.linalg.solve(white.T @ white + np.eye(len(names)) / FREE**2, white.T @ np.linalg.inv(L) / size)
    return Correction(ill(x), np.eye(len(theta)) + (T - J) @ fitted)


def _search(misfit: Callable[[FloatArray], FloatArray], start: FloatArray) -> FloatArray:
    from scipy.optimize import least_squares as minimise

    found = minimise(misfit, start, diff_step=[STEP], max_nfev=12, x_scale=0.1)
    return np.asarray(found.x if found.cost < HOPELESS else start, dtype=np.float64)
