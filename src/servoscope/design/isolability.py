"""How far apart two explanations are, exactly: what another fault at its best leaves of a true one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import SimulationError
from servoscope.design.fisher_information import (
    MISNAMED,
    equivalent_distance,
    fisher_matrix,
    linear_isolability_radius,
    misnaming_probability,
)
from servoscope.design.scenario import Scenario
from servoscope.fit.search import fit
from servoscope.isolation.ml.hypothesis import change_experiment, log_ratio_bounds
from servoscope.isolation.ml.least_squares import solve_least_squares
from servoscope.isolation.ml.window import RefitWindow
from servoscope.models.plants import Fault

# squared distance from which hypotheses are never taken for each other, and not fitted any closer
MAX_SQUARED_DISTANCE = 200.0
STEPS = 8  # of Gauss and Newton
CONVERGED = 1e-3  # of a squared distance
GRID = 12  # sizes between the radius that linear distances promise and the end of the range
FINE = 0.01  # relative precision of a radius
SUSPICIOUS = 1.0  # logarithm of a distance relative to what is needed, below which a dip is looked into
LOOKS = 6  # into a dip
UNLIMITED_DISTANCE = 10.0  # stands for a distance beyond all need


@dataclass(frozen=True, eq=False)
class HypothesisDistances:
    """How far the other hypotheses are from a fault of one size."""

    others: tuple[Fault, ...]  # the other faults, q of them
    squared: FloatArray  # squared distances, shape (q,)
    sizes: FloatArray  # logarithms of the ratios at which each is closest, shape (q,)

    @property
    def nearest(self) -> str:
        """Name of the closest other fault; empty where there is none."""
        return self.others[int(np.argmin(self.squared))].name if self.others else ""


def hypothesis_distances(scene: Scenario, fault: Fault, x: float) -> HypothesisDistances:
    """Measure how far all other single faults are from a fault whose logarithm of the ratio is x.

    D^2 is the smallest sum of squares by which the innovations of another hypothesis differ from those of the truth,
    its size and the healthy parameters free. The difference is known a sample ahead, so with the noise of the sample
    the log-likelihood ratio is Gaussian with mean D^2/2 and variance D^2.
    """
    window = scene.window({fault.parameter: float(np.exp(x))})
    own = window.residual(np.append(np.zeros(window.nuisance_count), x), (fault.parameter,), scene.profile)
    others = tuple(other for other in scene.loop.plant.faults if other.parameter != fault.parameter)
    F, i = fisher_matrix(scene), scene.names.index(fault.parameter)
    closest = []
    for other in others:
        j = scene.names.index(other.parameter)
        guess = x * float(F[i, j] / max(F[j, j], 1e-300))
        closest.append(_closest_hypothesis(scene, window, other, own, guess))
    sizes, squared = np.array(closest).reshape(-1, 2).T
    return HypothesisDistances(others, squared, sizes)


Span = tuple[float, float]


def ambiguous_sizes(scene: Scenario, fault: Fault, up: bool) -> tuple[Span, ...]:
    """Return at which sizes another single fault is more likely with a probability above `MISNAMED`.

    The spans of logarithms (positive) are in rising order. The first begins at 0; the last ends at infinity if the end
    of the range is among them. Those beyond the first are sizes at which the fault looks like another once more: a
    resonance above half the sample rate comes back, for example. Sizes with which the loop is unstable do not count:
    nobody could have recorded them.
    """
    (low,), (high,) = log_ratio_bounds([fault])
    sign, end = (1.0, float(high)) if up else (-1.0, float(-low))
    if len(scene.names) == 1:
        return ()
    known: dict[float, HypothesisDistances | None] = {}

    def at(log_x: float) -> HypothesisDistances | None:
        if log_x not in known:
            try:
                known[log_x] = hypothesis_distances(scene, fault, sign * float(np.exp(log_x)))
            except SimulationError:
                known[log_x] = None
        return known[log_x]

    def excess(log_x: float) -> float:
        """Return the logarithm of the distance relative to what is needed."""
        distances = at(log_x)
        if distances is None:
            return UNLIMITED_DISTANCE
        distance = equivalent_distance(misnaming_probability(distances.squared))
        return float(np.log(max(distance, 1e-6) / equivalent_distance(MISNAMED)))

    promised = min(
        linear_isolability_radius(fisher_matrix(scene, exact=False), scene.names.index(fault.parameter)), 0.9 * end
    )
    points = [(x, excess(x)) for x in np.log(np.geomspace(0.9 * promised, end, GRID)).tolist()]
    _refine_minima(excess, points)
    return _negative_spans(excess, sorted(known))


def _negative_spans(excess: Callable[[float], float], log_sizes: list[float]) -> tuple[Span, ...]:
    """Return where an excess is negative, as spans of sizes, from a function of rising logarithms of sizes."""
    from scipy.optimize import brentq

    points = [(x, excess(x)) for x in log_sizes]
    for _ in range(GRID):
        if points[0][1] > 0.0:
            points.insert(0, (points[0][0] - 0.3, excess(points[0][0] - 0.3)))
    spans, begin = [], 0.0
    if points[0][1] > 0.0:
        return ()
    for (x, here), (following, there) in pairwise(points):
        if here * there > 0.0:
            continue
        root = float(np.exp(brentq(excess, x, following, xtol=FINE, rtol=FINE)))
        if here < 0.0:
            spans.append((begin, root))
        else:
            begin = root
    if points[-1][1] < 0.0:
        spans.append((begin, float(np.inf)))
    return tuple(spans)


def _refine_minima(excess: Callable[[float], float], points: list[tuple[float, float]]) -> None:
    """Evaluate an excess between points where it may become negative."""
    from scipy.optimize import minimize_scalar

    for (low, left), (_, middle), (high, right) in zip(points, points[1:], points[2:], strict=False):
        if 0.0 < middle <= min(left, right) and middle < SUSPICIOUS:
            minimize_scalar(excess, bounds=(low, high), method="bounded", options={"maxiter": LOOKS})


def _closest_hypothesis(
    scene: Scenario, window: RefitWindow, other: Fault, own: FloatArray, guess: float
) -> tuple[float, float]:
    """Return the size at which another fault comes closest to the truth, and how far from it, squared.

    `own` (N + m,) are the innovations of the truth. First with the healthy parameters held, by search; then with all
    free.
    """
    m, grid = window.nuisance_count, scene.size_grids[other.parameter]
    (low,), (high,) = log_ratio_bounds([other])

    def off(x: float) -> float:
        e = window.innovations(grid[x], scene.profile) - own[: window.samples]
        return float(e @ e)

    starts = [np.append(np.zeros(m), x) for x in (min(grid, key=off), float(np.clip(guess, low, high)))]
    z = min(starts, key=lambda z: float(((window.residual(z, (other.parameter,), scene.profile) - own) ** 2).sum()))
    z, left = minimise_distance(scene, window, [other], own, z, held=True)
    if m:
        z, left = minimise_distance(scene, window, [other], own, z, held=False)
    return float(z[m]), float(left @ left)


def minimise_distance(
    scene: Scenario, window: RefitWindow, faults: Sequence[Fault], own: FloatArray, z: FloatArray, held: bool
) -> tuple[FloatArray, FloatArray]:
    """Go down from z = [d, x] to where some faults are closest to the truth, by Gauss and Newton.

    `own` (N + m,) are the innovations and the prior of the truth; with `held`, d stays as it is, and else there is no
    search where a linear step leaves more than `MAX_SQUARED_DISTANCE`. Returns the closest point and what differs
    there, (N + m,).
    """
    experiment, m = change_experiment(window, faults, scene.profile, own), window.nuisance_count
    if not held:
        at = experiment.at(z)
        step, distance = solve_least_squares(at.jacobian, at.residual)
        if distance > MAX_SQUARED_DISTANCE:
            return z, at.residual + at.jacobian @ step
    closest = fit(experiment, z, np.arange(m if held else 0, len(z)), STEPS, CONVERGED)
    return closest.x, closest.residual
