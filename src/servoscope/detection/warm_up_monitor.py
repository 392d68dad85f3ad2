"""A warm-up that nobody measures, followed while it goes on: a Kalman filter for the course, a test for what breaks it.

The state x = (w, s, k, j) holds the warmth, the surroundings, what losses warm (`servoscope.detection.warm_up`), and
what changes of the machine look like in all, which no warmth is. Each block of time measures w + j by least squares.
A change of the machine is a jump of j: for each of the last blocks the filter carries what a jump there would have done
to it (Willsky and Jones, 1976, IEEE Transactions on Automatic Control 21), and takes the likeliest for real where it is
unlikely enough by chance.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.covariates import CovariateModel, WarmUp
from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.detection.covariate_monitor import CovariateHistory, CovariateMonitor
from servoscope.detection.statistic import required_noncentrality
from servoscope.detection.warm_up import (
    BLOCK_MEMORIES,
    BREAK_BY_CHANCE,
    JUMP,
    MIN_INFORMATION_SHARE,
    NAME,
    PRIOR_STD,
    STD,
    STEP,
)
from servoscope.estimation.pipeline import RegressionRunner

ONSETS = 40  # newest blocks with which a jump may have begun
MIN_JUMP_BLOCKS = 2  # blocks that a jump has to last
MAX_KNOWN_STD = 0.1  # standard deviation of w below which it is known
DRIFT_SHARE = 0.03  # of the learned range by which the surroundings drift within a time constant
MAX_ROUNDS = 4  # of Gauss and Newton
MAX_LOSS_RATIO = 100.0  # times the usual ones that a block may have; more is a sample that was read wrongly
MAX_RANGES = 10.0  # learned ranges: no machine is warmer than that
POINTS, PER_CONSTANT = 32, 8.0  # of the course that is kept, and how many of them lie within a time constant
LOOK = np.array([1.0, 0.0, 0.0, 1.0])  # what a block sees of x


class WarmUpMonitor(CovariateMonitor):
    """Follows the warm-up of one machine; its state is one array, changed in place."""

    def __init__(self, baseline: Baseline, model: CovariateModel, warm_up: WarmUp) -> None:
        from scipy import special

        super().__init__(baseline, model)
        self._pipeline, self._warm_up = baseline.pipeline(), warm_up
        self._rate = baseline.loop.sample_rate
        self._block = max(round(BLOCK_MEMORIES * self._pipeline.memory_samples), 1)
        self._seconds = self._block / self._rate
        self._keep = float(np.exp(-self._seconds / warm_up.time_constant_s))
        self._every = max(round(warm_up.time_constant_s / PER_CONSTANT / self._seconds), 1)
        self._limit = float(special.chdtri(1.0, BREAK_BY_CHANCE / ONSETS))
        self._noncentrality = required_noncentrality(1, self._limit)
        n = self._n = len(baseline.theta)
        self._layout = np.dtype(
            [
                ("head", "f8", 3),  # samples of the block that runs, last y, blocks since the last point was kept
                ("sums", "f8", n * n + n + 2),  # phi phi', phi eta, losses, samples with losses
                ("x", "f8", 4),
                ("P", "f8", (4, 4)),
                ("onsets", "f8", (ONSETS, 6)),  # by block: what a jump there does to x, its information and its score
                ("course", "f8", (POINTS, 2)),  # w and its standard deviation
                ("average", "f8", self.average.size),
                ("filters", "f8", RegressionRunner(self._pipeline).state.size),
            ]
        )
        self.size = self._layout.itemsize // 8

    def _parts(self, state: FloatArray) -> Any:
        """Return the state by the names of its parts, which are views."""
        return state.view(self._layout).view(np.recarray)[0]

    def start(self) -> FloatArray:
        """Return the state before the first sample: nothing is known of the warmth."""
        state = np.zeros(self.size)
        parts = self._parts(state)
        parts.average[:] = self.average.start()  # once: with it come the coefficients to start from
        parts.filters[:] = RegressionRunner(self._pipeline).state
        self._forget(parts)
        return state

    def _forget(self, parts: Any) -> None:
        """Know nothing of warmth and machine, as at the start: what was believed cannot be."""
        parts.x[:], parts.P[:] = (0.5, 0.5, 0.0, 0.0), np.diag([PRIOR_STD**2] * 3 + [0.0])
        self._begin(parts)

    def _begin(self, parts: Any) -> None:
        """Begin anew behind a gap, of which nobody knows how long it was: the warmth is unknown, the rest is kept."""
        parts.head[:], parts.sums[:], parts.onsets[:] = (0.0, np.nan, 0.0), 0.0, 0.0
        parts.P[0], parts.P[:, 0] = 0.0, 0.0
        parts.P[0, 0] = PRIOR_STD**2
        parts.course[:] = np.nan

    def run(
        self,
        state: FloatArray,
        signals: tuple[FloatArray, FloatArray, FloatArray],
        restart: BoolArray,
        channels: Mapping[str, npt.ArrayLike],
    ) -> tuple[FloatArray, FloatArray | None]:
        """Feed r, u and y of a block, shape (N,) each; return averages of w and standard deviations, shape (N, 2).

        No channel has them. They are NaN until the warmth is known. Once, as soon as it is, the coefficients (n,) to
        start from come too.
        """
        parts, (r, u, y), start = self._parts(state), signals, None
        g = RegressionRunner(self._pipeline, parts.filters).advance(r, u, y, restart)
        before = np.concatenate([parts.head[1:2], y[:-1]])
        loss = np.where(restart, np.nan, u * (y - before) * self._rate)
        lossy = np.isfinite(loss)
        products = (g.phi[:, :, None] * g.phi[:, None, :]).reshape(len(r), -1)
        used = np.column_stack([products, g.phi * g.eta[:, None]])
        columns = np.column_stack([np.where(g.ok[:, None], used, 0.0), np.where(lossy, loss, 0.0), lossy])
        course, k = np.full((len(r), 2), np.nan), 0
        gaps = [*np.flatnonzero(restart).tolist(), len(r)]
        while k < len(r):
            if restart[k]:
                self._begin(parts)
            ahead = next(gap for gap in gaps if gap > k)
            end = min(k + self._block - int(parts.head[0]), ahead)
            rows = slice(k, end)
            # one after the other, whatever the blocks: pairwise sums would differ in the last bit
            parts.sums[:] = np.cumsum(np.vstack([parts.sums, columns[rows]]), axis=0)[-1]
            if parts.P[0, 0] < MAX_KNOWN_STD**2:
                if np.isnan(parts.average).any():
                    start = self.model.theta(self._theta, self.model.clip(parts.x[:1]))
                course[rows, 0] = self.average.run(parts.average, np.full((end - k, 1), parts.x[0]))[:, 0]
                course[rows, 1] = np.sqrt(parts.P[0, 0])
            parts.head[0] += end - k
            if parts.head[0] >= self._block:
                self._end_block(parts)
            parts.head[1], k = y[end - 1], end
        return course, start

    def _end_block(self, parts: Any) -> None:
        """Take what a block measures, see whether a jump explains the last ones, and go on to the next one."""
        n, sums = self._n, parts.sums
        A, b, (loss, count) = sums[: n * n].reshape(n, n), sums[n * n : -2], sums[-2:]
        measured = self._measure(parts, A, b)
        F, known = self._transition(float(loss), float(count))
        if measured is not None:
            self._update(parts, *measured)
        parts.head[2] += 1.0
        if parts.head[2] >= self._every:
            parts.course[:-1] = parts.course[1:].copy()
            parts.course[-1] = parts.x[0], np.sqrt(parts.P[0, 0])
            parts.head[2] = 0.0
        keep, drift = self._keep, DRIFT_SHARE**2 * self._seconds / self._warm_up.time_constant_s
        parts.x[:] = F @ parts.x
        parts.P[:] = F @ parts.P @ F.T
        parts.P[0, 0] += 0.0 if known else (0.5 * (1.0 - keep) * parts.x[2]) ** 2  # it may have run, or stood still
        parts.P[1, 1] += drift
        parts.onsets[:, :4] = parts.onsets[:, :4] @ F.T
        parts.head[0], parts.sums[:] = 0.0, 0.0
        if not (abs(parts.x[0]) < MAX_RANGES and np.isfinite(parts.P).all()):
            self._forget(parts)

    def _transition(self, loss: float, count: float) -> tuple[FloatArray, bool]:
        """Return what leads x to the next block, with the losses of this one if known, or half of the usual ones."""
        power = self._warm_up.power
        known = count >= 0.5 * self._block and (not power or abs(loss) <= MAX_LOSS_RATIO * power * count)
        p = 0.0 if not power else loss / count / power if known else 0.5
        F = np.eye(4)
        F[0, :3] = self._keep, 1.0 - self._keep, (1.0 - self._keep) * p
        return F, known

    def _measure(self, parts: Any, A: FloatArray, b: FloatArray) -> tuple[float, float] | None:
        """Return w + j as a block shows it, and its variance; None where the block shows nothing."""
        x, P, z, variance = parts.x, parts.P, float(LOOK @ parts.x), 0.0
        prior = float(LOOK @ P @ LOOK)
        w = z
        for _ in range(MAX_ROUNDS):
            at = np.array([[w + STEP], [w - STEP]])
            upper, lower = self.model.theta(self._theta, at)
            slope = (upper - lower) / (2.0 * STEP)
            information = float(slope @ A @ slope)
            if not information > MIN_INFORMATION_SHARE:
                return None
            z = w + float(slope @ (b - A @ self.model.theta(self._theta, np.array([w])))) / information
            variance = self._warm_up.variance / information
            w = float(LOOK @ x) + prior / (prior + variance) * (z - float(LOOK @ x))
        return z, variance

    def _update(self, parts: Any, z: float, variance: float) -> None:
        """Correct x by a measurement, and then by a jump where one is needed."""
        x, P, onsets = parts.x, parts.P, parts.onsets
        S = float(LOOK @ P @ LOOK) + variance
        gain, off = P @ LOOK / S, z - float(LOOK @ x)
        x += gain * off
        P[:] = P - np.outer(gain, gain) * S
        onsets[:-1] = onsets[1:].copy()
        onsets[-1] = 0.0
        seen = 1.0 - onsets[:, :4] @ LOOK
        seen[onsets[:, 4] == 0.0] = 0.0  # before the first block
        seen[-1] = 1.0
        onsets[:, :4] += seen[:, None] * gain
        onsets[:, 4] += seen**2 / S
        onsets[:, 5] += seen * off / S
        information, score = onsets[: -MIN_JUMP_BLOCKS + 1, 4], onsets[: -MIN_JUMP_BLOCKS + 1, 5]
        statistic = np.divide(score**2, information, out=np.zeros_like(score), where=information > 0.0)
        best = int(np.argmax(statistic))
        if statistic[best] > self._limit:
            towards = np.array([0.0, 0.0, 0.0, 1.0]) - onsets[best, :4]
            x += towards * score[best] / information[best]
            P[:] = P + np.outer(towards, towards) / information[best]
            onsets[:] = 0.0

    def latest(self, state: FloatArray) -> FloatArray:
        """Return the average of w in a state, and its standard deviation, shape (2,)."""
        parts = self._parts(state)
        known = parts.P[0, 0] < MAX_KNOWN_STD**2
        return np.array([self.average.latest(parts.average)[0] if known else np.nan, np.sqrt(parts.P[0, 0])])

    def history(self, state: FloatArray) -> CovariateHistory:
        """Return the course lately, its standard deviation, and the smallest jump that would be found."""
        parts = self._parts(state)
        known = np.isfinite(parts.course[:, 0])
        since = float(parts.head[0]) + (parts.head[2] + 0.5) * self._block
        ago = (since + self._every * self._block * np.arange(POINTS - 1, -1, -1.0)[known]) / self._rate
        t = np.append(-ago, 0.0)
        now, information = (parts.x[0], np.sqrt(parts.P[0, 0])), parts.onsets[:, 4].max()
        w, std = np.vstack([parts.course[known], now]).T
        jump = np.sqrt(self._noncentrality / information) if information > 0.0 else np.inf
        return {NAME: (t, w), STD: (t, std), JUMP: (np.zeros(1), np.array([min(jump, 1.0 / STEP)]))}
