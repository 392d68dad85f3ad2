"""One search for whatever is estimated: maximum a posteriori, by Levenberg and Marquardt.

What is made small is -2 log posterior: ``e'e + sum (x/std)^2`` where e is in standard deviations, and ``N log(e'e) +
sum (x/std)^2`` where the level of the noise is not known and is concentrated out (Ljung, 1999, section 7.4).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from servoscope.core.arrays import FloatArray, IndexArray
from servoscope.core.errors import SimulationError

MAX_STEPS = 60  # of a search
MAX_STEP = 0.5  # of one unknown in a step: a logarithm, a sample of delay
COST_TOLERANCE = 1e-4  # of -2 log posterior
DIFFERENCE = 1e-5  # of an unknown, for derivatives
FIRST_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-3, 1e-9, 1e6
DAMPING_FACTOR = 10.0
CANNOT_RUN = (ValueError, np.linalg.LinAlgError, SimulationError)
MIN_INFORMATION = 1e-300
LIKELIHOOD_DROP = 1.5  # by which the log-likelihood may fall at the upper bound of an unknown
MAX_REFINEMENTS = 500  # steps between two points of a grid


@dataclass(frozen=True, eq=False)
class Experiment:
    """What was measured, as a function of m unknowns; all searches begin with one."""

    residual: Callable[[FloatArray], FloatArray]  # innovations, (m,) -> (N,)
    prior: FloatArray  # standard deviations of the unknowns around 0, (m,); infinite where nothing is known
    level_known: bool = True  # whether the innovations are in standard deviations
    low: float | FloatArray = -np.inf  # low, high: bounds of the unknowns
    high: float | FloatArray = np.inf
    difference: float | FloatArray = DIFFERENCE
    max_step: float | FloatArray = MAX_STEP
    # derivatives of the residual by the free unknowns, (m,) and (k,) -> (N, k); by differences if None
    derivatives: Callable[[FloatArray, IndexArray], FloatArray] | None = None

    def at(self, x: FloatArray, free: IndexArray | None = None) -> Fit:
        """Return what some unknowns explain; the cost of a plant that cannot run is infinite.

        `free`: those that are searched, all if None.
        """
        e = np.zeros(0)
        with np.errstate(over="ignore", invalid="ignore"):  # a step too far gives numbers that cost too much
            if np.isfinite(x).all():  # LAPACK would say so on the terminal
                try:
                    e = self.residual(x)
                except CANNOT_RUN:
                    e = np.zeros(0)
            squares = float(e @ e) if len(e) else np.inf
        free = np.arange(len(x)) if free is None else free
        if not np.isfinite(squares) or not (squares > 0.0 or self.level_known):
            return Fit(self, x, free, e, np.inf)
        likelihood = squares if self.level_known else len(e) * math.log(squares)
        return Fit(self, x, free, e, likelihood + float(((x / self.prior) ** 2).sum()))


@dataclass(frozen=True, eq=False)
class Fit:
    """Unknowns, and what they explain."""

    experiment: Experiment
    x: FloatArray  # shape (m,)
    free: IndexArray  # unknowns that were searched, shape (k,)
    residual: FloatArray  # shape (N,)
    cost: float  # -2 log posterior, but for a constant

    @property
    def weight(self) -> float:
        """One over the variance of the innovations."""
        return 1.0 if self.experiment.level_known else len(self.residual) / float(self.residual @ self.residual)

    @cached_property
    def jacobian(self) -> FloatArray:
        """Derivatives of the residual by the unknowns that are free, shape (N, k)."""
        experiment, m = self.experiment, len(self.x)
        if experiment.derivatives is not None:
            return experiment.derivatives(self.x, self.free)
        steps = np.broadcast_to(experiment.difference, m)
        steps = np.where(self.x + steps > experiment.high, -steps, steps)
        columns = [
            (experiment.residual(self.x + steps[i] * np.eye(m)[i]) - self.residual) / steps[i] for i in self.free
        ]
        return np.array(columns).T.reshape(len(self.residual), len(self.free))

    @cached_property
    def prior_information(self) -> FloatArray:
        """Inverse covariance of the free unknowns before anything was measured, shape (k, k)."""
        return np.diag(self.experiment.prior[self.free] ** -2.0)

    @cached_property
    def information(self) -> FloatArray:
        """Inverse covariance of the free unknowns, shape (k, k)."""
        return np.asarray(self.weight * (self.jacobian.T @ self.jacobian) + self.prior_information)

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance of the free unknowns, shape (k, k)."""
        size = np.sqrt(np.maximum(np.diag(self.information), MIN_INFORMATION))
        return np.asarray(
            np.linalg.pinv(self.information / np.outer(size, size), hermitian=True) / np.outer(size, size)
        )

    @property
    def gradient(self) -> FloatArray:
        """Half the derivatives of the cost by the free unknowns, shape (k,)."""
        return np.asarray(
            self.weight * (self.jacobian.T @ self.residual) + (self.x / self.experiment.prior**2)[self.free]
        )


