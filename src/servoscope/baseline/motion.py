"""Which motion the healthy recordings hold, and how far the model may be off under a motion that they do not hold.

What a model leaves out is orthogonal to its regressors under the motion that it was fitted to, and under no other. Of a
residual of variance R it moves least squares by at most (R (sum phi phi'/N)^-1)^1/2 in any direction, by Cauchy and
Schwarz, and it grows with the distance from the motion that was seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servoscope.baseline.records import BaselineModel, Matrix
from servoscope.core import outofcore
from servoscope.core.arrays import BoolArray, FloatArray, to_tuples
from servoscope.estimation.pipeline import Pipeline, RegressionRunner, Tuning
from servoscope.signals import Recording

QUANTITIES = ("amplitude", "speed", "acceleration", "frequency")
# of the windows in memories: the last ones, which the estimate remembers, and those around, which vary less
WINDOWS = ((2.0, False), (4.0, True))
KIND_TOLERANCE = 0.05  # relative excess by which recordings of one kind of motion differ
MIN_WINDOW_SHARE = 0.5  # of a window, from which what it holds of the recording's beginning counts
MIN_MOTION_SHARE = 1e-3  # of the largest value of a quantity: below, r or y counts as still
MIN_CHANGE_STDS = 3.0  # of the error of extrapolation, from which on a change under a motion never seen is one
MIN_DIRECTION_SHARE = 1e-6  # of the mean square of a regressor: directions without motion say nothing
AT_ONCE = 8192  # evaluations that are compared together
SIGNALS = 2  # r and y
MOMENTS = 3  # mean squares of position, speed and acceleration


class MotionRange(BaselineModel):
    """The motion of the healthy recordings: what root mean squares over windows of `WINDOWS` were between.

    `least`, `most`: window by window, of r and of y, the `QUANTITIES`: distance from `origin`, speed, acceleration, and
    acceleration over speed as a frequency [Hz].
    """

    origin: float  # mean of y
    least: tuple[Matrix, ...]
    most: tuple[Matrix, ...]


@dataclass(frozen=True, eq=False)
class RecordedMotion:
    """The motion of a recording around each of its K evaluations, from sums over all samples that updated the estimate.

    `sums`, shape (K + 1, 1 + 6 + n n): their number, squares of position, speed and acceleration of r and of y behind
    the loop's filter, and phi phi'. `updates`, shape (K + 1,): their number, side by side in memory for a search.
    """

    pipeline: Pipeline
    sums: FloatArray
    updates: FloatArray

    @classmethod
    def from_recording(cls, pipeline: Pipeline, recording: Recording, origin: float) -> RecordedMotion:
        """Read a recording once."""
        runners = [*map(RegressionRunner, motion_pipelines(pipeline))]
        n, every = pipeline.bank.n, pipeline.every
        evaluations = recording.samples // every
        sums = outofcore.empty((evaluations + 2, 1 + SIGNALS * MOMENTS + n * n))
        for rows in outofcore.iter_chunks(0, len(sums), sums):
            sums[rows] = 0.0
        for rows in outofcore.iter_chunks(0, recording.samples):
            part = recording.rows(rows)
            columns = motion_columns(runners, part.r, part.u, part.y, part.restart, origin)
            which = np.arange(rows.start, rows.stop) // every
            first = np.flatnonzero(np.diff(which, prepend=-1))
            sums[which[first] + 1] += np.add.reduceat(columns, first, axis=0)
            outofcore.release(*recording.columns, sums)
        before = np.zeros(sums.shape[1])
        for rows in outofcore.iter_chunks(0, len(sums), sums):
            sums[rows] = before + np.cumsum(sums[rows], axis=0)
            before = sums[rows.stop - 1].copy()
        sums = sums[: evaluations + 1]
        return cls(pipeline, sums, outofcore.copy_column(sums[:, 0]))

    def _means(self, at: slice, memories: float, centred: bool) -> tuple[FloatArray, FloatArray]:
        """Return means over the window of each of some evaluations, and the samples in it."""
        updates, length = self.updates, memories * self.pipeline.memory
        end = np.arange(*at.indices(len(updates) - 1)) + 1
        if centred:  # at the ends of a recording the window stays as long as it is
            upper = np.clip(updates[end] + length / 2.0, length, updates[-1])
            end = np.minimum(np.searchsorted(updates, upper), len(updates) - 1)
        begin = np.maximum(np.searchsorted(updates, updates[end] - length, side="right") - 1, 0)
        inside = self.sums[end] - self.sums[begin]
        return inside[:, 1:] / np.maximum(inside[:, :1], 1.0), inside[:, 0]

    def quantities(self, at: slice) -> tuple[FloatArray, FloatArray]:
        """Return `QUANTITIES` at evaluations, window by window, of r and y, shape (K, 2, 2, 4).

        And what share of its length each window has, shape (K, 2).
        """
        values, filled = [], []
        for memories, centred in WINDOWS:
            means, updates = self._means(at, memories, centred)
            values.append(mean_quantities(means))
            filled.append(updates / (memories * self.pipeline.memory))
        return np.stack(values, axis=1), np.stack(filled, axis=1)

    def excess(self, seen: MotionRange, at: slice) -> FloatArray:
        """Return `motion_excess` at evaluations, shape (K, 4)."""
        chunks = outofcore.iter_chunks(*at.indices(len(self.sums) - 1)[:2], self.sums, at_once=AT_ONCE)
        parts = [motion_excess(self.pipeline, seen, *self.quantities(rows)) for rows in chunks]
        return np.concatenate(parts) if parts else np.empty((0, len(QUANTITIES)))

    def tells(self, change: FloatArray, covariance: FloatArray, at: slice) -> BoolArray:
        """Return where a change of coefficients (K, n) is larger than uncertain ones of a covariance (K, n, n) explain.

        Both as forces in the motion at evaluations, along the change: `MIN_CHANGE_STDS` standard deviations.
        """
        means, n = self._means(at, *WINDOWS[0])[0], change.shape[1]
        force = np.einsum("kij,kj->ki", means[:, SIGNALS * MOMENTS :].reshape(-1, n, n), change)
        error = np.einsum("ki,kij,kj->k", force, covariance, force)
        return np.asarray((force * change).sum(axis=1) ** 2 > MIN_CHANGE_STDS**2 * error)

    def model_error(self, seen: MotionRange, tuning: Tuning, at: slice) -> FloatArray:
        """Return `model_error_covariance` at evaluations, shape (K, n, n)."""
        means, _ = self._means(at, *WINDOWS[0])
        return model_error_covariance(self.pipeline, tuning, means, self.excess(seen, at))


def motion_columns(
    runners: Sequence[RegressionRunner], r: FloatArray, u: FloatArray, y: FloatArray, restart: BoolArray, origin: float
) -> FloatArray:
    """Return what is summed up over the samples of a block, (N, 1 + 6 + n n): see `RecordedMotion.sums`.

    `runners`: of `motion_pipelines`.
    """
    own, *kinematics = runners
    g = own.advance(r, u, y, restart)
    motion = [
        runner.advance(x, x, x, restart).phi for runner, x in zip(kinematics, (r - origin, y - origin), strict=True)
    ]
    n, edges = g.phi.shape[1], np.cumsum([1, *(x.shape[1] for x in motion)])
    columns = np.empty((len(r), edges[-1] + n * n))
    columns[:, 0] = 1.0
    for x, begin, end in zip(motion, edges, edges[1:], strict=False):
        np.square(x, out=columns[:, begin:end])
    np.multiply(g.phi[:, :, None], g.phi[:, None, :], out=columns[:, edges[-1] :].reshape(len(r), n, n))
    columns[~g.ok] = 0.0
    return columns


def motion_pipelines(pipeline: Pipeline) -> tuple[Pipeline, ...]:
    """Return what forms the plant's regressors, and the kinematics of r and of y."""
    return pipeline, *(pipeline.kinematics for _ in range(SIGNALS))


