"""One recording against one baseline: what the recursion says, what a healthy loop would have shown, the statistics."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from servoscope import ifrf
from servoscope.baseline import Baseline
from servoscope.detection import delayed, statistic
from servoscope.diagnosis import Trace
from servoscope.errors import RecordingError
from servoscope.pipeline import Estimates, Pipeline, Tuning
from servoscope.plants import FloatArray
from servoscope.recording import Recording
from servoscope.signatures import Expectation, course

MOST_REFUSED = 0.2  # share of updates that the instrument's guard may skip before the AKF takes over
FALL_BACK = {"estimator": "akf"}
LOUDER = 1.5  # growth of the noise's variance from which it is believed


@dataclass(frozen=True, eq=False)
class Compared:
    """What is compared at every evaluation.

    Parameters
    ----------
    theta
        Estimate without its bias, shape (K, n).
    covariance
        Of it, shape (K, n, n).
    expected, expected_covariance
        What a healthy loop would show, without its bias too, shapes (K, n) and (n, n).
    statistic
        T^2 of the estimate as it is against its expectation as it is, shape (K,).
    """

    theta: FloatArray
    covariance: FloatArray
    expected: FloatArray
    expected_covariance: FloatArray
    statistic: FloatArray


def trace_of(
    baseline: Baseline, pipeline: Pipeline, e: Estimates, t: FloatArray, seen: Compared, clock: FloatArray | None = None
) -> Trace:
    """Put a trace together: responses from coefficients, alarms from both tests.

    Parameters
    ----------
    baseline, pipeline
        What the recording was compared with, and by which recursion.
    e
        Its estimates.
    t
        Times of the evaluations [s], shape (K,).
    seen
        What was compared.
    clock
        Times of all samples [s]; None: uniform from 0.
    """
    ready = e.updates > 0
    respond = pipeline.bank, baseline.loop.monitor.frequencies
    crossed = np.maximum(e.crossed.astype(np.int64) - 1, 0)
    at = crossed / baseline.loop.sample_rate if clock is None else clock[crossed]
    return Trace(
        t=t,
        names=pipeline.bank.names,
        theta=seen.theta,
        covariance=seen.covariance,
        expected=seen.expected,
        statistic=np.where(ready, seen.statistic, 0.0),
        threshold=baseline.limit,
        level=e.level,
        crossed=np.where(e.crossed > 0, at, np.nan),
        ifrf=ifrf.response(*respond, seen.theta, seen.covariance),
        ifrf_expected=ifrf.response(
            *respond, seen.expected, np.broadcast_to(seen.expected_covariance, seen.covariance.shape)
        ),
        ready=ready,
    )


@dataclass(frozen=True, eq=False)
class Examination:
    """Everything about one recording that its diagnosis is made of; build it with `of`.

    Parameters
    ----------
    expectation
        None where the loop cannot be simulated.
    expected
        theta_hat of a healthy loop, biases included, shape (K, n).
    covariance
        Of theta_hat minus that, shape (K, n, n).
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
    expectation: Expectation | None
    expected: FloatArray
    covariance: FloatArray
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
        pipeline, tuning = baseline.pipeline(), baseline.tuning
        own = Expectation(pipeline, tuning, baseline.noise, course(recording)) if baseline.noise else None
        estimates = pipeline.estimate(tuning, recording, baseline.watch(pipeline, own))
        refused = _refused(estimates)
        if refused > MOST_REFUSED:
            fallen = loop.model_copy(update={"monitor": loop.monitor.model_copy(update=FALL_BACK)})
            pipeline = Pipeline.of(fallen, baseline.stage_one, baseline.still_speed)
            estimates = pipeline.estimate(tuning, recording, baseline.watch(pipeline, own))
        expectation, growth = None, 1.0
        expected = np.broadcast_to(tuning.theta, estimates.theta.shape)
        if own is not None:
            growth = _noise_growth(pipeline, estimates)
            if growth > 1.0:  # the sequential test takes louder noise for steps of a change
                deafer = pipeline.estimate(tuning, recording, baseline.watch(pipeline, own, growth))
                estimates = replace(estimates, level=deafer.level, crossed=deafer.crossed)
            expectation = replace(own, pipeline=pipeline, noise=own.noise.times(np.sqrt(growth)))
            expected = expectation.healthy(baseline.plant, np.array(baseline.model_theta))
        covariance = growth * estimates.S + baseline.cov()
        T2 = np.where(estimates.updates > 0, statistic(estimates.theta, expected, covariance), 0.0)
        return cls(
            baseline=baseline,
            recording=recording,
            pipeline=pipeline,
            tuning=tuning,
            estimates=estimates,
            expectation=expectation,
            expected=expected,
            covariance=covariance,
            statistic=T2,
            refused=refused,
            growth=growth,
        )

    @property
    def t(self) -> FloatArray:
        """Times of the evaluations [s], shape (K,)."""
        return self.recording.t[self.estimates.index]

    @property
    def ready(self) -> npt.NDArray[np.bool_]:
        """Whether the estimator had learned anything by then, shape (K,)."""
        return self.estimates.updates > 0

    @property
    def alarm(self) -> npt.NDArray[np.bool_]:
        """Whether there was an alarm: one of the two tests above its limit, after the delays, shape (K,)."""
        exceeded = self.ready & ((self.statistic > self.baseline.limit) | (self.estimates.level >= 1.0))
        return delayed(exceeded, *self.pipeline.delays)


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
