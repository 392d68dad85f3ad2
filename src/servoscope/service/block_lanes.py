"""Accepted blocks through time base, monitor and data quality: of one asset, or of several side by side.

Both ways lead to the same bits, so that nothing depends on which assets happen to be ready at the same time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.detection.trace import Trace
from servoscope.diagnosis.monitor import Monitor
from servoscope.service.checkpoint import AssetState
from servoscope.service.layer_times import LayerTimes
from servoscope.service.residual_history import HistoryState, LatestEvaluation, evaluation_status, update_history
from servoscope.signals import quality
from servoscope.signals.timebase import Timebase


class LaneInput(NamedTuple):
    """A block that is to be followed, with the state before it."""

    state: AssetState
    signals: FloatArray  # t, r, u, y and covariates, shape (4 + k, N)
    restart: bool  # whether samples before it are missing


class LaneOutput(NamedTuple):
    """What a block has led to."""

    monitor: FloatArray
    quality: FloatArray
    samples: int  # that the monitor has processed so far
    last_t: float | None  # time of the last one [UTC s]
    history: HistoryState
    rows: list[dict[str, Any]]  # of the history that are complete
    evaluation: LatestEvaluation | None  # None: the block has none


class BlockLanes:
    """Follows blocks of assets that have one sample rate and the same limits of data quality."""

    def __init__(self, rate: float, limits: quality.QualityLimits, residual_every_s: float) -> None:
        self._rate, self._limits, self._residual_every_s = rate, limits, residual_every_s
        self._timebase = Timebase(1.0 / rate)

    def follow(self, monitor: Monitor, accepted: LaneInput) -> LaneOutput:
        """Follow a block of one asset, in whatever order its samples are."""
        state, block, _ = accepted
        last = np.nan if state.last_t is None else state.last_t
        order = self._timebase.order_block(block[0], last)
        order.restart[:1] |= accepted.restart
        t, signals = block[0, order.rows], block[1:, order.rows]
        r, u, y, *covariates = np.where(np.isfinite(signals), signals, np.nan)
        channels = dict(zip(monitor.baselines[0].logged_covariates, covariates, strict=False))
        new, trace = monitor.run(state.monitor, r, u, y, order.restart, channels=channels)
        checked, _ = quality.check_block(self._limits, state.quality, *block[:4, order.order])
        last_t = order.t if np.isfinite(order.t) else None
        checked, _ = quality.tick(self._limits, checked, state.position.t if last_t is None else last_t)
        times = t[self._evaluated_samples(trace, state)]
        history, rows = update_history(state.history, trace, times, self._residual_every_s)
        evaluation = None
        if times.size:
            excess, level, _ = _peaks(trace).tolist()
            features = None if trace.features is None else float(trace.features[-1])
            exceeded = bool(trace.exceeded[-1])
            evaluation = LatestEvaluation(exceeded, (excess, level), features, float(times[-1]), _writer(trace, times))
        return LaneOutput(new, checked, state.samples + len(t), last_t, history, rows, evaluation)

    def are_regular(self, blocks: Sequence[LaneInput], signals: FloatArray) -> BoolArray:
        """Tell which of some blocks of one length need no sorting, and no second look at what came before them.

        `signals`: theirs, shape (blocks, 4, N).
        """
        last = np.array([np.nan if one.state.last_t is None else one.state.last_t for one in blocks])
        follows = ~np.array([one.restart for one in blocks], dtype=np.bool_)
        return np.logical_and(self._timebase.is_regular(signals[:, 0], last), follows)

    def follow_lanes(
        self, fleet: Monitor, blocks: Sequence[LaneInput], signals: FloatArray, layers: LayerTimes
    ) -> list[LaneOutput]:
        """Follow regular blocks of the assets of a fleet, of one length and one phase, side by side.

        `signals`: theirs, shape (blocks, 4, N).
        """
        layers.enter("assemble")
        states = [one.state for one in blocks]
        t, given = signals[:, 0], signals[:, 1:]
        used = np.where(np.isfinite(given), given, np.nan)
        before = np.array([one.monitor for one in states])
        layers.enter("kernel")
        monitors, trace = fleet.run(before, used[:, 0], used[:, 1], used[:, 2])
        layers.enter("quality")
        checked = quality.check_lanes(self._limits, np.array([one.quality for one in states]), t, given)
        layers.enter("judge")
        times = t[:, self._evaluated_samples(trace, states[0])]
        last_t, size = t[:, -1].tolist(), t.shape[1]
        if not times.shape[1]:
            return [
                LaneOutput(monitors[i].copy(), checked[i].copy(), one.samples + size, at, one.history, [], None)
                for i, (one, at) in enumerate(zip(states, last_t, strict=True))
            ]
        columns = zip(
            states,
            last_t,
            times[:, -1].tolist(),
            trace.exceeded[:, -1].tolist(),
            _peaks(trace).T.tolist(),
            np.floor(times[:, [0, -1]] / self._residual_every_s).tolist(),
            strict=True,
        )
        found = []
        for i, (state, at, evaluated, exceeded, (excess, level, known), (first, last)) in enumerate(columns):
            history, rows = state.history, list[dict[str, Any]]()
            if first == history.period == last:
                if known > history.excess or level > history.level:
                    history = HistoryState(history.period, max(history.excess, known), max(history.level, level))
            else:
                history, rows = update_history(history, trace.lane(i), times[i], self._residual_every_s)
            features = None if trace.features is None else float(trace.features[i, -1])
            evaluation = LatestEvaluation(exceeded, (excess, level), features, evaluated, _writer(trace, times, i))
            # copies: an asset that falls silent must not hold the arrays of all others
            new, seen = monitors[i].copy(), checked[i].copy()
            found.append(LaneOutput(new, seen, state.samples + size, at, history, rows, evaluation))
        return found

    def _evaluated_samples(self, trace: Trace, state: AssetState) -> npt.NDArray[np.int64]:
        """Return at which of a block's samples the evaluations are."""
        return np.rint(trace.t * self._rate).astype(np.int64) - state.samples


def _peaks(trace: Trace) -> FloatArray:
    """Return the largest T^2 of a block, over its limit, the largest sequential test, and T^2 for the history.

    Shape (3, ...). The history counts T^2 only where the estimator has learned something.
    """
    excess = np.nan_to_num(trace.statistic / trace.threshold)
    known = np.where(trace.ready, excess, 0.0)
    return np.array([excess.max(axis=-1), trace.level.max(axis=-1), known.max(axis=-1, initial=0.0)])


def _writer(trace: Trace, times: FloatArray, lane: int | None = None) -> Callable[[], Any]:
    """Return what writes an evaluation down when somebody asks for it."""
    if lane is None:
        return lambda: evaluation_status(trace, float(times[-1]))
    return lambda: evaluation_status(trace.lane(lane), float(times[lane, -1]))
