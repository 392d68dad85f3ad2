"""Spans of a recording or a stream against the features of healthy recordings, block by block."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from servoscope.baseline.feature_model import FeatureModel
from servoscope.baseline.feature_spans import SpanFeatures, SpanSums
from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.estimation.window_features import Window, WindowFeatures, WindowLanes

NO_CHANNELS: Mapping[str, FloatArray] = {}


class SpanScore(NamedTuple):
    """A span that ended."""

    end: int  # samples up to there
    ratio: float  # its score as a multiple of the limit; NaN where no healthy recording moves like this
    value: float  # the smallest of the newest scores: above 1, a running monitor raises the alarm
    features: SpanFeatures


class FeatureMonitor:
    """Scores the spans of one loop; its state is one array of numbers, changed in place.

    The state holds the newest scores, as many as must be above the limit in a row, then of covariates, if there are
    any, the samples so far and sums and numbers of those in the span that runs, then that span, then the window that
    runs.
    """

    def __init__(self, model: FeatureModel) -> None:
        self.model = model
        self.windows = WindowFeatures(model.layout)
        k = len(model.covariates)
        self._sums = model.in_a_row + (1 + 2 * k if k else 0)  # numbers of the state before the span that runs
        # and before the window that runs
        self.head = self._sums + SpanSums.size_of(model.layout, model.compares_past)
        self.size = self.head + self.windows.size

    def start(self) -> FloatArray:
        """Return the state before the first sample, shape (size,)."""
        return np.concatenate([np.zeros(self.head), self.windows.start()])

    def run(
        self,
        state: FloatArray,
        r: FloatArray,
        u: FloatArray,
        y: FloatArray,
        restart: BoolArray,
        channels: Mapping[str, FloatArray] = NO_CHANNELS,
    ) -> list[SpanScore]:
        """Feed a block of samples, each of shape (N,), and return the spans that ended in it."""
        return self.score(state, self.windows.run(state[self.head :], r, u, y, restart), channels)

    def score(
        self, state: FloatArray, windows: Iterable[Window], channels: Mapping[str, FloatArray] = NO_CHANNELS
    ) -> list[SpanScore]:
        """Add windows to the span that runs, and return the spans that ended with one of them.

        `channels`: the covariates at the samples of the block, NaN where one has no value.
        """
        sums, scores, scored = self._span(state), state[: self.model.in_a_row], []
        values = np.array([channels[name] for name in self.model.covariates], dtype=np.float64)
        begin = 0
        for end, ended in groupby(windows, key=lambda window: window.end):
            for window in ended:
                sums.add(window)
            if sums.counts[0] < self.model.layout.span:
                continue
            if values.size:
                last = end - int(state[self.model.in_a_row])
                self._add_covariates(state, values[:, begin:last])
                begin = last
            span = self._mean(state)
            sums.state[:] = 0.0
            state[self.model.in_a_row + 1 : self._sums] = 0.0
            ratio = self.model.ratio(span)
            if np.isfinite(ratio):  # what is unfamiliar neither raises nor clears
                scores[:-1] = scores[1:].copy()
                scores[-1] = ratio
            scored.append(SpanScore(end, ratio, self.value(state), span))
        if values.size:
            self._add_covariates(state, values[:, begin:])
            state[self.model.in_a_row] += values.shape[1]
        return scored

    def _add_covariates(self, state: FloatArray, values: FloatArray) -> None:
        """Add values (k, N), one after the other, whatever the blocks: pairwise sums would differ in the last bit."""
        sums = state[self.model.in_a_row + 1 : self._sums].reshape(2, -1)
        known = np.isfinite(values)
        for total, addend in zip(sums, (np.where(known, values, 0.0), known.astype(np.float64)), strict=True):
            total[:] = np.cumsum(np.column_stack([total, addend]), axis=1)[:, -1]

    def _mean(self, state: FloatArray) -> SpanFeatures:
        """Return the features of the span that runs; a covariate without any value is NaN, which nothing is like."""
        total, number = state[self.model.in_a_row : self._sums][1:].reshape(2, -1)
        with np.errstate(invalid="ignore"):
            return self._span(state).mean()._replace(covariates=total / number)

    def unfinished(self, state: FloatArray, end: int) -> SpanScore | None:
        """Return the span that runs, as if it ended here, where it has lasted for half a span at least."""
        sums = self._span(state)
        if 2.0 * sums.counts[0] < self.model.layout.span:
            return None
        span = self._mean(state)
        return SpanScore(end, self.model.ratio(span), self.value(state), span)

    def value(self, state: FloatArray) -> float:
        """Return the smallest of the newest scores in a row: above 1, a running monitor raises the alarm."""
        return float(state[: self.model.in_a_row].min())

    def _span(self, state: FloatArray) -> SpanSums:
        return SpanSums(self.model.layout, state[self._sums : self.head], self.model.compares_past)


class FeatureValues(NamedTuple):
    """What the features of several assets say in a block: the value before it, and those of the spans that ended."""

    before: FloatArray  # shape (assets,); 0 where an asset has no features
    spans: list[tuple[int, int, float]]  # asset, last sample since its start, and value, asset by asset in their order

    def at(self, samples: IntArray) -> FloatArray:
        """Return the value that holds at each of some samples, shape (assets, K)."""
        held = np.repeat(self.before[:, None], samples.size, axis=1)
        for asset, end, value in self.spans:
            held[asset, int(np.searchsorted(samples, end)) :] = value
        return held


class FeatureLanes:
    """Scores the spans of several assets together; their states begin at a column of their rows."""

    def __init__(self, assets: Sequence[FeatureMonitor | None], column: int) -> None:
        """`assets`: None for one without features."""
        self._assets, self._column = tuple(assets), column
        heads = np.array([0 if asset is None else asset.head for asset in assets])
        self._windows = WindowLanes([None if asset is None else asset.windows for asset in assets], column + heads)
        in_a_row = np.array([0 if asset is None else asset.model.in_a_row for asset in assets])
        self._others = np.arange(in_a_row.max()) >= in_a_row[:, None]  # what of the first numbers is no score

    def values(self, rows: FloatArray) -> FloatArray:
        """Return `FeatureMonitor.value` of each asset, shape (assets,); 0 where it has no features."""
        scores = rows[:, self._column : self._column + self._others.shape[1]]
        smallest = np.where(self._others, np.inf, scores).min(axis=1)
        return np.asarray(np.where(self._others.all(axis=1), 0.0, smallest))

    def run(
        self,
        rows: FloatArray,
        r: FloatArray,
        u: FloatArray,
        y: FloatArray,
        restart: BoolArray,
        channels: Mapping[str, FloatArray] = NO_CHANNELS,
    ) -> FeatureValues:
        """Feed a block of samples, each of shape (assets, N); the rows are changed in place.

        `channels`: covariates, of the same shape each, where one depends on any.
        """
        before, spans = self.values(rows), []
        ended = {
            asset: [*windows] for asset, windows in groupby(self._windows.run(rows, r, u, y, restart), itemgetter(0))
        }
        for asset, feature_monitor in enumerate(self._assets):
            if feature_monitor is None or not (asset in ended or feature_monitor.model.covariates):
                continue
            windows = (window for _, window in ended.get(asset, ()))
            own = {name: channels[name][asset] for name in feature_monitor.model.covariates}
            scores = feature_monitor.score(
                rows[asset, self._column : self._column + feature_monitor.size], windows, own
            )
            spans += [(asset, span.end - 1, span.value) for span in scores]
        return FeatureValues(before, spans)


def smallest_in_a_row(ratios: FloatArray, length: int) -> FloatArray:
    """Return the smallest of each score and those before it, `length` together, shape (J,); 0 before there are any."""
    padded = np.concatenate([np.zeros(length - 1), ratios])
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, length).min(axis=-1)) if len(ratios) else ratios


def hold(values: FloatArray, ends: IntArray, samples: IntArray, before: float = 0.0) -> FloatArray:
    """Return the value that holds at each of some samples: that of the span that ended there or last before it."""
    return np.asarray(np.concatenate([[before], values])[np.searchsorted(ends, samples, side="right")])