def fit(
    experiment: Experiment,
    start: FloatArray,
    free: IndexArray | None = None,
    steps: int = MAX_STEPS,
    tolerance: float = COST_TOLERANCE,
) -> Fit:
    """Search from a start; unknowns that are not `free` stay where they are."""
    at, damping = experiment.at(np.clip(start, experiment.low, experiment.high), free), FIRST_DAMPING
    low, high, longest = (
        np.broadcast_to(bound, at.x.shape)[at.free] for bound in (experiment.low, experiment.high, experiment.max_step)
    )
    for _ in range(steps):
        if not np.isfinite(at.cost):
            break
        try:
            g, H = at.gradient, at.information
        except CANNOT_RUN:
            break
        z = at.x[at.free]
        inside = ~(((z <= low) & (g > 0.0)) | ((z >= high) & (g < 0.0)))  # others are held at their bounds
        g, H, before = g[inside], H[np.ix_(inside, inside)], at.cost
        while damping < MAX_DAMPING and len(g):
            x, moved = at.x.copy(), z.copy()
            step = np.linalg.solve(H + damping * np.diag(np.maximum(np.diag(H), MIN_INFORMATION)), -g)
            moved[inside] += np.clip(step, -longest[inside], longest[inside])
            x[at.free] = np.clip(moved, low, high)
            after = experiment.at(x, at.free)
            if after.cost < at.cost:
                damping, at = max(damping / DAMPING_FACTOR, MIN_DAMPING), after
                break
            damping *= DAMPING_FACTOR
        if before - at.cost < tolerance:
            break
    return at


def raise_unknown(
    cost: Callable[[FloatArray], float], likely: FloatArray, i: int, highest: float, bisections: int
) -> FloatArray:
    """Return unknowns (m,) of which one is as large as the likelihood allows; `cost`: minus its logarithm."""
    x, low, limit = likely.copy(), float(likely[i]), cost(likely) + LIKELIHOOD_DROP
    for _ in range(bisections):
        x[i] = 0.5 * (low + highest)
        low, highest = (float(x[i]), highest) if cost(x) < limit else (low, float(x[i]))
    x[i] = low
    return x


def minimise_from_grid(
    cost: Callable[[float], float], grid: FloatArray, xatol: float, steps: int = MAX_REFINEMENTS
) -> float:
    """Return where a cost is smallest: at the best point of a grid, or refined between the points beside it."""
    from scipy.optimize import minimize_scalar

    at = int(np.argmin([cost(float(x)) for x in grid]))
    bracket = float(grid[max(at - 1, 0)]), float(grid[min(at + 1, len(grid) - 1)])
    refined = minimize_scalar(cost, bounds=bracket, method="bounded", options={"xatol": xatol, "maxiter": steps})
    return min((float(grid[at]), float(refined.x)), key=cost)
