"""Covariates in a running monitor: their averages block by block, and what is healthy at them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.covariates import CovariateAverage, CovariateModel, hold_last
from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.errors import RecordingError
from servoscope.core.messages import message
from servoscope.detection.statistic import t2_statistic
from servoscope.detection.trace import Trace
from servoscope.detection.warm_up import COURSE_CHANNELS
from servoscope.estimation.frequency_response import frequency_response
from servoscope.signals import Recording, clean

# of each covariate: how long before the last sample [s], ascending in time, and the values then; shape (m,) each
CovariateHistory = Mapping[str, tuple[FloatArray, FloatArray]]


def fill_channels(
    channels: Mapping[str, FloatArray], before_s: FloatArray, history: CovariateHistory
) -> dict[str, FloatArray]:
    """Return channels, shape (N,) each, at times that end at 0, with what is known of those without any value."""
    absent = {name for name in history if name not in channels or not np.isfinite(channels[name]).any()}
    return {**channels, **{name: np.interp(before_s, *history[name]) for name in history if name in absent}}


def read_channels(
    names: Sequence[str], channels: Mapping[str, npt.ArrayLike], shape: tuple[int, ...]
) -> dict[str, FloatArray]:
    """Return the covariates of a block, NaN where there is no number; raise RecordingError where one is missing."""
    if (missing := next((name for name in names if name not in channels), None)) is not None:
        raise RecordingError(str(message("covariate.missing", covariate=missing)))
    covariates = {name: np.asarray(channels[name], dtype=np.float64) for name in names}
    if any(channel.shape != shape for channel in covariates.values()):
        raise RecordingError("covariates must have the shape of r")
    return {name: np.where(np.isfinite(channel), channel, np.nan) for name, channel in covariates.items()}


class CovariateMonitor:
    """Follows covariates block by block beside a recursion that starts at the coefficients of their first values."""

    def __init__(self, baseline: Baseline, model: CovariateModel) -> None:
        pipeline = baseline.pipeline()
        self.model, self._theta, self._bank = model, np.array(baseline.theta), pipeline.bank
        self._covariance = baseline.covariance_array()
        self.average = CovariateAverage(len(model.names), pipeline.memory_samples)
        # of a value without a new one, in samples
        self.hold = baseline.loop.monitor.covariate_hold_s * baseline.loop.sample_rate
        self.size = self.average.size + len(model.names)

    def start(self) -> FloatArray:
        """Return the state before the first sample: of the averages, then how old each value is, in samples."""
        return np.concatenate([self.average.start(), np.zeros(len(self.model.names))])

    def run(
        self,
        state: FloatArray,
        signals: tuple[FloatArray, FloatArray, FloatArray],
        restart: BoolArray,
        channels: Mapping[str, npt.ArrayLike],
    ) -> tuple[FloatArray, FloatArray | None]:
        """Feed r, u, y and channels of a block, shape (N,) each; return the averages (N, k); changes the state.

        Once, as soon as all are known, the coefficients (n,) to start from come too. An average is NaN before the first
        value, and where the newest value is too old.
        """
        covariates = read_channels(self.model.names, channels, signals[0].shape)
        of_average, age = np.split(state, [self.average.size])
        began, values = not np.isnan(of_average).any(), self.model.values(covariates)
        averages = self.average.run(of_average, values)
        averages[self._ages(age, values) > self.hold] = np.nan
        known = np.flatnonzero(~np.isnan(averages).any(axis=1))
        if began or not known.size:
            return averages, None
        return averages, self.model.theta(self._theta, self.model.clip(averages[known[0]]))

    def _ages(self, age: FloatArray, values: FloatArray) -> FloatArray:
        """Return how many samples ago each covariate had a value, shape (N, k); carries `age` (k,) on."""
        at = np.arange(len(values))[:, None]
        latest = np.maximum.accumulate(np.where(np.isnan(values), -1, at), axis=0)
        ages = np.where(latest >= 0, at - latest, age + at + 1.0)
        age[:] = ages[-1] if len(ages) else age
        return ages

    def latest(self, state: FloatArray) -> FloatArray:
        """Return the averages in a state, shape (k,); NaN where the newest value is too old."""
        of_average, age = np.split(state, [self.average.size])
        return np.where(age > self.hold, np.nan, self.average.latest(of_average))

    def history(self, state: FloatArray) -> CovariateHistory:
        """Return the newest value of each covariate that is not too old."""
        last, age = state[: len(self.model.names)], state[self.average.size :]
        return {
            name: (np.zeros(1), last[j : j + 1])
            for j, name in enumerate(self.model.names)
            if not np.isnan(last[j]) and age[j] <= self.hold
        }

    def expect(self, averages: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return how far healthy coefficients are moved, their further covariance, and where both are known.

        Shapes (K, n), (K, n, n) and (K,). `averages` of the covariates, shape (K, k). One that is not measured comes
        with its standard deviation behind it, shape (K, 2).
        """
        averages, std = np.split(averages, [len(self.model.names)], axis=1)
        known = np.isfinite(averages).all(axis=1) & self.model.is_inside(averages)
        c = np.where(known[:, None], self.model.clip(averages), self.model.origin)
        spread = self.model.theta_covariance(self._theta, c, np.where(known[:, None], std, 0.0) if std.size else None)
        return self.model.theta(self._theta, c) - self._theta, spread, known

    def compare(self, trace: Trace, averages: FloatArray) -> Trace:
        """Return evaluations compared with what is healthy at averages of the covariates, as `expect` takes them.

        Where these are not known, or outside of what was learned, none is ready.
        """
        moved, spread, known = self.expect(averages)
        expected, C, healthy = trace.expected + moved, trace.covariance + spread, trace.ifrf_expected
        ready = trace.ready & known
        return replace(
            trace,
            expected=expected,
            covariance=C,
            ifrf_expected=frequency_response(self._bank, healthy.frequencies, expected, self._covariance + spread),
            statistic=np.where(ready, t2_statistic(trace.theta, expected, C), 0.0),
            ready=ready,
        )


def window_recording(baseline: Baseline, name: str, signals: FloatArray) -> tuple[Recording, float]:
    """Return rows t, r, u, y and channels as a recording, whose time begins at 0, and the time of its beginning.

    Raises RecordingError if they cannot be used as one.
    """
    t, r, u, y, *covariates = signals
    names = baseline.logged_covariates if baseline.covariates is None or baseline.logged_covariates else COURSE_CHANNELS
    told = {name: np.where(np.isfinite(c), c, np.nan) for name, c in zip(names, covariates, strict=False)}
    hold_s, rate = baseline.loop.monitor.covariate_hold_s, baseline.loop.sample_rate
    if (
        baseline.covariates is not None
        and (stale := baseline.covariates.describe_stale(told, hold_s, rate)) is not None
    ):
        raise RecordingError(str(stale))
    # a thermometer may tell less often than the motion is sampled
    channels = {name: hold_last(c[:, None], c[~np.isnan(c)][:1])[:, 0] for name, c in told.items()}
    loop, start = baseline.loop, float(t[np.isfinite(t)][0]) if np.isfinite(t).any() else 0.0
    limits = loop.input_limits
    recording = clean(
        t - start, r, u, y, name=name, sample_rate=loop.sample_rate, limits=limits, channels=channels or None
    )
    return recording, start
