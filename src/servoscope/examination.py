"""One recording against one baseline: what the recursion says, what a healthy loop would have shown, the statistics.

A recording of any length is walked through once, piece by piece; what is asked about single evaluations afterwards is
computed from the samples that they still remember.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope import sequential, spool
from servoscope.baseline import Baseline
from servoscope.detection import delayed, statistic
from servoscope.errors import RecordingError
from servoscope.noise import Noise
from servoscope.pipeline import Estimates, Estimating, Pipeline, Tuning
from servoscope.plants import FloatArray, Plant
from servoscope.recording import Recording
from servoscope.signatures import Course, Expectation, colour_of, course
from servoscope.simulation import closed_loop_poles

MOST_REFUSED = 0.2  # share of updates that the instrument's guard may skip before the AKF takes over
FALL_BACK = {"estimator": "akf"}
LOUDER = 1.5  # growth of the noise's variance from which it is believed
FORGOTTEN = 1e-9  # share of the past that is left when it counts as forgotten
MEMORIES = 22.0  # after which it usually is


@dataclass(frozen=True, eq=False)
class Examination:
    """Everything about one recording that its diagnosis is made of; build it with `of`.

    Parameters
    ----------
    noise
        Of the loop, as loud as in this recording; None where the loop cannot be simulated.
    expected
        theta_hat of a healthy loop, biases included, shape (K, n).
    statistic
        T^2, shape (K,).
    refused
        Share of the updates that the instrument's guard skipped.
    growth
        Of the noise's variance against the baseline's.
    """

    baseline: Baseline
    recording: Recording
    pipeline: Pipeline
    tuning: Tuning
    estimates: Estimates
    noise: Noise | None
    expected: FloatArray
    statistic: FloatArray
    refused: float
    growth: float

    @classmethod
    def of(cls, baseline: Baseline, recording: Recording) -> Examination:
        """Run the recursion over the recording and compare it with what a healthy loop would show.

        Raises
        ------
        RecordingError
            If the recording's sample rate is not the loop's.
        """
        loop = baseline.loop
        if abs(recording.sample_rate / loop.sample_rate - 1.0) > 0.01:
            raise RecordingError(
                f"{recording.name}: sampled at {recording.sample_rate:g} Hz, the baseline's loop at "
                f"{loop.sample_rate:g} Hz: learn a baseline at this rate"
            )
        x = _followed(baseline, recording, baseline.pipeline())
        refused = _refused(x.estimates)
        if refused > MOST_REFUSED:
            fallen = loop.model_copy(update={"monitor": loop.monitor.model_copy(update=FALL_BACK)})
            x = _followed(baseline, recording, Pipeline.of(fallen, baseline.stage_one, baseline.still_speed))
        growth = 1.0 if x.noise is None else _noise_growth(x.pipeline, x.estimates)
        if growth > 1.0:  # it moves what is expected, and the sequential test would take it for steps of a change
            x = _followed(baseline, recording, x.pipeline, growth)
        return replace(x, refused=refused)

    @property
    def evaluations(self) -> int:
        """Their number K."""
        return len(self.statistic)

    def t(self, at: Any) -> Any:
        """Return the times of some evaluations [s]."""
        return self.recording.t[self.estimates.index[at]]

    def covariance(self, at: Any) -> FloatArray:
        """Return the covariance of theta_hat minus its expectation at some evaluations, shape (..., n, n)."""
        return np.asarray(self.growth * self.estimates.S[at] + self.baseline.cov())

    @property
    def ready(self) -> npt.NDArray[np.bool_]:
        """Whether the estimator had learned anything by then, shape (K,)."""
        return self.estimates.updates > 0

    @cached_property
    def alarm(self) -> npt.NDArray[np.bool_]:
        """Whether there was an alarm: one of the two tests above its limit, after the delays, shape (K,)."""
        exceeded = self.ready & ((self.statistic > self.baseline.limit) | (self.estimates.level >= 1.0))
        return delayed(exceeded, *self.pipeline.delays)

    def recalled(self, at: int) -> int:
        """Return a sample before which all is forgotten in an evaluation: by the loop, the filters, the estimator.

        Whatever begins there gives the same evaluation as if it had begun with the recording, but for `FORGOTTEN`.
        """
        pipeline, tuning = self.pipeline, self.tuning
        end, turn = (at + 1) * pipeline.every, int(np.lcm(pipeline.every, pipeline.stride))
        settling = pipeline.bank.wait + (_settling(pipeline, self.baseline.plant) if self.noise is not None else 0)
        memories = MEMORIES
        while True:
            learning = end - round(memories * pipeline.memory * pipeline.stride)
            first = (learning - settling) // turn * turn
            if first <= 0:
                return 0
            estimating, Psi = Estimating(pipeline, tuning), np.eye(len(tuning.theta))[None]
            for rows in spool.pieces(learning, end):
                found = estimating.advance(self.recording.rows(rows)).Psi
                Psi = found if len(found) else Psi
            if np.abs(Psi[-1] * tuning.scale[:, None] / tuning.scale).max() <= FORGOTTEN:
                return first
            memories *= 2.0

    def expectation(self, first: int, end: int) -> Expectation:
        """Return what is expected under the reference of samples `first` to `end`, of a loop that can be simulated."""
        if self.noise is None:
            raise ValueError("a loop that cannot be simulated expects nothing")
        return Expectation(self.pipeline, self.tuning, self.noise, course(self.recording.rows(slice(first, end))))

    def path(self, at: slice, plant: Plant, since: int) -> FloatArray:
        """Return the expected theta_hat at some evaluations, shape (K, n), where the plant turns ill at a sample."""
        first, start = self.recalled(at.start), np.array(self.baseline.model_theta)
        walk = self.expectation(first, first + 1).walk(start, self.baseline.plant, plant, max(since - first, 0))
        return self._gathered(at, first, lambda rows: walk.advance(_course(self.recording, rows, first)))

    def spread(self, at: slice, plant: Plant) -> FloatArray:
        """Return the covariance of theta_hat at some evaluations, shape (K, n, n), under another plant's noise.

        A changed actuator passes the sensor's noise on in another way, and its estimates scatter accordingly.
        """
        coloured = replace(self.tuning, noise=colour_of(self.pipeline, plant, self.expectation(0, 1).noise))
        estimating = Estimating(self.pipeline, coloured)
        return self._gathered(at, self.recalled(at.start), lambda rows: estimating.advance(self.recording.rows(rows)).S)

    def _gathered(self, at: slice, first: int, advance: Callable[[slice], FloatArray]) -> FloatArray:
        """Return what is said at some evaluations, walking from sample `first` on."""
        every, n = self.pipeline.every, len(self.tuning.theta)
        found = np.empty((0, n))
        k = first // every - at.start
        for rows in spool.pieces(first, at.stop * every):
            said = advance(rows)
            if not len(found):
                found = spool.empty((at.stop - at.start, *said.shape[1:]))
            found[max(k, 0) : max(k + len(said), 0)] = said[max(-k, 0) :]
            k += len(said)
            spool.release(found, *self.recording.columns)
        return found


def _settling(pipeline: Pipeline, plant: Plant) -> int:
    """Return how many samples a loop takes to forget where it began."""
    slowest = float(np.abs(closed_loop_poles(pipeline.loop, plant)).max())
    return int(np.ceil(np.log(FORGOTTEN) / np.log(slowest))) if 0.0 < slowest < 1.0 else 0


def _course(recording: Recording, rows: slice, first: int) -> Course:
    """Return the reference of a piece of a walk that began at sample `first`."""
    before = rows.start - 1
    ahead = (float(recording.t[before]), float(recording.r[before])) if rows.start > first else None
    return course(recording.rows(rows), ahead)


def _followed(baseline: Baseline, recording: Recording, pipeline: Pipeline, growth: float = 1.0) -> Examination:
    """Walk through a recording once: the estimates, and beside them what a healthy loop would show."""
    tuning, C, noise, walk = baseline.tuning, baseline.cov(), None, None
    if baseline.noise is None:
        watch = baseline.watch(pipeline)
    else:
        noise = baseline.noise.times(np.sqrt(growth))
        beginning = recording.rows(slice(0, round(sequential.span(pipeline) * recording.sample_rate)))
        expectation = Expectation(pipeline, tuning, noise, course(beginning))
        watch = baseline.watch(pipeline, expectation, growth)
        walk = expectation.walk(np.array(baseline.model_theta), baseline.plant)

    def healthy(rows: slice) -> FloatArray:
        if walk is None:
            return tuning.theta
        return np.asarray(walk.advance(_course(recording, rows, 0)) + (tuning.theta - np.array(baseline.model_theta)))

    estimating, columns = Estimating(pipeline, tuning, watch), defaultdict[str, spool.Growing](spool.Growing)

    def keep(e: Estimates, shown: Future[FloatArray]) -> None:
        expected = np.broadcast_to(shown.result(), e.theta.shape)
        T2 = np.where(e.updates > 0, statistic(e.theta, expected, growth * e.S + C), 0.0)
        for name, piece in {**vars(e), "expected": expected, "statistic": T2}.items():
            columns[name].append(piece)

    with ThreadPoolExecutor(1) as beside:  # it does one thing after the other, in order
        kept: Future[None] | None = None
        for rows in spool.pieces(0, recording.samples):
            shown = beside.submit(healthy, rows)
            e = estimating.advance(recording.rows(rows))
            if kept is not None:
                kept.result()
            kept = beside.submit(keep, e, shown)
            spool.release(*recording.columns)
        if kept is not None:
            kept.result()
    found = {name: column.whole() for name, column in columns.items()}
    expected, T2 = found.pop("expected"), found.pop("statistic")
    estimates = Estimates(**found)
    return Examination(baseline, recording, pipeline, tuning, estimates, noise, expected, T2, 0.0, growth)


def _noise_growth(pipeline: Pipeline, estimates: Estimates) -> float:
    """Return how much louder the noise is than the baseline's (variance), 1 where it is not.

    Noise moves the expected estimate (errors in variables), so a failing sensor would look like an ailing plant. A
    low quantile over time tells it from a fault, whose residual stands out only until the estimate has followed.
    """
    settled = estimates.power[estimates.updates > 3.0 * pipeline.memory]
    if not len(settled):
        return 1.0
    growth = float(np.quantile(settled, 0.1))
    return growth if growth > LOUDER else 1.0


def _refused(estimates: Estimates) -> float:
    if not len(estimates.updates):
        return 0.0
    refused, updated = float(estimates.skipped[-1]), float(estimates.updates[-1])
    return refused / max(refused + updated, 1.0)
