"""Accepted blocks through time base, monitor and data quality: of one asset, or of several side by side.

Both ways lead to the same bits, so that nothing depends on which assets happen to be ready at the same time.
"""

from __future__ import annotations

from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray, IndexArray
from servoscope.detection.trace import Trace
from servoscope.diagnosis.monitor import Monitor
from servoscope.service.assets.checkpoint import AssetState, evolve
from servoscope.service.assets.idle_monitor import Follower
from servoscope.service.assets.residual_history import (
    HistoryState,
    LastEvaluations,
    LatestEvaluation,
    known_excess,
    update_history,
)
from servoscope.service.clock import LayerTimes
from servoscope.signals import quality
from servoscope.signals.timebase import MAX_TIME_S, Timebase

Followed = tuple[AssetState, list[dict[str, Any]]]  # the state after a block but for its position; rows of the history


class LaneEvaluations:
    """The evaluations of a block of each of several assets, at `times` [UTC s], shape (assets, K), K > 0.

    What is judged of them, of each asset: `exceeded`, whether the last one is above a limit; `peaks` of the block, the
    largest T^2 over its limit, the largest sequential test, and T^2 for the history, shape (3, assets); `t`, time of
    the last one [UTC s]; `periods` of the history in which they lie, shape (assets, K).
    """

    def __init__(self, trace: Trace, times: FloatArray, every_s: float) -> None:
        self._trace, self._times, self._every_s = trace, times, every_s
        self.exceeded, self.t = trace.exceeded[:, -1], times[:, -1]
        excess = np.nan_to_num(trace.statistic / trace.threshold).max(axis=-1)
        # the history counts T^2 only where the estimator has learned something
        self.peaks = np.array([excess, trace.level.max(axis=-1), known_excess(trace).max(axis=-1, initial=0.0)])
        self.periods = np.floor(times / every_s)
        self._last = cache(partial(LastEvaluations, trace))  # most are replaced before anybody looks

    def latest(self, lane: int) -> LatestEvaluation:
        """Return the newest one of an asset."""
        excess, level, _ = self.peaks[:, lane].tolist()
        t, features, last = float(self.t[lane]), self._trace.features, self._last
        learned = None if features is None else float(features[lane, -1])
        return LatestEvaluation(bool(self.exceeded[lane]), (excess, level), learned, t, lambda: last().status(lane, t))

    def update_history(self, lane: int, state: HistoryState) -> tuple[HistoryState, list[dict[str, Any]]]:
        """Add those of an asset to its history, as `residual_history.update_history` does."""
        return update_history(state, self._trace.lane(lane), self._times[lane], self._every_s)

    def update_histories(
        self, lanes: IndexArray, period: FloatArray, peaks: FloatArray
    ) -> tuple[FloatArray, list[tuple[int, dict[str, Any]]]]:
        """Add those of some assets to their histories.

        `period`: under way, shape (lanes,); `peaks`: its largest statistics, shape (2, lanes). Returns the peaks of the
        period that is under way then, and the rows that are complete, each with the place of its lane.
        """
        largest, rows = self.peaks[[2, 1]][:, lanes], list[tuple[int, dict[str, Any]]]()
        after = np.where(largest > peaks, largest, peaks)
        for k in np.flatnonzero(self.periods[lanes, -1] != period).tolist():  # few at a time
            before = HistoryState(int(period[k]), *peaks[:, k].tolist())
            state, complete = self.update_history(int(lanes[k]), before)
            after[:, k] = state.excess, state.level
            rows += [(k, row) for row in complete]
        return after, rows


class LanesOutput(NamedTuple):
    """What a block of each of several assets has led to."""

    monitor: FloatArray  # shape (assets, size)
    quality: FloatArray  # shape (assets, size)
    t: FloatArray  # time of the last sample, shape (assets,), NaN where none has one [UTC s]
    size: int  # samples of each block
    evaluations: LaneEvaluations | None  # None: the blocks have none

    def lane(self, lane: int, state: AssetState) -> Followed:
        """Return that of one asset, with the state before it."""
        history, rows, latest = state.history, list[dict[str, Any]](), state.evaluation
        if self.evaluations is not None:
            history, rows = self.evaluations.update_history(lane, history)
            latest = self.evaluations.latest(lane)
        after = evolve(
            state,
            monitor=self.monitor[lane].copy(),  # an asset that falls silent must not hold the arrays of all others
            quality=self.quality[lane].copy(),
            samples=state.samples + self.size,
            last_t=None if np.isnan(t := float(self.t[lane])) else t,
            history=history,
            evaluation=latest,
        )
        return after, rows


