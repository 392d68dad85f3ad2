"""Spans of a recording or a stream against the features of healthy recordings, block by block."""

from __future__ import annotations

from itertools import groupby
from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.detection.feature_model import FeatureModel, SpanFeatures, SpanSums
from servoscope.estimation.window_features import WindowFeatures


class SpanScore(NamedTuple):
    """A span that ended."""

    end: int  # samples up to there
    ratio: float  # its score as a multiple of the limit; NaN where no healthy recording moves like this
    value: float  # the smallest of the newest scores: above 1, a running monitor raises the alarm
    features: SpanFeatures


class FeatureMonitor:
    """Scores the spans of one loop; its state is one array of numbers, changed in place.

    The state holds the newest scores, as many as must be above the limit in a row, then the span that runs, then the
    window that runs.
    """

    def __init__(self, model: FeatureModel) -> None:
        self.model = model
        self._windows = WindowFeatures(model.layout)
        self._head = model.in_a_row + SpanSums.size_of(model.layout)
        self.size = self._head + self._windows.size

    def start(self) -> FloatArray:
        """Return the state before the first sample, shape (size,)."""
        return np.concatenate([np.zeros(self._head), self._windows.start()])

    def run(
        self, state: FloatArray, r: FloatArray, u: FloatArray, y: FloatArray, restart: BoolArray
    ) -> list[SpanScore]:
        """Feed a block of samples, each of shape (N,), and return the spans that ended in it."""
        sums, scores, found = self._span(state), state[: self.model.in_a_row], []
        windows = self._windows.run(state[self._head :], r, u, y, restart)
        for end, ended in groupby(windows, key=lambda window: window.end):
            for window in ended:
                sums.add(window)
            if sums.counts[0] < self.model.layout.span:
                continue
            span = sums.mean()
            sums.state[:] = 0.0
            ratio = self.model.score(span) / self.model.limit
            if np.isfinite(ratio):  # unfamiliar motion neither raises nor clears
                scores[:-1] = scores[1:].copy()
                scores[-1] = ratio
            found.append(SpanScore(end, ratio, self.value(state), span))
        return found

    def unfinished(self, state: FloatArray, end: int) -> SpanScore | None:
        """Return the span that runs, as if it ended here, where it has lasted for half a span at least."""
        sums = self._span(state)
        if 2.0 * sums.counts[0] < self.model.layout.span:
            return None
        span = sums.mean()
        return SpanScore(end, self.model.score(span) / self.model.limit, self.value(state), span)

    def value(self, state: FloatArray) -> float:
        """Return the smallest of the newest scores in a row: above 1, a running monitor raises the alarm."""
        return float(state[: self.model.in_a_row].min())

    def _span(self, state: FloatArray) -> SpanSums:
        return SpanSums(self.model.layout, state[self.model.in_a_row : self._head])


def smallest_in_a_row(ratios: FloatArray, length: int) -> FloatArray:
    """Return the smallest of each score and those before it, `length` together, shape (J,); 0 before there are any."""
    padded = np.concatenate([np.zeros(length - 1), ratios])
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, length).min(axis=-1)) if len(ratios) else ratios


def hold(values: FloatArray, ends: IntArray, samples: IntArray, before: float = 0.0) -> FloatArray:
    """Return the value that holds at each of some samples: that of the span that ended there or last before it."""
    return np.asarray(np.concatenate([[before], values])[np.searchsorted(ends, samples, side="right")])
