"""Sizes at which the search for a fault's size begins: what is lowest on a grid over the whole range."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from servoscope.plants import Fault, FloatArray
from servoscope.refinement.hypotheses import bounds
from servoscope.refinement.predictor import Predictor
from servoscope.refinement.window import Growth, Window

RUNGS = 33  # sizes of one fault that are looked at
GRID = 17  # of each of two
VALLEYS = 3  # from which searches begin
BESIDE_S = 2.0, 10.0  # before and after the onset that the grid over two looks at


@dataclass(frozen=True, eq=False)
class Ladder:
    """Sizes of one fault from one end of its range to the other, where a search may begin.

    Parameters
    ----------
    sizes
        Logarithms of the ratios.
    predictors
        Of the healthy plant and the one of each size.
    """

    sizes: FloatArray
    predictors: tuple[Predictor, ...]

    @classmethod
    def of(cls, window: Window, fault: Fault, d: FloatArray) -> Self:
        """Make the predictors, for errors d (m,) of the healthy parameters."""
        (low,), (high,) = bounds([fault])
        sizes, step = np.linspace(low, high, RUNGS), Growth(0)
        return cls(sizes, tuple(window.predictor(d, (fault.parameter,), np.array([x]), step) for x in sizes))

    def costs(self, window: Window, growth: Growth) -> FloatArray:
        """Return the sum of squares of each size, a drift taken as a step in its middle."""
        step = Growth(growth.since + growth.over // 2)
        return np.array([float((window.innovations(each, step) ** 2).sum()) for each in self.predictors])

    def valleys(self, window: Window, growth: Growth) -> list[FloatArray]:
        """Return the sizes (1,) at the lowest valleys: what a fault does to fast dynamics comes back as an alias."""
        return [self.sizes[at] for at in _lowest(self.costs(window, growth))]


def valleys(window: Window, faults: Sequence[Fault], growth: Growth) -> list[FloatArray]:
    """Return the sizes (2,) of two faults at the lowest valleys of a grid over both ranges.

    Only the seconds around the onset are looked at: far from the truth they say enough.
    """
    rate, step = window.bench.loop.sample_rate, growth.since + growth.over // 2
    first, end = max(step - round(BESIDE_S[0] * rate), 0), step + round(BESIDE_S[1] * rate)
    near, names, d = window.cut(first, end), [fault.parameter for fault in faults], np.zeros(window.nuisances)
    low, high = bounds(faults)
    axes = [np.linspace(a, b, GRID) for a, b in zip(low, high, strict=True)]
    cost = np.empty((GRID, GRID))
    for i, x in enumerate(axes[0]):
        for j, z in enumerate(axes[1]):
            cost[i, j] = (near.residual(np.append(d, [x, z]), names, Growth(step - first)) ** 2).sum()
    return [np.array([axes[0][i], axes[1][j]]) for i, j in _lowest(cost)]


def _lowest(cost: FloatArray) -> npt.NDArray[np.int64]:
    """Return where the lowest valleys of a table are, the lowest first, shape (v, cost.ndim)."""
    around = np.lib.stride_tricks.sliding_window_view(np.pad(cost, 1, constant_values=np.inf), (3,) * cost.ndim)
    found = np.argwhere(cost <= around.min(axis=tuple(range(-cost.ndim, 0))))
    return found[np.argsort(cost[tuple(found.T)])][:VALLEYS]
