"""The motion that a stream holds at present, against that of the healthy recordings, block by block."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servoscope.baseline.motion import (
    MOMENTS,
    SIGNALS,
    WINDOWS,
    MotionRange,
    mean_quantities,
    model_error_covariance,
    motion_columns,
    motion_excess,
    motion_pipelines,
)
from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.detection.statistic import t2_statistic
from servoscope.estimation.pipeline import Pipeline, RegressionRunner, Tuning

MEMORIES, _ = WINDOWS[0]  # of the window that ends at an evaluation: a stream knows no later samples


class MotionEvidence(NamedTuple):
    """What the motion says at K evaluations."""

    excess: FloatArray  # how far it is outside of the baseline's, relative, shape (K,)
    model_error: FloatArray  # what that adds to the covariance of theta_hat, shape (K, n, n)

    def soften_statistic(
        self, statistic: FloatArray, theta: FloatArray, expected: FloatArray, covariance: FloatArray
    ) -> FloatArray:
        """Return T^2 with the model's error, shape (K,); under a motion that was seen it keeps its bits."""
        softer = t2_statistic(theta, expected, covariance + self.model_error)
        return np.where(self.model_error.any(axis=(1, 2)), softer, statistic)


class MotionMonitor:
    """Follows the motion of one loop; its state is one array of numbers, changed in place.

    The state holds the samples so far, the sums since the last evaluation, those of the newest evaluations as far back
    as a window may reach, and the states of the filters. The sums are those of `RecordedMotion`.
    """

    def __init__(self, pipeline: Pipeline, tuning: Tuning, seen: MotionRange) -> None:
        self._pipeline, self._tuning, self._seen = pipeline, tuning, seen
        self._pipelines = motion_pipelines(pipeline)
        states = [RegressionRunner(pipeline).state for pipeline in self._pipelines]
        self._filters, self._ends = np.concatenate(states), np.cumsum([len(state) for state in states])[:-1]
        self._length = MEMORIES * pipeline.memory
        depth = int(np.ceil(self._length * pipeline.stride / pipeline.every)) + 1
        self._table = depth + 1, 1 + SIGNALS * MOMENTS + pipeline.bank.n**2
        self._head = 1 + self._table[0] * self._table[1]
        self.size = self._head + len(self._filters)

    def start(self) -> FloatArray:
        """Return the state before the first sample, shape (size,)."""
        return np.concatenate([np.zeros(self._head), self._filters])

    def run(self, state: FloatArray, r: FloatArray, u: FloatArray, y: FloatArray, restart: BoolArray) -> MotionEvidence:
        """Feed a block of samples, each of shape (N,), and return what holds at the evaluations that fell into it."""
        runners = [*map(RegressionRunner, self._pipelines, np.split(state[self._head :], self._ends))]
        columns = motion_columns(runners, r, u, y, restart, self._seen.origin)
        sums, every = state[1 : self._head].reshape(self._table), self._pipeline.every
        done, windows = int(state[0]), list[FloatArray]()
        ends = np.arange(every - done % every, len(r) + 1, every)
        for piece in np.split(columns, ends):
            # one after the other, whatever the blocks: pairwise sums would differ in the last bit
            sums[-1] = np.cumsum(np.vstack([sums[-1], piece]), axis=0)[-1]
            if len(windows) == len(ends):
                break  # an evaluation that is not over
            windows.append(self._window(sums))
            if sums[-1, 0] >= every // self._pipeline.stride:  # at rest several evaluations count as one
                sums[:-1] = sums[1:].copy()
                sums[-1] = 0.0
        state[0] += len(r)
        return self._judge(np.array(windows).reshape(-1, self._table[1]))

    def latest(self, state: FloatArray) -> MotionEvidence:
        """Return what holds at a sample; K is 1."""
        return self._judge(self._window(state[1 : self._head].reshape(self._table))[None])

    def _window(self, sums: FloatArray) -> FloatArray:
        """Return the sums over the window that ends now, in whole evaluations."""
        backwards = np.cumsum(sums[::-1], axis=0)
        return np.asarray(backwards[min(int(np.searchsorted(backwards[:, 0], self._length)), len(sums) - 1)])

    def _judge(self, windows: FloatArray) -> MotionEvidence:
        means = windows[:, 1:] / np.maximum(windows[:, :1], 1.0)
        values, filled = mean_quantities(means)[:, None], windows[:, :1] / self._length
        excess = motion_excess(self._pipeline, self._seen, values, filled)
        return MotionEvidence(
            np.abs(excess).max(axis=1), model_error_covariance(self._pipeline, self._tuning, means, excess)
        )
