"""What a diagnosis says, as data: verdict, faults with sizes, candidates, warnings; one JSON object per recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from servoscope.ifrf import Response
from servoscope.plants import FloatArray
from servoscope.recording import Defect

Verdict = Literal["healthy", "fault", "undetermined"]
UNKNOWN = "unknown"
SEVERITY = "severity"  # the parameter of a fault that was learned from labelled recordings


class _Said(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class FoundFault(_Said):
    """A fault with its size: `ratio` of `parameter` to its healthy value, and the 95 % interval of it.

    The parameter of a fault learned from labelled recordings is ``severity``: there `ratio` is to the labelled one.
    """

    name: str
    parameter: str
    ratio: float
    interval: tuple[float, float]

    @property
    def learned(self) -> bool:
        """Whether it is known from labelled recordings, so that `ratio` is a share of their severity."""
        return self.parameter == SEVERITY

    @property
    def change(self) -> float:
        """How far from healthy it is: of the parameter's healthy value, or of the labelled severity."""
        return self.ratio if self.learned else abs(self.ratio - 1.0)


class Candidate(_Said):
    """One explanation of a detected change; ``unknown`` carries no faults.

    `misfit` is the sum of squared standard deviations by which it fits worse than the best one; None for ``unknown``.
    `covariance` is that of the logarithms of its ratios, shape (k, k), where two faults were estimated together.
    `cosine` is that of the angle between the deviation and the direction of a fault learned from labelled recordings,
    in units of the misfit's covariance: 1 the same way, 0 elsewhere, -1 the opposite way; None for other faults.
    """

    name: str
    probability: float
    faults: tuple[FoundFault, ...] = ()
    misfit: float | None = None
    covariance: tuple[tuple[float, ...], ...] | None = None
    cosine: float | None = None

    @property
    def is_learned(self) -> bool:
        """Whether it is a fault learned from labelled recordings."""
        return any(fault.learned for fault in self.faults)


class Mimic(_Said):
    """A cause outside the list of faults that explains the recording as well, or better where the answer is unknown.

    `value` is a ratio to the healthy value, or a size in `unit`.
    """

    name: str
    words: str
    value: float
    unit: str

    @property
    def size(self) -> str:
        """Its value with its unit, a ratio as a factor."""
        return f"x {self.value:.4g}" if self.unit == "ratio" else f"{self.value:.3g} {self.unit}"


class Refit(_Said):
    """The refit of the seconds around the onset, from which the diagnosis's onset and candidates are.

    Parameters
    ----------
    from_s, to_s
        What it looked at.
    over_s
        How long the change grew; 0 where that is not told from a step, being shorter than the onset's interval.
    noise
        Standard deviation of the innovations, as a multiple of the baseline's.
    misfit, limit
        What the best candidate leaves unexplained, and the limit that a true one passes in one of a thousand cases.
    recursive
        What the recursion alone, with its memory, says at its last evaluation.
    mimics
        What else it could be.
    """

    from_s: float
    to_s: float
    over_s: float
    noise: float
    misfit: float
    limit: float
    recursive: tuple[Candidate, ...]
    mimics: tuple[Mimic, ...]


class Parameter(_Said):
    """A coefficient at the end of the recording: value, standard deviation, and what a healthy loop would show."""

    value: float
    std: float
    nominal: float


class ResponsePoint(_Said):
    """The iFRF at one monitored frequency at the end of the recording."""

    frequency_hz: float
    real: float
    imag: float
    real_std: float
    imag_std: float
    nominal_real: float
    nominal_imag: float


class Warning(_Said):
    """Something about the recording that the reader should know."""

    kind: str
    from_s: float
    to_s: float
    count: int
    message: str

    @classmethod
    def of(cls, defect: Defect) -> Warning:
        """Turn a recording's defect into a warning."""
        return cls(
            kind=defect.kind,
            from_s=defect.from_s,
            to_s=defect.to_s,
            count=defect.count,
            message=defect.message,
        )


