"""Sizes at which the search for a change begins, and the fit of parameters outside the list of faults from there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import FloatArray
from servoscope.isolation.ml.hypothesis import (
    HypothesisFit,
    fit_hypothesis,
    log_ratio_bounds,
    refit_contenders_jointly,
)
from servoscope.isolation.ml.window import SENSOR_GAIN, ChangeProfile, ChangeWindow
from servoscope.models.plants import Fault

RUNGS = 33  # sizes of one fault that are looked at
FURTHER_RANGE = (0.3, 3.0)  # ratios of a parameter outside the list of faults
GRID = 17  # of each of two
VALLEYS = 3  # from which searches begin
BESIDE_S = 2.0, 10.0  # before and after the onset that the grid over two looks at,
MIN_BESIDE_SAMPLES = 20, 100  # or so many samples of a loop slower than 10 Hz


@dataclass(frozen=True, eq=False)
class SizeGrid:
    """Sizes of one fault from one end of its range to the other, where a search may begin."""

    sizes: FloatArray  # logarithms of the ratios
    variants: Any  # a window's, of a step to each size

    @classmethod
    def from_window(cls, window: ChangeWindow, fault: Fault, d: FloatArray) -> Self:
        """Make the predictors, for errors d (m,) of the healthy parameters."""
        (low,), (high,) = log_ratio_bounds([fault])
        sizes = np.linspace(low, high, RUNGS)
        z = np.column_stack([np.tile(d, (RUNGS, 1)), sizes])
        return cls(sizes, window.variants(z, (fault.parameter,), ChangeProfile(0)))

    def sums_of_squares(self, window: ChangeWindow, profile: ChangeProfile) -> FloatArray:
        """Return the sum of squares of each size, a drift taken as a step in its middle."""
        step = ChangeProfile(profile.onset + profile.duration // 2)
        return np.asarray((window.variant_innovations(self.variants, step) ** 2).sum(axis=1))

    def local_minima(self, window: ChangeWindow, profile: ChangeProfile) -> list[FloatArray]:
        """Return the sizes (1,) at the lowest valleys: what a fault does to fast dynamics comes back as an alias."""
        return [self.sizes[at] for at in _local_minima(self.sums_of_squares(window, profile))]


SearchStart = tuple[FloatArray, list[SizeGrid]]
"""Healthy parameters at which searches begin, and a grid per fault."""


def begin_searches(window: ChangeWindow, faults: Sequence[Fault], d: FloatArray) -> list[SearchStart]:
    """Return healthy parameters at which searches begin, each with a grid per fault.

    Healthy parameters that follow may have taken over a fault that was there from the first sample on.
    """
    healthy = [d, np.zeros_like(d)] if window.follows else [d]
    return [(z, [SizeGrid.from_window(window, fault, z) for fault in faults]) for z in healthy]


def pair_start_values(window: ChangeWindow, faults: Sequence[Fault], profile: ChangeProfile) -> list[FloatArray]:
    """Return the sizes (2,) of two faults at the lowest valleys of a grid over both ranges.

    Only the seconds around the onset are looked at: far from the truth they say enough.
    """
    rate, step = window.sample_rate, profile.onset + profile.duration // 2
    before, after = (max(round(s * rate), least) for s, least in zip(BESIDE_S, MIN_BESIDE_SAMPLES, strict=True))
    first, end = max(step - before, 0), step + after
    near, names = window.cut(first, end), [fault.parameter for fault in faults]
    low, high = log_ratio_bounds(faults)
    axes = [np.linspace(a, b, GRID) for a, b in zip(low, high, strict=True)]
    z = np.column_stack([np.zeros((GRID, window.nuisance_count + 1)), axes[1]])
    cost = np.empty((GRID, GRID))
    for row, x in zip(cost, axes[0], strict=True):  # all at once would take hundreds of megabytes of a fast loop
        z[:, -2] = x
        row[:] = (near.residuals(z, names, ChangeProfile(step - first)) ** 2).sum(axis=1)
    return [np.array([axes[0][i], axes[1][j]]) for i, j in _local_minima(cost)]


def fit_further_parameters(
    window: ChangeWindow, profile: ChangeProfile, best: HypothesisFit, noise_variance: float
) -> list[HypothesisFit]:
    """Fit every further parameter of the plant, and the gain of the sensor of y."""
    known = {**window.plant.causes, SENSOR_GAIN: "a gain error of the sensor of y"}
    fits = []
    for name, words in known.items():
        fault = Fault(name, name, FURTHER_RANGE, words)
        starts = SizeGrid.from_window(window, fault, best.d).local_minima(window, profile)
        fits.append(fit_hypothesis(window, [fault], profile, best.d, starts, free=False))
    return refit_contenders_jointly(window, fits, noise_variance, best.cost)


def _local_minima(cost: FloatArray) -> npt.NDArray[np.int64]:
    """Return where the lowest valleys of a table are, the lowest first, shape (v, cost.ndim)."""
    cost = np.where(np.isfinite(cost), cost, np.inf)  # of a plant that cannot run, or of signals beyond all numbers
    around = np.lib.stride_tricks.sliding_window_view(np.pad(cost, 1, constant_values=np.inf), (3,) * cost.ndim)
    minima = np.argwhere(cost <= around.min(axis=tuple(range(-cost.ndim, 0))))
    return minima[np.argsort(cost[tuple(minima.T)])][:VALLEYS]
