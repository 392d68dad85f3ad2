"""The grid that the values of a signal lie on, and the noise that is white in it."""

from __future__ import annotations

import math

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray

ROUNDING = 1e-9  # of the size of a signal, below which two numbers are the same
MAX_ROWS = 100_000  # in which a grid is looked for
MAX_LEVELS = 2.0**17  # of a grid over the range of a signal; finer ones are how numbers are written
TOLERANCE, MIN_ON_GRID = 0.1, 0.9  # of a quantum, and the share of the steps that has to keep to it
MIN_STEPS, MIN_REPEATS = 8, 5.0  # steps, or rows per value, that show a grid
REACHES = (2.5, 10.5, 100.5, math.inf)  # of steps in quanta: the quantum becomes finer with what it is fitted to


def find_quantum(x: FloatArray) -> float | None:
    """Return the step of the grid that the values of a signal, shape (N,), lie on; None where there is no such grid.

    The steps between neighbouring values are whole multiples of the step of the grid (Widrow and Kollar, Quantization
    Noise, 2008, chapter 1). A grid of more than 2^17 levels over the range is how numbers are stored.
    """
    values, counts = np.unique(x[:MAX_ROWS], return_counts=True)
    often = counts > 1
    if counts[often].sum() > MIN_ON_GRID * counts.sum():
        values = values[often]  # without what was interpolated here and there
    steps = np.diff(values)
    steps = steps[steps > ROUNDING * max(float(np.abs(values).max(initial=0.0)), float(steps.sum()))]
    if steps.size < 2 or (steps.size < MIN_STEPS and values.size * MIN_REPEATS > counts.sum()):
        return None
    # the smallest step may be made by one odd value, and of few values there may be no other
    for least in (float(np.quantile(steps, 0.05, method="lower")), float(steps.min())):
        for divisor in range(1, 7):
            grid = least / divisor
            for reach in REACHES:
                few = steps[steps <= reach * grid]
                whole = np.maximum(np.round(few / grid), 1.0)
                grid = float(few @ whole / (whole @ whole)) if few.size else grid
            if np.mean(np.abs(steps / grid - np.round(steps / grid)) <= TOLERANCE) >= MIN_ON_GRID:
                return grid if steps.sum() <= MAX_LEVELS * grid else None
    return None


def white_noise_std(x: FloatArray, restart: BoolArray | None = None, quantum: float | None = None) -> float:
    """Return the standard deviation of what is white in x, shape (N,), robustly from third differences.

    At least that of rounding to the quantum; no difference spans a restart.
    """
    third = np.abs(np.diff(x, 3))
    if restart is not None:
        third = third[~(restart[1:-2] | restart[2:-1] | restart[3:])]
    white = float(np.median(third)) / (0.6745 * math.sqrt(20.0)) if third.size else 0.0
    return max(white, (quantum or 0.0) / math.sqrt(12.0))
