"""The windows of a span added up: mean features, and later windows less earlier ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.estimation.window_features import FeatureLayout, Window

NO_COVARIATES: FloatArray = np.zeros(0)


class SpanFeatures(NamedTuple):
    """Mean features of a span of windows, per level: values (levels, d), windows (levels,), motion (5,)."""

    values: FloatArray
    counts: FloatArray
    motion: FloatArray
    shift: FloatArray = np.zeros((0, 0))  # means of the later windows less those of the earlier ones, shape (levels, d)
    shift_counts: FloatArray = np.zeros(0)  # of how many windows the scatter is that of a shift, shape (levels,)
    covariates: FloatArray = NO_COVARIATES  # means over the span, shape (k,)

    @classmethod
    def of(cls, windows: Sequence[Window], layout: FeatureLayout, past: bool = False) -> SpanFeatures:
        """Average windows; `past`: compare them with the earlier ones too."""
        sums = SpanSums(layout, past=past)
        for window in windows:
            sums.add(window)
        return sums.mean()


class SpanSums:
    """Adds up windows in one array of numbers, `state`, which may be one that somebody else keeps."""

    def __init__(self, layout: FeatureLayout, state: FloatArray | None = None, past: bool = False) -> None:
        d, levels = layout.size, layout.levels
        self.state = np.zeros(self.size_of(layout, past)) if state is None else state
        self.counts = self.state[:levels]
        self._motion = self.state[levels : levels + 10].reshape(2, 5)
        end = levels + 10 + 2 * levels * d
        self._values = self.state[levels + 10 : end].reshape(2, levels, d)
        self._early = self.state[end:].reshape(-1, levels, 1 + d)  # sums and numbers of the earlier windows
        self._half = layout.span / 2.0

    @staticmethod
    def size_of(layout: FeatureLayout, past: bool = False) -> int:
        """Return the size of the state."""
        return layout.levels * (1 + 2 * layout.size) + 10 + (2 * layout.levels * (1 + layout.size) if past else 0)

    def add(self, window: Window) -> None:
        """Add a window; what it does not show does not count."""
        self.counts[window.level] += 1.0
        for sums, values in ((self._values[:, window.level], window.features), (self._motion, window.motion)):
            if sums is self._motion and window.level:
                continue
            seen = np.isfinite(values)
            sums[0][seen] += values[seen]
            sums[1] += seen
        if len(self._early) and self.counts[0] <= self._half:
            seen = np.isfinite(window.features)
            early = self._early[:, window.level]
            early[:, 0] += 1.0
            early[0, 1:][seen] += window.features[seen]
            early[1, 1:] += seen

    def mean(self) -> SpanFeatures:
        """Return the means; NaN where nothing was seen."""
        with np.errstate(invalid="ignore", divide="ignore"):
            values, motion = (sums[0] / sums[1] for sums in (self._values, self._motion))
            if not len(self._early):
                return SpanFeatures(values, self.counts.copy(), motion)
            (sums, seen), number = self._early[:, :, 1:], self._early[0, :, 0]
            shift = (self._values[0] - sums) / (self._values[1] - seen) - sums / seen
            worth = number * (self.counts - number) / np.maximum(self.counts, 1.0)
        return SpanFeatures(values, self.counts.copy(), motion, shift, worth)
