"""What a diagnosis says, as data: verdict, faults with sizes, candidates, warnings; one JSON object per recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from servoscope.ifrf import Response
from servoscope.plants import FloatArray
from servoscope.recording import Defect

Verdict = Literal["healthy", "fault", "undetermined"]
UNKNOWN = "unknown"


class _Said(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class FoundFault(_Said):
    """A fault with its size: `ratio` of `parameter` to its healthy value, and the 95 % interval of it."""

    name: str
    parameter: str
    ratio: float
    interval: tuple[float, float]


class Candidate(_Said):
    """One explanation of a detected change; ``unknown`` carries no faults."""

    name: str
    probability: float
    faults: tuple[FoundFault, ...] = ()


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
    parameters, ifrf
        At the end of the recording.
    warnings
        Defects and doubts.
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
    parameters: dict[str, Parameter]
    ifrf: tuple[ResponsePoint, ...]
    warnings: tuple[Warning, ...] = ()


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
        Estimate and its covariance, shapes (K, n) and (K, n, n).
    expected
        What a healthy loop would show at the same time under the same reference, shape (K, n).
    statistic
        T^2, shape (K,).
    threshold
        Alarm limit of the statistic; for a fleet one per asset, shape (assets, 1).
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
    ifrf: Response
    ifrf_expected: Response
    ready: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]

    def table(self) -> dict[str, FloatArray]:
        """Return the columns of ``diagnose --trace``: t, theta_0 ..., ifrf_1Hz_real ..., statistic, threshold."""
        columns = {"t": self.t}
        for i in range(self.theta.shape[1]):
            columns[f"theta_{i}"] = self.theta[:, i]
        for i, f in enumerate(self.ifrf.frequencies):
            columns[f"ifrf_{f:g}Hz_real"] = self.ifrf.H[:, i].real
            columns[f"ifrf_{f:g}Hz_imag"] = self.ifrf.H[:, i].imag
        columns["statistic"] = self.statistic
        columns["threshold"] = np.full(len(self.t), self.threshold)
        return columns
