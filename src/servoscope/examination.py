"""One recording against one baseline: statistic, verdict, onset, and what a fault would have to be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from servoscope import ifrf
from servoscope.baseline import Baseline
from servoscope.candidates import candidates_of
from servoscope.detection import Onset, noncentrality, onset, required_noncentrality, statistic
from servoscope.diagnosis import (
    UNKNOWN,
    Candidate,
    Diagnosis,
    FoundFault,
    Parameter,
    ResponsePoint,
    Trace,
    Verdict,
    Warning,
)
from servoscope.errors import RecordingError
from servoscope.identification import MOST_SATURATED, fault_directions, saturated
from servoscope.isolation import isolate
from servoscope.pipeline import Estimates, Pipeline, Tuning
from servoscope.recording import Recording
from servoscope.sentence import summary
from servoscope.signatures import Expectation, Noise, course

SURE = 0.95  # probability from which a fault is named
MOST_REFUSED = 0.2  # share of updates that the instrument's guard may skip before the AKF takes over
WORTH_TELLING = 0.01  # share of them that is warned about
FALL_BACK = {"estimator": "akf"}
NO_PROMISE = 10.0  # relative change; who sees nothing smaller sees nothing
LOUDER = 1.5  # growth of the noise's variance from which it is believed
WEAKER = 3.0  # a recording that sees only changes this much larger than promised is called undetermined


@dataclass(frozen=True, eq=False)
class Examination:
    """Everything about one recording that its diagnosis is made of; build it with `of`."""

    baseline: Baseline
    recording: Recording
    pipeline: Pipeline
    tuning: Tuning
    estimates: Estimates
    expectation: Expectation | None
    trace: Trace
    refused: float  # share of the updates that the instrument's guard skipped
    growth: float  # of the noise's variance against the baseline's

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
        estimates = pipeline.estimate(tuning, recording)
        refused = _refused(estimates)
        if refused > MOST_REFUSED:
            fallen = loop.model_copy(update={"monitor": loop.monitor.model_copy(update=FALL_BACK)})
            pipeline = Pipeline.of(fallen, baseline.stage_one, baseline.still_speed)
            estimates = pipeline.estimate(tuning, recording)
        expectation, growth = None, 1.0
        expected = np.broadcast_to(tuning.theta, estimates.theta.shape)
        if baseline.noise is not None:
            growth = _noise_growth(pipeline, estimates)
            louder = float(np.sqrt(growth))
            noise = Noise(u_std=louder * baseline.noise.u_std, y_std=louder * baseline.noise.y_std)
            expectation = Expectation(pipeline, tuning, noise, course(recording))
            expected = expectation.healthy(baseline.plant, np.array(baseline.model_theta))
        covariance = growth * estimates.S + baseline.cov()
        ready = estimates.updates > 0
        T2 = np.where(ready, statistic(estimates.theta, expected, covariance), 0.0)
        frequencies = loop.monitor.frequencies
        trace = Trace(
            t=recording.t[estimates.index],
            names=pipeline.bank.names,
            theta=estimates.theta,
            covariance=covariance,
            expected=expected,
            statistic=T2,
            threshold=baseline.limit,
            ifrf=ifrf.response(pipeline.bank, frequencies, estimates.theta, covariance),
            ifrf_expected=ifrf.response(
                pipeline.bank, frequencies, expected, np.broadcast_to(baseline.cov(), covariance.shape)
            ),
            ready=ready,
        )
        return cls(baseline, recording, pipeline, tuning, estimates, expectation, trace, refused, growth)

    def diagnosis(self, progress: Callable[[str], None] = lambda _: None) -> Diagnosis:
        """Return the verdict; `progress` is told what is being done."""
        trace, recording = self.trace, self.recording
        warnings = [Warning.of(defect) for defect in recording.defects] + self._doubts()
        alarms = np.flatnonzero(trace.ready & (trace.statistic > trace.threshold))
        detected_at, since, probability = None, None, None
        seen: dict[str, tuple[float, float]] = {}
        candidates: tuple[Candidate, ...] = ()
        faults: tuple[FoundFault, ...] = ()
        verdict: Verdict
        if alarms.size:
            verdict = "fault"
            first = int(alarms[0])
            # the last evaluation has forgotten most of the healthy past; where the alarm has gone, the strongest one
            at = len(trace.t) - 1 if trace.statistic[-1] > trace.threshold else int(np.argmax(trace.statistic))
            detected_at = float(trace.t[first])
            progress("onset")
            since = self._onset(first, at)
            candidates = isolate(
                candidates_of(self.baseline, recording, self.expectation, since.sample, int(self.estimates.index[at])),
                trace.theta[at] - trace.expected[at],
                self.estimates.S[at] * max(1.0, float(self.estimates.power[at])) + self.baseline.cov(),
                lambda: progress("isolation"),
            )
            probability = candidates[0].probability
            if probability >= SURE and candidates[0].name != UNKNOWN:
                faults = candidates[0].faults
        else:
            seen = self._seen()
            blind = self._blind_to(seen)
            verdict = "undetermined" if blind else "healthy"
            span = float(recording.t[0]), float(recording.t[-1])
            warnings += [Warning(kind="power", from_s=span[0], to_s=span[1], count=1, message=text) for text in blind]
        onset_s = (since.low_s, since.likely_s, since.high_s) if since is not None else None
        return Diagnosis(
            recording=recording.name,
            samples=recording.samples,
            duration_s=recording.duration_s,
            verdict=verdict,
            summary=summary(verdict, faults, candidates, self._since(since), seen, warnings),
            detected_at_s=detected_at,
            onset_s=onset_s,
            probability=probability,
            faults=faults,
            candidates=candidates,
            parameters=self._parameters(),
            ifrf=self._ifrf(),
            warnings=tuple(sorted(warnings, key=lambda warning: warning.from_s)),
        )

    def _onset(self, first: int, at: int) -> Onset:
        index = self.estimates.index
        return onset(
            self.pipeline,
            self.tuning,
            self.recording,
            self.estimates,
            self.trace.expected[at],
            self.trace.theta[at],
            int(index[first]),
            int(index[at]),
        )

    def _since(self, found: Onset | None) -> str:
        if found is None:
            return ""
        start = float(self.recording.t[0])
        if found.likely_s - start <= 3.0 * self.pipeline.bank.wait / self.recording.sample_rate:
            return "since the start of the recording or before"
        return f"since {found.likely_s:.1f} s"

    def _seen(self) -> dict[str, tuple[float, float]]:
        """Return, by parameter, the smallest change that would have shown here, and what the baseline promises."""
        promised = {
            p.parameter: p.change for p in self.baseline.promises if p.change is not None and p.change < NO_PROMISE
        }
        directions = fault_directions(self.baseline.loop, self.baseline.plant, self.tuning.theta)
        rows = np.array([directions[parameter] for parameter in promised])
        best = np.zeros(len(rows))
        if len(rows) and self.trace.ready.any():
            ok = self.trace.ready
            best = noncentrality(self.trace.covariance[ok], self.estimates.Psi[ok], rows).max(axis=0)
        needed = required_noncentrality(self.pipeline.bank.n, self.baseline.limit)
        smallest = (float(np.sqrt(needed / one)) if one > 0.0 else np.inf for one in best)
        return dict(zip(promised, zip(smallest, promised.values(), strict=True), strict=True))

    def _blind_to(self, seen: dict[str, tuple[float, float]]) -> list[str]:
        """Return what this recording could not have shown although the baseline promises it."""
        if (share := saturated(self.baseline.loop, self.recording)) > MOST_SATURATED:
            return [f"u is at a limit in {share:.0%} of the rows: nothing would have shown"]
        if not seen:
            return ["the baseline promises to see no change at all: learn it from recordings with more motion"]
        if all(np.isinf(smallest) for smallest, _ in seen.values()):
            return ["too short or too little motion: no change of any size would have shown"]
        return [
            f"too short or too little motion: a change of {parameter} would show "
            f"{'not at all' if np.isinf(smallest) else f'only from {smallest:.0%} on'}, promised is {promise:.0%}"
            for parameter, (smallest, promise) in seen.items()
            if smallest > WEAKER * promise
        ]

    def _doubts(self) -> list[Warning]:
        """Return warnings about the estimate itself."""
        doubts = []
        e, t = self.estimates, self.recording.t
        if self.refused > WORTH_TELLING:
            instead = ", so estimator = 'akf' was used instead" if self.refused > MOST_REFUSED else ""
            message = f"the instrument was too weak for {self.refused:.0%} of the updates{instead}"
            span = float(t[0]), float(t[-1])
            doubts.append(Warning(kind="instrument", from_s=span[0], to_s=span[1], count=1, message=message))
        if self.growth > 1.0:
            message = (
                f"{np.sqrt(self.growth):.2g} times the baseline's noise: look at the sensor and its cable; the healthy "
                "expectation was computed with it"
            )
            doubts.append(Warning(kind="noise", from_s=float(t[0]), to_s=float(t[-1]), count=1, message=message))
        if len(e.updates) and e.updates[-1] > 0:
            last = int(e.index[int(np.searchsorted(e.updates, e.updates[-1]))])
            if t[-1] - t[last] > self.baseline.loop.monitor.memory:
                message = "at rest or in the dead zone to the end: nothing is known about this time"
                doubts.append(
                    Warning(kind="rest", from_s=float(t[last]), to_s=float(t[-1]), count=len(t) - last, message=message)
                )
        return doubts

    def _parameters(self) -> dict[str, Parameter]:
        if not len(self.trace.t):
            return {}
        theta, expected = self.trace.theta[-1], self.trace.expected[-1]
        std = np.sqrt(np.diag(self.trace.covariance[-1]))
        return {
            name: Parameter(value=float(value), std=float(s), nominal=float(nominal))
            for name, value, s, nominal in zip(self.trace.names, theta, std, expected, strict=True)
        }

    def _ifrf(self) -> tuple[ResponsePoint, ...]:
        if not len(self.trace.t):
            return ()
        now, healthy = self.trace.ifrf, self.trace.ifrf_expected
        std = np.sqrt(np.diagonal(now.covariance[-1], axis1=-2, axis2=-1))
        return tuple(
            ResponsePoint(
                frequency_hz=float(f),
                real=float(H.real),
                imag=float(H.imag),
                real_std=float(s[0]),
                imag_std=float(s[1]),
                nominal_real=float(H0.real),
                nominal_imag=float(H0.imag),
            )
            for f, H, s, H0 in zip(now.frequencies, now.H[-1], std, healthy.H[-1], strict=True)
        )


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