class Diagnosis(_Said):
    """The verdict on one recording.

    Parameters
    ----------
    recording, samples, duration_s
        What was looked at.
    verdict
        ``undetermined`` when the recording excites too little or is too short to show a change of the size that the
        baseline promises.
    summary
        The verdict in one sentence.
    detected_at_s
        First evaluation above the threshold.
    onset_s
        Since when: lower end, most likely, upper end of the 95 % interval.
    probability
        Of the first candidate; None when nothing was detected.
    faults
        Named faults; empty when healthy and when no candidate reaches probability 0.95.
    candidates
        Explanations, the most probable first.
    explanation
        Why, in sentences: what moved, what was rejected.
    refit
        What the candidates rest on; None where the recursion alone speaks.
    parameters, ifrf
        At the end of the recording.
    warnings
        Defects and doubts.
    point
        Operating point that the recording was judged at; None where the baseline has none.
    """

    recording: str
    samples: int
    duration_s: float
    verdict: Verdict
    summary: str
    detected_at_s: float | None = None
    onset_s: tuple[float, float, float] | None = None
    probability: float | None = None
    faults: tuple[FoundFault, ...] = ()
    candidates: tuple[Candidate, ...] = ()
    explanation: tuple[str, ...] = ()
    refit: Refit | None = None
    parameters: dict[str, Parameter]
    ifrf: tuple[ResponsePoint, ...]
    warnings: tuple[Warning, ...] = ()
    point: str | None = None


@dataclass(frozen=True, eq=False)
class Trace:
    """What a monitor says over time, one row per evaluation.

    Parameters
    ----------
    t
        In s, shape (K,).
    names
        Of the n coefficients.
    theta, covariance
        Estimate and its covariance, shapes (K, n) and (K, n, n). Where the loop can be simulated, the biases of the
        regression are taken out: intersample behaviour and noise in the regressors.
    expected
        What a healthy loop would show at the same time under the same reference, shape (K, n).
    statistic
        T^2, shape (K,).
    threshold
        Alarm limit of the statistic; for a fleet one per asset, shape (assets, 1).
    level
        The sequential test: its largest CUSUM since the evaluation before, as a multiple of its limit, shape (K,).
        It alarms at 1; 0 throughout where there is no such test.
    crossed
        When a CUSUM passed its limit [s], NaN where none is above it, shape (K,).
    ifrf, ifrf_expected
        Responses at the monitored frequencies, of `theta` and of `expected`.
    ready
        Whether the estimator had learned anything by then, shape (K,).
    """

    t: FloatArray
    names: tuple[str, ...]
    theta: FloatArray
    covariance: FloatArray
    expected: FloatArray
    statistic: FloatArray
    threshold: float | FloatArray
    level: FloatArray
    crossed: FloatArray
    ifrf: Response
    ifrf_expected: Response
    ready: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]

    @property
    def exceeded(self) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Whether one of the two tests is above its limit, without on-delay and off-delay, shape (K,)."""
        return self.ready & ((self.statistic > self.threshold) | (self.level >= 1.0))

    @classmethod
    def stacked(cls, traces: Sequence[Trace]) -> Trace:
        """Return the traces of a fleet as one, assets first; t, names and frequencies are shared."""
        first = traces[0]

        def together(name: str) -> Any:
            return np.array([getattr(trace, name) for trace in traces])

        def responses(name: str) -> Response:
            each = [getattr(trace, name) for trace in traces]
            return Response(each[0].frequencies, np.array([e.H for e in each]), np.array([e.covariance for e in each]))

        return replace(
            first,
            threshold=together("threshold")[:, None],
            ifrf=responses("ifrf"),
            ifrf_expected=responses("ifrf_expected"),
            theta=together("theta"),
            covariance=together("covariance"),
            expected=together("expected"),
            statistic=together("statistic"),
            level=together("level"),
            crossed=together("crossed"),
            ready=together("ready"),
        )

    def table(self) -> dict[str, FloatArray]:
        """Return the columns of ``diagnose --trace``: t, theta_0 ..., ifrf_1Hz_real ..., statistic, threshold, level.

        The last is the sequential test's, which alarms at 1.
        """
        columns = {"t": self.t}
        for i in range(self.theta.shape[1]):
            columns[f"theta_{i}"] = self.theta[:, i]
        for i, f in enumerate(self.ifrf.frequencies):
            columns[f"ifrf_{f:g}Hz_real"] = self.ifrf.H[:, i].real
            columns[f"ifrf_{f:g}Hz_imag"] = self.ifrf.H[:, i].imag
        columns["statistic"] = self.statistic
        columns["threshold"] = np.full(len(self.t), self.threshold)
        columns["level"] = self.level
        return columns
