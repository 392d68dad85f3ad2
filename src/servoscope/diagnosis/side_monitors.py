"""What follows the samples of assets beside the recursion: features of windows, covariates, the motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.errors import BaselineError
from servoscope.detection.covariate_monitor import CovariateHistory, CovariateMonitor, read_channels
from servoscope.detection.feature_monitor import FeatureLanes, FeatureMonitor, FeatureValues
from servoscope.detection.motion_monitor import MotionEvidence, MotionMonitor
from servoscope.detection.trace import Trace
from servoscope.detection.warm_up_monitor import WarmUpMonitor
from servoscope.estimation.pipeline import Pipeline


class AssetValues(NamedTuple):
    """What they say of a block of one asset."""

    averages: FloatArray | None = None  # of the covariates at each sample, shape (N, k)
    start: FloatArray | None = None  # coefficients to start from, as soon as the covariates are known
    motion: MotionEvidence | None = None


class SideValues(NamedTuple):
    """What they say of a block of several assets."""

    features: FeatureValues | None
    assets: Mapping[int, AssetValues]  # of those that have covariates or whose motion is checked, by number


class SideMonitors:
    """Those of one asset. They share one array of state, each a slice of it, in the order of the attributes."""

    def __init__(self, baseline: Baseline, pipeline: Pipeline) -> None:
        self._baseline, self._pipeline = baseline, pipeline
        model, covariates, self.logged = baseline.features, baseline.covariates, baseline.logged_covariates
        self.features = None if model is None else FeatureMonitor(model)
        self.covariates: CovariateMonitor | None = None
        if covariates is not None and covariates.warm_up is not None:
            self.covariates = WarmUpMonitor(baseline, covariates, covariates.warm_up)
        elif covariates is not None:
            self.covariates = CovariateMonitor(baseline, covariates)
        self.motion: MotionMonitor | None = None

    @property
    def size(self) -> int:
        """Numbers of the state."""
        return sum(monitor.size for monitor in (self.features, self.covariates, self.motion) if monitor is not None)

    @property
    def is_joinable(self) -> bool:
        """Whether the asset can be followed side by side with others."""
        return self.covariates is None

    def check_motion(self) -> None:
        """Let a motion never seen make an alarm harder."""
        baseline = self._baseline
        if baseline.motion is None and not baseline.extrapolates:
            raise BaselineError("this baseline does not hold the motion of its recordings: learn it again")
        if baseline.limited_motion is not None:
            self.motion = MotionMonitor(self._pipeline, baseline.tuning, baseline.limited_motion)

    def start(self) -> FloatArray:
        """Return the state before the first sample, shape (size,)."""
        parts = [monitor.start() for monitor in (self.features, self.covariates, self.motion) if monitor is not None]
        return np.concatenate(parts) if parts else np.zeros(0)

    def _split(self, state: FloatArray) -> list[FloatArray]:
        """Return the slices of a state."""
        sizes = [0 if monitor is None else monitor.size for monitor in (self.features, self.covariates, self.motion)]
        return np.split(state, np.cumsum(sizes)[:-1])

    def run(
        self, state: FloatArray, signals: Sequence[FloatArray], restart: BoolArray, channels: Mapping[str, FloatArray]
    ) -> AssetValues:
        """Feed r, u and y of a block, shape (N,) each, to all but the features; the state is changed in place."""
        r, u, y = signals
        _, of_covariates, of_motion = self._split(state)
        averages, start, motion = None, None, None
        if self.motion is not None:
            motion = self.motion.run(of_motion, r, u, y, restart)
        if self.covariates is not None:
            averages, start = self.covariates.run(of_covariates, (r, u, y), restart, channels)
        return AssetValues(averages, start, motion)

    def latest(self, state: FloatArray) -> AssetValues:
        """Return what holds at the last sample of a state, as of a block of one sample."""
        _, of_covariates, of_motion = self._split(state)
        return AssetValues(
            None if self.covariates is None else self.covariates.latest(of_covariates)[None],
            None,
            None if self.motion is None else self.motion.latest(of_motion),
        )

    def covariate_history(self, state: FloatArray) -> CovariateHistory:
        """Return what is known of the covariates lately."""
        return {} if self.covariates is None else self.covariates.history(self._split(state)[1])

    def compare(self, trace: Trace, values: AssetValues, index: npt.NDArray[np.int64]) -> Trace:
        """Return the evaluations at some samples of a block, compared with what is healthy there."""
        if self.covariates is not None and values.averages is not None:
            trace = self.covariates.compare(trace, values.averages[index])
        if values.motion is None:
            return trace
        softer = values.motion.soften_statistic(trace.statistic, trace.theta, trace.expected, trace.covariance)
        statistic = softer if self.covariates is None else np.where(trace.ready, softer, 0.0)
        return replace(trace, statistic=statistic, motion=values.motion.excess)


class SideLanes:
    """Those of several assets, in the rows of their states from `column` on."""

    def __init__(self, lanes: Sequence[SideMonitors], column: int) -> None:
        self._lanes, self._column, self.first = tuple(lanes), column, lanes[0]

    @cached_property
    def _features(self) -> FeatureLanes | None:
        features = [lane.features for lane in self._lanes]
        return None if all(feature is None for feature in features) else FeatureLanes(features, self._column)

    @cached_property
    def _alone(self) -> dict[int, SideMonitors]:
        """Those that follow one asset after the other, by its number."""
        followed = (lane.covariates is not None or lane.motion is not None for lane in self._lanes)
        return {asset: self._lanes[asset] for asset, alone in enumerate(followed) if alone}

    @property
    def size(self) -> int:
        """Numbers of the longest state."""
        return max(lane.size for lane in self._lanes)

    def select(self, assets: npt.NDArray[np.intp]) -> SideLanes:
        """Return those of some assets."""
        return SideLanes([self._lanes[asset] for asset in assets.tolist()], self._column)

    def start(self, rows: FloatArray) -> None:
        """Write the states before the first sample, shape (assets, ...)."""
        for row, lane in zip(rows, self._lanes, strict=True):
            row[self._column : self._column + lane.size] = lane.start()

    def run(
        self,
        rows: FloatArray,
        signals: Sequence[npt.NDArray[Any]],
        restart: BoolArray,
        channels: Mapping[str, npt.ArrayLike],
    ) -> SideValues:
        """Feed r, u, y and channels of a block, shape (assets, N) each; the states are changed in place."""
        if self._features is None and not self._alone:
            return SideValues(None, {})
        r, u, y = (np.asarray(signal, dtype=np.float64) for signal in signals)
        names = dict.fromkeys(name for lane in self._alone.values() for name in lane.logged)
        known = read_channels(tuple(names), {name: np.atleast_2d(value) for name, value in channels.items()}, r.shape)
        features = None if self._features is None else self._features.run(rows, r, u, y, restart, known)
        values = {
            asset: lane.run(
                self._own(rows, asset),
                (r[asset], u[asset], y[asset]),
                restart[asset],
                {name: value[asset] for name, value in known.items()},
            )
            for asset, lane in self._alone.items()
        }
        return SideValues(features, values)

    def latest(self, rows: FloatArray) -> SideValues:
        """Return what holds at the last sample of each state."""
        features = None if self._features is None else FeatureValues(self._features.values(rows), [])
        return SideValues(features, {asset: lane.latest(self._own(rows, asset)) for asset, lane in self._alone.items()})

    def compare(self, trace: Trace, values: SideValues, index: npt.NDArray[np.int64]) -> Trace:
        """Return the evaluations of a fleet at some samples of a block, each asset compared with what is healthy."""
        if not self._alone:
            return trace
        compared = [trace.lane(asset) for asset in range(len(self._lanes))]
        for asset, lane in self._alone.items():
            compared[asset] = lane.compare(compared[asset], values.assets[asset], index)
        return trace.with_lanes(compared)

    def _own(self, rows: FloatArray, asset: int) -> FloatArray:
        """Return the state of an asset."""
        return rows[asset, self._column : self._column + self._lanes[asset].size]