class BlockLanes:
    """Follows blocks of assets that have one sample rate and the same limits of data quality."""

    def __init__(self, rate: float, limits: quality.QualityLimits, residual_every_s: float) -> None:
        self._rate, self._limits, self._residual_every_s = rate, limits, residual_every_s
        self.timebase = Timebase(1.0 / rate)

    def follow(
        self, monitor: Follower, state: AssetState, block: FloatArray, restart: bool, layers: LayerTimes
    ) -> Followed:
        """Follow a block of one asset, in whatever order its samples are.

        `block`: t, r, u, y and covariates, shape (4 + k, N); `restart`: whether samples before it are missing.
        """
        last = np.nan if state.last_t is None else state.last_t
        order = self.timebase.order_block(block[0], last)
        order.restart[:1] |= restart
        t, signals = block[0, order.rows], block[1:, order.rows]
        r, u, y, *covariates = np.where(np.isfinite(signals), signals, np.nan)
        names = monitor.baselines[0].logged_covariates if isinstance(monitor, Monitor) else ()
        channels = dict(zip(names, covariates, strict=False))
        layers.enter("kernel")
        new, trace = monitor.run_lanes(state.monitor[None], r, u, y, order.restart, channels=channels)
        layers.enter("quality")
        checked, _ = quality.check_block(self._limits, state.quality, *block[:4, order.order])
        checked, _ = quality.tick(self._limits, checked, order.t if np.isfinite(order.t) else state.position.t)
        layers.enter("judge")
        evaluations = self._evaluate(trace, t[None], state.samples)
        return LanesOutput(new, checked[None], np.array([order.t]), len(t), evaluations).lane(0, state)

    def begin_regularly(self, t: FloatArray) -> BoolArray:
        """Tell which of some first blocks, with times `t` (blocks, N), need no sorting."""
        return self.timebase.is_regular(t, t[:, 0] - self.timebase.period) & (np.abs(t[:, [0, -1]]) < MAX_TIME_S).all(
            axis=1
        )

    def follow_lanes(
        self,
        fleet: Monitor,
        before: tuple[FloatArray, FloatArray],
        samples: int,
        signals: FloatArray,
        begins: BoolArray,
        layers: LayerTimes,
    ) -> LanesOutput:
        """Follow regular blocks of the assets of a fleet, of one length and one phase, side by side.

        `before`: states of monitor and data quality, shape (blocks, ...) each; `samples`: that the monitor of the first
        asset has processed; `signals`: of the blocks, shape (blocks, 4 + k, N); `begins`: before which of
        them nothing came.
        """
        t, given = signals[:, 0], signals[:, 1:4]
        known = np.isfinite(given)
        used = given if known.all() else np.where(known, given, np.nan)
        layers.enter("kernel")
        restart = None
        if begins.any():
            restart = np.zeros(t.shape, dtype=np.bool_)
            restart[:, 0] = begins
        monitors, trace = fleet.run(before[0], used[:, 0], used[:, 1], used[:, 2], restart)
        layers.enter("quality")
        checked = quality.check_lanes(self._limits, before[1], t, given)
        layers.enter("judge")
        return LanesOutput(monitors, checked, t[:, -1].copy(), t.shape[1], self._evaluate(trace, t, samples))

    def _evaluate(self, trace: Trace | None, t: FloatArray, samples: int) -> LaneEvaluations | None:
        """Return the evaluations of blocks with the times `t`, shape (blocks, N); `samples` were processed before."""
        if trace is None:
            return None
        times = t[:, np.rint(trace.t * self._rate).astype(np.int64) - samples]
        return LaneEvaluations(trace, times, self._residual_every_s) if times.shape[1] else None