def mean_quantities(means: FloatArray) -> FloatArray:
    """Return `QUANTITIES` of r and of y, shape (K, 2, 4), from means over a window, (K, 6 + n n)."""
    squares = means[:, : SIGNALS * MOMENTS].reshape(-1, SIGNALS, MOMENTS)
    amplitude, speed, acceleration = np.moveaxis(np.sqrt(np.maximum(squares, 0.0)), -1, 0)
    frequency = np.divide(acceleration, 2.0 * np.pi * speed, out=np.zeros_like(speed), where=speed > 0.0)
    return np.stack([amplitude, speed, acceleration, frequency], axis=-1)


def motion_excess(pipeline: Pipeline, seen: MotionRange, values: FloatArray, filled: FloatArray) -> FloatArray:
    """Return how far each quantity is outside of what was seen, relative, negative below, shape (K, 4).

    r and y must both be outside, and on the same side: a fault changes y alone, and r alone moves nothing. `values`,
    `filled`: what `RecordedMotion.quantities` returns, of the first of `WINDOWS` or of all.
    """
    windows = values.shape[1]
    least, most = np.array(seen.least), np.array(seen.most)
    floor = MIN_MOTION_SHARE * most.max(axis=(0, 1)) + np.finfo(np.float64).tiny
    values, least, most = (np.maximum(x, floor) for x in (values, least[:windows], most[:windows]))
    above, below = ((values / most).min(axis=2) - 1.0, (least / values).min(axis=2) - 1.0)
    outside = np.where(above > 0.0, above, -np.maximum(below, 0.0))
    outside[filled < MIN_WINDOW_SHARE] = 0.0
    if 0 not in pipeline.loop.plant.powers:  # without stiffness one place is like another
        outside[..., 0] = 0.0
    larger = np.abs(outside).argmax(axis=1)[:, None]
    return np.asarray(np.take_along_axis(outside, larger, axis=1)[:, 0])


