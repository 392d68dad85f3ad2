"""What follows the samples of one asset beside the recursion: features of windows, covariates, the motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.errors import BaselineError
from servoscope.detection.baseline import Baseline
from servoscope.detection.covariate_monitor import CovariateHistory, CovariateMonitor
from servoscope.detection.feature_monitor import FeatureMonitor, hold
from servoscope.detection.motion_monitor import MotionEvidence, MotionMonitor
from servoscope.detection.trace import Trace
from servoscope.detection.warm_up_monitor import WarmUpMonitor
from servoscope.estimation.pipeline import Pipeline


class SideValues(NamedTuple):
    """What they say of a block."""

    features: tuple[FloatArray, npt.NDArray[np.int64], float] | None  # values, samples at which each is there, before
    averages: FloatArray | None  # of the covariates at each sample, shape (N, k)
    start: FloatArray | None  # coefficients to start from, as soon as the covariates are known
    motion: MotionEvidence | None

    def features_at(self, index: npt.NDArray[np.int64]) -> FloatArray | None:
        """Return what the features say at some samples, counted since the start."""
        return None if self.features is None else hold(*self.features[:2], index, self.features[2])


class SideMonitors:
    """They share one array of state, each a slice of it; for one asset, in the order of the attributes."""

    def __init__(self, baseline: Baseline, pipeline: Pipeline) -> None:
        self._baseline, self._pipeline = baseline, pipeline
        model, covariates = baseline.features, baseline.covariates
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
        return sum(each.size for each in (self.features, self.covariates, self.motion) if each is not None)

    @property
    def is_joinable(self) -> bool:
        """Whether the asset can be followed side by side with others."""
        return self.covariates is None

    def check_motion(self) -> None:
        """Let a motion never seen make an alarm harder."""
        one = self._baseline
        if one.covariates is not None:
            raise BaselineError("the motion is not checked where there are covariates: leave motion_check out")
        if one.motion is None and not one.extrapolates:
            raise BaselineError("this baseline does not hold the motion of its recordings: learn it again")
        if one.limited_motion is not None:
            self.motion = MotionMonitor(self._pipeline, one.tuning, one.limited_motion)

    def start(self) -> FloatArray:
        """Return the state before the first sample, shape (size,)."""
        parts = [each.start() for each in (self.features, self.covariates, self.motion) if each is not None]
        return np.concatenate(parts) if parts else np.zeros(0)

    def _split(self, state: FloatArray) -> list[FloatArray]:
        """Return the slices of a state."""
        sizes = [0 if each is None else each.size for each in (self.features, self.covariates, self.motion)]
        return np.split(state, np.cumsum(sizes)[:-1])

    def run(
        self, state: FloatArray, signals: Sequence[npt.NDArray[Any]], restart: BoolArray, channels: Mapping[str, Any]
    ) -> SideValues:
        """Feed r, u and y of a block, shape (N,) each; the state is changed in place."""
        r, u, y = (np.asarray(signal, dtype=np.float64) for signal in signals)
        of_features, of_covariates, of_motion = self._split(state)
        features, averages, start, motion = None, None, None, None
        if self.features is not None:
            before, spans = self.features.value(of_features), self.features.run(of_features, r, u, y, restart)
            ends = np.array([span.end - 1 for span in spans], np.int64)
            features = np.array([span.value for span in spans]), ends, before
        if self.motion is not None:
            motion = self.motion.run(of_motion, r, u, y, restart)
        if self.covariates is not None:
            averages, start = self.covariates.run(of_covariates, (r, u, y), restart, channels)
        return SideValues(features, averages, start, motion)

    def latest(self, state: FloatArray) -> SideValues:
        """Return what holds at the last sample of a state, as of a block of one sample."""
        of_features, of_covariates, of_motion = self._split(state)
        none = np.zeros(0)
        return SideValues(
            None if self.features is None else (none, none.astype(np.int64), self.features.value(of_features)),
            None if self.covariates is None else self.covariates.latest(of_covariates)[None],
            None,
            None if self.motion is None else self.motion.latest(of_motion),
        )

    def covariate_history(self, state: FloatArray) -> CovariateHistory:
        """Return what is known of the covariates lately."""
        return {} if self.covariates is None else self.covariates.history(self._split(state)[1])

    def compare(self, trace: Trace, values: SideValues, index: npt.NDArray[np.int64]) -> Trace:
        """Return the evaluations at some samples of a block, compared with what is healthy at the covariates there."""
        if self.covariates is None or values.averages is None:
            return trace
        return self.covariates.compare(trace, values.averages[index])


class SideLanes:
    """Those of several assets, one after the other, in the rows of their states from `column` on."""

    def __init__(self, lanes: Sequence[SideMonitors], column: int) -> None:
        self._lanes, self._column, self.first = lanes, column, lanes[0]

    @property
    def size(self) -> int:
        """Numbers of the longest state."""
        return max(one.size for one in self._lanes)

    def select(self, assets: npt.NDArray[np.intp]) -> SideLanes:
        """Return those of some assets."""
        return SideLanes([self._lanes[asset] for asset in assets.tolist()], self._column)

    def _states(self, rows: FloatArray) -> list[FloatArray]:
        """Return the part of each row that is theirs; none where all of them are empty."""
        ends = [self._column + one.size for one in self._lanes] if rows.shape[1] > self._column else []
        return [row[self._column : end] for row, end in zip(rows, ends, strict=False)]

    def start(self, rows: FloatArray) -> None:
        """Write the states before the first sample, shape (assets, ...)."""
        for state, one in zip(self._states(rows), self._lanes, strict=False):
            state[:] = one.start()

    def run(
        self,
        rows: FloatArray,
        signals: Sequence[npt.NDArray[Any]],
        restart: BoolArray,
        channels: Mapping[str, Any],
    ) -> list[SideValues]:
        """Feed r, u and y of a block, shape (assets, N) each; the states are changed in place."""
        return [
            one.run(state, [signal[i] for signal in signals], restart[i], channels)
            for i, (one, state) in enumerate(zip(self._lanes, self._states(rows), strict=False))
        ]

    def latest(self, rows: FloatArray) -> list[SideValues]:
        """Return what holds at the last sample of each state."""
        return [one.latest(state) for one, state in zip(self._lanes, self._states(rows), strict=False)]


def stack_features(values: Sequence[SideValues], index: npt.NDArray[np.int64]) -> FloatArray | None:
    """Return what the features of each asset say, shape (assets, K), 0 without features; None: none has."""
    found = [one.features_at(index) for one in values]
    if all(one is None for one in found):
        return None
    return np.array([np.zeros(index.size) if one is None else one for one in found])
