"""One recording against one baseline: the estimates, what a healthy loop would have shown, and the statistics."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.covariates import CovariatePath
from servoscope.baseline.expectation import Expectation, reference_path, reference_piece, residual_noise_model
from servoscope.baseline.motion import RecordedMotion
from servoscope.baseline.pressure_model import PressureEvidence
from servoscope.baseline.residual_model import StretchFit
from servoscope.core import outofcore
from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.errors import RecordingError
from servoscope.detection import cusum_design
from servoscope.detection.baseline_run import BaselineRun, baseline_run, cusum_constants, has_failed_instrument
from servoscope.detection.feature_evidence import FeatureEvidence
from servoscope.detection.louder_noise import noise_growth
from servoscope.detection.statistic import apply_alarm_delays, t2_statistic
from servoscope.detection.trace import UNSEEN_EXCESS, Statistic, any_exceeded, detection_statistics
from servoscope.detection.warm_up import follow_warm_up
from servoscope.estimation.noise_model import WhiteNoise
from servoscope.estimation.pipeline import Estimates, EstimationRunner, Pipeline, Tuning
from servoscope.isolation.axis_change import AxisChange, find_axis_change
from servoscope.models.plants import Plant
from servoscope.signals import Recording
from servoscope.simulation.stability import settling_samples

MAX_SKIPPED_SHARE = 0.2  # share of updates that an estimator's guard may skip before the AKF takes over
FALL_BACK = {"estimator": "akf"}
MAX_COVARIATE_T2 = 1.0  # T^2 of what covariates do within a recording, from which on no single plant explains it
AT_ONCE = 4096  # evaluations
FORGOTTEN_SHARE = 1e-9  # share of the past below which it counts as forgotten
MEMORIES = 22.0  # after which it usually is


@dataclass(frozen=True, eq=False)
class Examination:
    """Everything about one recording that its diagnosis is made from; see `from_recording`."""

    baseline: Baseline
    recording: Recording
    pipeline: Pipeline
    tuning: Tuning
    estimates: Estimates
    noise: WhiteNoise | None  # of the loop, at the level of this recording; None where the loop cannot be simulated
    expected: FloatArray  # theta_hat of a healthy loop, biases included, shape (K, n)
    statistic: FloatArray  # T^2, shape (K,)
    skipped_share: float  # share of the updates that the estimator's guard skipped
    noise_growth: float  # of the noise's variance against the baseline's
    apparent_change: AxisChange | None = None  # within the recording, where it is one of a motor axis
    along: CovariatePath | None = None  # what covariates make of the coefficients; None where none were learned
    replaced: bool = False  # whether the instrument of the nominal loop failed and the AKF took over
    quick: bool = False  # whether features are left out: of assets that are monitored, the monitor follows them

    @classmethod
    def from_recording(cls, baseline: Baseline, recording: Recording, *, quick: bool = False) -> Examination:
        """Run the recursion over the recording and compare it with what a healthy loop would show.

        `quick`: whether features and residual are left out, and the sequential test may be held against the baseline's
        own limits where neither these nor those for the recording's reference, which take far longer, raise an alarm.
        Raises RecordingError if the recording's sample rate is not the loop's.
        """
        loop = baseline.loop
        if abs(recording.sample_rate / loop.sample_rate - 1.0) > 0.01:
            raise RecordingError(
                f"{recording.name}: sampled at {recording.sample_rate:g} Hz, the baseline's loop at "
                f"{loop.sample_rate:g} Hz: learn a baseline at this rate"
            )
        along, pipeline = None, baseline.pipeline()
        if (model := baseline.covariates) is not None:
            memory, theta = pipeline.memory_samples, np.array(baseline.theta)
            if model.warm_up is None:
                along = CovariatePath.of(model, theta, recording.channels, memory)
            else:
                along = follow_warm_up(pipeline, model, theta, recording, memory)
            place = ", ".join(filter(None, [baseline.point, along.place]))
            # features are compared at the covariates of each span, and an axis at those of each sample
            moves = baseline.axis is not None and baseline.axis.moves is not None
            kept = "features", "residual", "pressures", *(["axis"] if moves else [])
            followed: dict[str, Any] = {"point": place, **{name: getattr(baseline, name) for name in kept}}
            baseline = baseline.at(dict(zip(model.names, along.averages[-1].tolist(), strict=True)))
            baseline = baseline.model_copy(update=followed)
        exam = _run_quickly(baseline, recording) if quick and along is None else None
        exam = exam or _run_recursion(baseline, recording, pipeline, along)
        skipped, own = exam.estimates.skipped_share, baseline.recursion.instrument is not None
        replaced = not own and has_failed_instrument(exam.pipeline, exam.tuning, recording)
        if replaced or skipped > MAX_SKIPPED_SHARE:
            other = loop.model_copy(update={"monitor": loop.monitor.model_copy(update=FALL_BACK)})
            pipeline = Pipeline.of(other, baseline.recursion.stage_one, baseline.recursion.still_speed)
            exam = _run_recursion(baseline, recording, pipeline, along)
        growth = 1.0 if exam.noise is None else noise_growth(exam.pipeline, exam.estimates)
        if growth > 1.0:  # it shifts the expectation, and the sequential test would take it for steps of a change
            exam = _run_recursion(baseline, recording, exam.pipeline, along, growth)
        change, exam = None, exam if along is None else replace(exam, along=along)
        if baseline.axis is not None and not exam.drifts:
            change = find_axis_change(baseline, recording)
        return replace(exam, skipped_share=skipped, replaced=replaced, apparent_change=change, quick=quick)

    @cached_property
    def drifts(self) -> bool:
        """Whether covariates move the healthy coefficients by as much as their uncertainty, and no refit follows."""
        axis = self.baseline.axis
        if self.along is None or not self.evaluations or (axis is not None and axis.moves is not None):
            return False
        theta = self.along.expected(self.estimates.index)
        C = np.broadcast_to(self.covariance(self.evaluations - 1), self.estimates.S.shape)
        return bool(t2_statistic(theta, np.broadcast_to(theta[-1], theta.shape), C).max() > MAX_COVARIATE_T2)

    def release(self) -> None:
        """Free the memory of a recording and of estimates that lie in files; they are read again where needed."""
        moved = () if self.motion is None else (self.motion.sums, self.motion.updates)
        estimated = (*vars(self.estimates).values(), self.statistic, self.expected)
        outofcore.release(*self.recording.columns, *estimated, *moved)

    @property
    def evaluations(self) -> int:
        """Their number K."""
        return len(self.statistic)

    def t(self, at: Any) -> Any:
        """Return the times of some evaluations [s]."""
        return self.recording.t[self.estimates.index[at]]

    def covariance(self, at: Any) -> FloatArray:
        """Return the covariance of theta_hat minus its expectation at some evaluations, shape (..., n, n)."""
        known = self.baseline.covariance_after(self.estimates.updates[at])
        return np.asarray(self.noise_growth * self.estimates.S[at] + known)

    @property
    def ready(self) -> BoolArray:
        """Whether the estimator had learned anything by then, shape (K,)."""
        return self.estimates.updates > 0

    @cached_property
    def statistics(self) -> tuple[Statistic, ...]:
        """The statistics that raise the alarm: T^2, the sequential test and, where they were learned, the features."""
        e, limit = self.estimates, self.baseline.thresholds.statistic
        features = self.features.at(e.index) if self.features is not None else None
        return detection_statistics(self.statistic, limit, e.level, self.ready, features)

    @cached_property
    def features(self) -> FeatureEvidence | None:
        """What the recording shows besides its coefficients; None where nothing was learned or it is `quick`."""
        model = self.baseline.features
        return None if model is None or self.quick else FeatureEvidence.of(model, self.recording)

    @cached_property
    def residual_ratios(self) -> FloatArray:
        """`ResidualModel.ratios`, and how far a fit is from healthy over its limit, shape (3,); NaN: no evidence."""
        if self.quick or (model := self.baseline.residual) is None:
            return np.full(3, np.nan)
        ratios, fit = model.ratios_of(self.pipeline, self.recording), self.whole_fit
        return np.append(ratios, np.nan if fit is None or np.isnan(ratios).all() else fit.t2 / model.fit_limit)

    @cached_property
    def whole_fit(self) -> StretchFit | None:
        """`ResidualModel.deviation_of_rows` of all rows; None where nothing was learned or it is `quick`."""
        model, rows, theta = None if self.quick else self.baseline.residual, slice(None), np.array(self.baseline.theta)
        return (
            None if model is None else model.deviation_of_rows(self.pipeline, self.recording, rows, theta, self.along)
        )

    @cached_property
    def pressures(self) -> PressureEvidence | None:
        """What logged pressures show; None where none were learned or logged, or it is `quick`."""
        model = None if self.quick else self.baseline.pressures
        return None if model is None else model.evidence(self.recording)

    @property
    def features_changed_s(self) -> float | None:
        """End of the span with which the features left their limit [s]; None where they did not."""
        span = self.features.changed if self.features is not None else None
        return None if span is None else float(self.recording.t[span.end - 1])

    @cached_property
    def apparent_alarm(self) -> BoolArray:
        """Whether a statistic of the coefficients was above its limit, after the delays, shape (K,)."""
        return self._changed(self.apparent_change) | self.recursion_alarm

    @cached_property
    def recursion_alarm(self) -> BoolArray:
        """Whether T^2 or the sequential test was above its limit, after the delays, shape (K,)."""
        return apply_alarm_delays(any_exceeded(self.statistics[:2]), *self.pipeline.delays)

    @cached_property
    def change(self) -> AxisChange | None:
        """The change within the recording; None where a motion never seen may explain it: its limit knows none."""
        if (change := self.apparent_change) is None:
            return None
        at = min(int(np.searchsorted(self.estimates.index, change.detected)), self.evaluations - 1)
        unseen, told = self.motion_excess(slice(at, at + 1)) >= UNSEEN_EXCESS, self._told[self._changed(change)]
        return None if unseen.any() and 2 * told.sum() <= len(told) else change  # one that lasts is told mostly

    @cached_property
    def _told(self) -> BoolArray:
        """Where an axis, whose terms are those of physics, is off by more than its extrapolation is, shape (K,)."""
        told, e = np.zeros(self.evaluations, dtype=np.bool_), self.estimates
        if self.motion is not None and self.baseline.axis is not None:
            for at in outofcore.iter_chunks(0, self.evaluations, e.theta, e.S, at_once=AT_ONCE):
                told[at] = self.motion.tells(e.theta[at] - self.expected[at], self.covariance(at), at)
        return told

    def _changed(self, change: AxisChange | None) -> BoolArray:
        """Return whether a change within the recording had been detected, or was not yet repaired, shape (K,)."""
        index = self.estimates.index
        if change is None:  # what is left of u speaks of the whole recording
            off = (self.residual_ratios > 1.0).any() or (self.pressures is not None and self.pressures.excess > 1.0)
            return np.asarray((index == index[-1:].sum()) & off)
        return change.holds(index)

    @cached_property
    def alarm(self) -> BoolArray:
        """Whether there was an alarm of the coefficients that a motion never seen does not explain, shape (K,)."""
        if not self.apparent_alarm.any() or self.motion is None:  # in this order: the motion takes a second reading
            return self.apparent_alarm
        exceeded = np.zeros(self.evaluations, dtype=np.bool_)
        e, limit = self.estimates, self.baseline.thresholds.statistic
        for at in outofcore.iter_chunks(0, self.evaluations, e.theta, e.S, at_once=AT_ONCE):
            C = self.covariance(at) + self.model_error(at)
            T2 = np.where(self.ready[at], t2_statistic(e.theta[at], self.expected[at], C), 0.0)
            # the sequential test knows no model error
            exceeded[at] = (limit < T2) | ((e.level[at] >= 1.0) & (self.motion_excess(at) < UNSEEN_EXCESS))
        exceeded = (exceeded | self._told) & any_exceeded(self.statistics[:2])
        self.release()
        return self._changed(self.change) | apply_alarm_delays(exceeded, *self.pipeline.delays)

    @property
    def explained(self) -> int:
        """The evaluation that an explanation is about; the last one has forgotten most of the healthy past.

        Where an alarm has gone, the one after its beginning at which T^2 is largest.
        """
        if not self.alarm.any() or self.alarm[-1]:
            return self.evaluations - 1
        first = int(self.alarm.argmax())
        return first + int(np.argmax(self.statistic[first:]))

    @cached_property
    def motion(self) -> RecordedMotion | None:
        """The motion; None where the model is known to hold under any."""
        seen = self.baseline.limited_motion
        return None if seen is None else RecordedMotion.from_recording(self.pipeline, self.recording, seen.origin)

    def motion_excess(self, at: slice) -> FloatArray:
        """Return how far the motion is outside of the baseline's at some evaluations, relative, shape (K,)."""
        seen = self.baseline.limited_motion
        if self.motion is None or seen is None:
            return np.zeros(len(self.statistic[at]))
        return np.asarray(np.abs(self.motion.excess(seen, at)).max(axis=1))

    def model_error(self, at: slice) -> FloatArray:
        """Return what a motion never seen adds to the covariance at some evaluations, shape (K, n, n)."""
        seen = self.baseline.limited_motion
        if self.motion is None or seen is None:
            return np.zeros_like(self.estimates.S[at])
        return self.motion.model_error(seen, self.tuning, at)

    def memory_start(self, at: int) -> int:
        """Return the sample before which loop, filters and estimator have forgotten everything in an evaluation.

        A recursion that starts there gives the same evaluation as one from the beginning, up to `FORGOTTEN_SHARE`.
        """
        pipeline, tuning = self.pipeline, self.tuning
        end, period = (at + 1) * pipeline.every, int(np.lcm(pipeline.every, pipeline.stride))
        settling, memories = pipeline.bank.wait, MEMORIES
        if self.noise is not None:
            settling += settling_samples(pipeline.loop, self.baseline.plant, FORGOTTEN_SHARE)
        while True:
            learning = end - round(memories * pipeline.memory * pipeline.stride)
            first = (learning - settling) // period * period
            if first <= 0:
                return 0
            estimating, Psi = EstimationRunner(pipeline, tuning), np.eye(len(tuning.theta))[None]
            for rows in outofcore.iter_chunks(learning, end):
                responses = estimating.advance(self.recording.rows(rows)).Psi
                Psi = responses if len(responses) else Psi
            if np.abs(Psi[-1] * tuning.scale[:, None] / tuning.scale).max() <= FORGOTTEN_SHARE:
                return first
            memories *= 2.0

    def expectation(self, first: int, end: int) -> Expectation:
        """Return the expectation under the reference of samples `first` to `end`, of a loop that can be simulated."""
        if self.noise is None:
            raise ValueError("a loop that cannot be simulated expects nothing")
        return Expectation(
            self.pipeline, self.tuning, self.noise, reference_path(self.recording.rows(slice(first, end)))
        )

    def expected_path(self, at: slice, plant: Plant, onset: int) -> FloatArray:
        """Return the expected theta_hat at some evaluations, shape (K, n), under a change of plant at a sample."""
        first, start = self.memory_start(at.start), np.array(self.baseline.healthy.theta)
        walk = self.expectation(first, first + 1).propagator(start, self.baseline.plant, plant, max(onset - first, 0))
        return self._collect(at, first, lambda rows: walk.advance(reference_piece(self.recording, rows, first)))

    def covariance_under(self, at: slice, plant: Plant) -> FloatArray:
        """Return the covariance of theta_hat at some evaluations, shape (K, n, n), under the noise of another plant.

        A changed actuator passes the sensor's noise on differently, and its estimates scatter accordingly.
        """
        coloured = replace(self.tuning, noise=residual_noise_model(self.pipeline, plant, self.expectation(0, 1).noise))
        estimating = EstimationRunner(self.pipeline, coloured)
        return self._collect(
            at, self.memory_start(at.start), lambda rows: estimating.advance(self.recording.rows(rows)).S
        )

    def _collect(self, at: slice, first: int, advance: Callable[[slice], FloatArray]) -> FloatArray:
        """Return the output of a recursion at some evaluations; it starts at sample `first`."""
        every, n = self.pipeline.every, len(self.tuning.theta)
        values = np.empty((0, n))
        k = first // every - at.start
        for rows in outofcore.iter_chunks(first, at.stop * every):
            piece = advance(rows)
            if not len(values):
                values = outofcore.empty((at.stop - at.start, *piece.shape[1:]))
            values[max(k, 0) : max(k + len(piece), 0)] = piece[max(-k, 0) :]
            k += len(piece)
            outofcore.release(values, *self.recording.columns)
        return values