def model_error_covariance(pipeline: Pipeline, tuning: Tuning, means: FloatArray, excess: FloatArray) -> FloatArray:
    """Return the covariance that the model's error may add to theta_hat, shape (K, n, n).

    It is the bound of this module's first lines times the squared excess beyond `KIND_TOLERANCE`, up to 1. What the
    model leaves out of eta grows with the size of eta. `means`: over the first of `WINDOWS`, (K, 6 + n n); `excess`:
    (K, 4).
    """
    n, scale, theta = len(tuning.theta), tuning.scale, tuning.theta
    normal = means[:, SIGNALS * MOMENTS :].reshape(-1, n, n)
    healthy = tuning.R / pipeline.memory * np.linalg.inv(tuning.P_d)
    larger = np.maximum((normal @ theta @ theta) / (theta @ healthy @ theta), 1.0)
    growth = np.clip(np.abs(excess).max(axis=1) - KIND_TOLERANCE, 0.0, 1.0) ** 2
    units = np.outer(scale, scale)
    inverse = np.linalg.inv(normal / units + MIN_DIRECTION_SHARE * np.eye(n)) / units
    return np.asarray((tuning.R * larger * growth)[:, None, None] * inverse)


def learn_motion(pipeline: Pipeline, recordings: Sequence[Recording]) -> MotionRange | None:
    """Return which motion healthy recordings hold; None where none is as long as the shortest window."""
    origin = float(np.average([rec.y.mean() for rec in recordings], weights=[rec.samples for rec in recordings]))
    stretches: list[FloatArray] = []
    for recording in recordings:
        motion = RecordedMotion.from_recording(pipeline, recording, origin)
        values, filled = motion.quantities(slice(None))
        full = filled[:, 0] >= min(1.0, filled[:, 0].max(initial=0.0))
        if full.any() and filled[:, 0].max() >= MIN_WINDOW_SHARE:
            stretches.append(values[full])
    if not stretches:
        return None
    values = np.concatenate(stretches)
    least, most = (to_tuples(x) for x in (values.min(axis=0), values.max(axis=0)))
    return MotionRange(origin=origin, least=least, most=most)
