"""What is kept of the monitor's evaluations: the newest one, and a history that is small enough to keep for years."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from servoscope.core.arrays import FloatArray
from servoscope.detection.trace import Trace
from servoscope.estimation.frequency_response import ResponseRow, response_rows

ResidualRow = tuple[float, float | None, float | None, float | None]


class EvaluationStatus(BaseModel):
    """The newest evaluation of an asset; statistics are multiples of their limits."""

    model_config = ConfigDict(frozen=True, populate_by_name=True)

    t: float | None = None  # [UTC s]; None: there was none yet
    statistic: float | None = None
    level: float | None = None
    features: float | None = None  # None: not learned
    peaks: tuple[float | None, float | None] = (None, None)  # largest of both in the block: what alarms go by
    # per frequency [Hz]: real and imaginary part of the iFRF's residual, and magnitude of the healthy iFRF
    residual: tuple[ResidualRow, ...] = ()
    exceeded: bool = False
    responses: tuple[ResponseRow, ...] = ()
    parameters: tuple[tuple[str, float, float, float], ...] = ()  # name, value, standard deviation, healthy value

    def to_json(self) -> dict[str, Any]:
        """Return it as stored: what is not known yet is left out."""
        return self.model_dump(mode="json", by_alias=True, exclude_unset=True)


def evaluation_status(trace: Trace, t: float) -> EvaluationStatus:
    """Return the status after a block of one asset with evaluations, the last of which was at `t` [UTC s]."""
    excess = np.nan_to_num(trace.statistic / trace.threshold)
    std = np.sqrt(np.maximum(np.diagonal(trace.covariance[-1]), 0.0))
    values = zip(trace.names, trace.theta[-1].tolist(), std.tolist(), trace.expected[-1].tolist(), strict=True)
    ready = bool(trace.ready[-1])
    responses = response_rows(trace.ifrf, trace.ifrf_expected, -1).tolist() if ready else []
    learned: dict[str, Any] = {} if trace.features is None else {"features": float(trace.features[-1])}
    return EvaluationStatus.model_construct(  # its values are checked where it is read
        **learned,
        t=t,
        statistic=float(excess[-1]),
        level=float(trace.level[-1]),
        peaks=(float(excess.max()), float(trace.level.max())),
        residual=ifrf_residual(trace, -1),
        exceeded=bool(trace.exceeded[-1]),
        responses=tuple(ResponseRow(*row) for row in responses if all(map(math.isfinite, row))),
        parameters=tuple(row for row in values if ready and all(map(math.isfinite, row[1:]))),
    )


class LatestEvaluation:
    """What is judged of the newest evaluation; what is only shown is written down when somebody asks for it.

    That takes longer than everything else of a block, and most evaluations are replaced before anybody looks.
    """

    def __init__(
        self,
        exceeded: bool = False,
        peaks: tuple[float | None, float | None] = (None, None),
        features: float | None = None,
        t: float | None = None,  # [UTC s]
        write: Callable[[], EvaluationStatus] = EvaluationStatus,
    ) -> None:
        self.exceeded, self.peaks, self.features, self.t = exceeded, peaks, features, t
        self._write = write

    @classmethod
    def from_trace(
        cls, trace: Trace, t: float, peaks: tuple[float, float], lane: int | None = None
    ) -> LatestEvaluation:
        """Return the last evaluation of a block, at `t` [UTC s]; `lane`: of which asset, of a fleet's trace."""
        own = () if lane is None else (lane,)
        features = None if trace.features is None else float(trace.features[*own, -1])

        def write() -> EvaluationStatus:
            return evaluation_status(trace if lane is None else trace.lane(lane), t)

        return cls(bool(trace.exceeded[*own, -1]), peaks, features, t, write)

    @classmethod
    def from_status(cls, status: EvaluationStatus) -> LatestEvaluation:
        """Return the evaluation that a checkpoint has written down."""
        return cls(status.exceeded, status.peaks, status.features, status.t, lambda: status)

    @property
    def status(self) -> EvaluationStatus:
        """As it is stored."""
        status = self._write()
        self._write = lambda: status  # the trace of a whole fleet is let go
        return status


@dataclass(frozen=True)
class HistoryState:
    """The period of the history that is under way."""

    period: int | None = None  # its number by the asset's clock; None before the first evaluation
    # largest T^2, as a multiple of its limit, and largest value of the sequential test, since the last row
    excess: float = 0.0
    level: float = 0.0


def update_history(
    state: HistoryState, trace: Trace, t: FloatArray, every_s: float
) -> tuple[HistoryState, list[dict[str, Any]]]:
    """Add the evaluations of a block, at the times `t` [UTC s], shape (K,); return the rows that are complete.

    A row is due at the first evaluation of a new period, and holds the largest statistics up to there.
    """
    if not t.size:
        return state, []
    periods = np.floor(t / every_s).astype(np.int64)
    excess = np.nan_to_num(np.where(trace.ready, trace.statistic / trace.threshold, 0.0))
    before = int(periods[0]) if state.period is None else state.period
    rows, first, peaks = [], 0, (state.excess, state.level)
    # the last evaluation may be one that begins a period: it counts once
    for k in dict.fromkeys([*np.flatnonzero(np.diff(periods, prepend=before)).tolist(), t.size - 1]):
        new = excess[first : k + 1], trace.level[first : k + 1]
        peaks = max(peaks[0], float(new[0].max(initial=0.0))), max(peaks[1], float(new[1].max(initial=0.0)))
        first = k + 1
        if periods[k] != (before if k == 0 else periods[k - 1]):
            residual = ifrf_residual(trace, k)
            rows.append({"t": float(t[k]), "statistic": peaks[0], "level": peaks[1], "residual": residual})
            peaks = 0.0, 0.0
    return HistoryState(int(periods[-1]), *peaks), rows


def ifrf_residual(trace: Trace, k: int) -> tuple[ResidualRow, ...]:
    """Return the residual of the iFRF at evaluation k, per frequency; None where it is unknown."""
    healthy = trace.ifrf_expected.H[k]
    numbers = [trace.ifrf.frequencies, *(f(trace.ifrf.H[k] - healthy) for f in (np.real, np.imag)), np.abs(healthy)]
    rows: list[Any] = np.stack(numbers, axis=1).tolist()
    return tuple((row[0], *(x if math.isfinite(x) else None for x in row[1:])) for row in rows)
