"""A posterior along one coordinate, from its logarithm at some points: its integral and its interval."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple, Self

import numpy as np

from servoscope.core.arrays import FloatArray

REFINED_POINTS = 9  # points from one that was computed to the next, both included
INTERVAL = 0.025, 0.975
MIN_LOG_DENSITY = 1e4  # below the top, where a logarithm counts as minus infinity


class Posterior(NamedTuple):
    """Logarithm of the integral, and the interval that holds 95 % of it."""

    log_area: float
    interval: tuple[float, float]

    @classmethod
    def from_log_density(cls, x: FloatArray, log_density: FloatArray) -> Self:
        """Integrate; the logarithm runs in straight lines between the points."""
        top = float(log_density.max())
        dense = np.unique(np.concatenate([np.linspace(a, b, REFINED_POINTS) for a, b in pairwise(x)]))
        density = np.exp(np.interp(dense, x, np.maximum(log_density, top - MIN_LOG_DENSITY)) - top)
        area = np.concatenate([[0.0], np.cumsum(np.diff(dense) * (density[1:] + density[:-1]) / 2.0)])
        low, high = np.interp(INTERVAL, area / area[-1], dense)
        return cls(top + float(np.log(area[-1])), (float(low), float(high)))
