"""Signals thinned to what a screen shows, without losing extremes."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import FloatArray


def downsample_indices(signals: Sequence[FloatArray], points: int) -> npt.NDArray[np.intp]:
    """Return which of N samples to show, so that at most about `points` are left and no extreme is lost.

    Each of equal parts shows where each signal is smallest and largest in it, in the order of time.
    """
    n = signals[0].size
    if n <= points:
        return np.arange(n, dtype=np.intp)
    parts = max(1, points // (2 * len(signals)))
    edges = np.linspace(0, n, parts + 1).astype(np.intp)[:-1]
    width = -(-n // parts)
    index = np.minimum(edges[:, None] + np.arange(width), n - 1)
    shown = [np.zeros(1, dtype=np.intp), np.array([n - 1], dtype=np.intp)]
    for signal in signals:
        known = np.where(np.isfinite(signal), signal, np.nan)[index]
        for missing, pick in ((np.inf, np.argmin), (-np.inf, np.argmax)):
            at = pick(np.where(np.isnan(known), missing, known), axis=1)
            shown.append(index[np.arange(parts), at])
    return np.unique(np.concatenate(shown))


def signal_columns(t: FloatArray, signals: Sequence[FloatArray], points: int) -> dict[str, list[float | None]]:
    """Return the columns t, r, u, y of samples, thinned to about so many points."""
    at = downsample_indices(signals, points)
    return {name: json_numbers(column[at]) for name, column in zip("truy", (t, *signals), strict=True)}


def json_numbers(values: npt.ArrayLike) -> list[float | None]:
    """Return numbers ready for JSON: what is not finite becomes None."""
    return [x if math.isfinite(x) else None for x in np.asarray(values, dtype=np.float64).tolist()]