def _run_quickly(baseline: Baseline, recording: Recording) -> Examination | None:
    """Return what `_run_recursion` does, with the baseline's own limits; None where others might raise an alarm."""
    run = baseline_run(baseline)
    exam = _run_recursion(baseline, recording, baseline.pipeline(), run=run)
    quiet = exam.estimates.level.max(initial=0.0) < run.sure_level
    return exam if quiet and exam.statistic.max(initial=0.0) <= baseline.thresholds.statistic else None


def _run_recursion(
    baseline: Baseline,
    recording: Recording,
    pipeline: Pipeline,
    along: CovariatePath | None = None,
    growth: float = 1.0,
    run: BaselineRun | None = None,
) -> Examination:
    """Read a recording once: the estimates, and in a second thread what a healthy loop would show.

    `run`: with the baseline's own sequential test; None: with limits for the recording's reference.
    """
    tuning, noise, walk, watch = baseline.tuning, baseline.healthy.noise, None, None
    noise = None if noise is None else noise.times(np.sqrt(growth))
    if run is not None:
        walk = None if run.mean is None else run.mean.again()
    elif noise is None:
        watch = cusum_constants(baseline, pipeline)
    else:
        beginning = recording.rows(slice(0, round(cusum_design.design_duration_s(pipeline) * recording.sample_rate)))
        expectation = Expectation(pipeline, tuning, noise, reference_path(beginning))
        watch = cusum_constants(baseline, pipeline, expectation, growth)
        walk = expectation.propagator(np.array(baseline.healthy.theta), baseline.plant)

    def healthy(rows: slice) -> FloatArray:
        if walk is None:
            return tuning.theta
        piece = reference_piece(recording, rows, 0)
        return np.asarray(walk.advance(piece) + (tuning.theta - np.array(baseline.healthy.theta)))

    started = tuning if along is None else replace(tuning, theta=along.start)
    estimating = EstimationRunner(pipeline, started, watch) if run is None else run.estimates.again()
    columns = defaultdict[str, outofcore.GrowableArray](outofcore.GrowableArray)

    def keep(e: Estimates, path: Future[FloatArray]) -> None:
        expected, covariance = np.broadcast_to(path.result(), e.theta.shape), baseline.covariance_after(e.updates)
        if along is not None:
            expected = expected + (along.expected(e.index) - tuning.theta)
            covariance = covariance + along.covariance(e.index)
        T2 = np.where(e.updates > 0, t2_statistic(e.theta, expected, growth * e.S + covariance), 0.0)
        for name, piece in {**vars(e), "expected": expected, "statistic": T2}.items():
            columns[name].append(piece)

    with outofcore.second_thread(recording.samples) as second:  # one thread, so that its tasks run in order
        kept: Future[None] | None = None
        for rows in outofcore.iter_chunks(0, recording.samples):
            path = second.submit(healthy, rows)
            e = estimating.advance(recording.rows(rows))
            if kept is not None:
                kept.result()
            kept = second.submit(keep, e, path)
            outofcore.release(*recording.columns)
        if kept is not None:
            kept.result()
    arrays = {name: column.to_array() for name, column in columns.items()}
    expected, T2 = arrays.pop("expected"), arrays.pop("statistic")
    return Examination(baseline, recording, pipeline, tuning, Estimates(**arrays), noise, expected, T2, 0.0, growth)
