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
        """Return the evaluation as stored, without what is not known yet; in a quarter of the time of `model_dump`."""
        return {key: value for key, value in self if key in self.model_fields_set}


class LastEvaluations:
    """The last evaluation of a block of each of several assets as arrays, of which a status is a row.

    Of many assets together it takes a tenth of one by one.
    """

    def __init__(self, trace: Trace) -> None:
        at = slice(None), -1  # of each array, shape (assets, ...)
        excess = np.nan_to_num(trace.statistic / trace.threshold)
        std = np.sqrt(np.maximum(np.diagonal(trace.covariance[at], axis1=-2, axis2=-1), 0.0))
        parameters = np.stack([trace.theta[at], std, trace.expected[at]], axis=-1)
        responses, ready = response_rows(trace.ifrf, trace.ifrf_expected, at), trace.ready[at][:, None]
        statistics = excess[at], trace.level[at], excess.max(axis=-1), trace.level.max(axis=-1)
        self._statistics, self._exceeded = np.stack(statistics, axis=-1), trace.exceeded[at]
        self._features = None if trace.features is None else trace.features[at]
        self._residual, self._names = ifrf_residual(trace, at), trace.names
        # each with which of its rows are known
        self._parameters = parameters, ready & np.isfinite(parameters).all(axis=-1)
        self._responses = responses, ready & np.isfinite(responses).all(axis=-1)

    def status(self, asset: int, t: float) -> EvaluationStatus:
        """Return the status of an asset after its block; `t`: of the last evaluation [UTC s]."""
        statistic, level, *peaks = self._statistics[asset].tolist()
        (parameters, known), (responses, seen) = ((x[asset], y[asset]) for x, y in (self._parameters, self._responses))
        values = zip(self._names, parameters.tolist(), known.tolist(), strict=True)
        learned: dict[str, Any] = {} if self._features is None else {"features": float(self._features[asset])}
        return EvaluationStatus.model_construct(  # its values are checked where it is read
            **learned,
            t=t,
            statistic=statistic,
            level=level,
            peaks=tuple(peaks),
            residual=residual_rows(self._residual[asset]),
            exceeded=bool(self._exceeded[asset]),
            responses=tuple(ResponseRow(*row) for row in responses[seen].tolist()),
            parameters=tuple((name, *row) for name, row, is_known in values if is_known),
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
    excess = known_excess(trace)
    before = int(periods[0]) if state.period is None else state.period
    rows, first, peaks = [], 0, (state.excess, state.level)
    # the last evaluation may be one that begins a period: it counts once
    for k in dict.fromkeys([*np.flatnonzero(np.diff(periods, prepend=before)).tolist(), t.size - 1]):
        new = excess[first : k + 1], trace.level[first : k + 1]
        peaks = max(peaks[0], float(new[0].max(initial=0.0))), max(peaks[1], float(new[1].max(initial=0.0)))
        first = k + 1
        if periods[k] != (before if k == 0 else periods[k - 1]):
            rows.append(history_row(float(t[k]), *peaks, residual_rows(ifrf_residual(trace, k))))
            peaks = 0.0, 0.0
    return HistoryState(int(periods[-1]), *peaks), rows


def known_excess(trace: Trace) -> FloatArray:
    """Return T^2 as a multiple of its limit; the history counts it only where the estimator has learned something."""
    return np.nan_to_num(np.where(trace.ready, trace.statistic / trace.threshold, 0.0))


def history_row(t: float, statistic: float, level: float, residual: tuple[ResidualRow, ...]) -> dict[str, Any]:
    """Return a row of the history, without its number."""
    return {"t": t, "statistic": statistic, "level": level, "residual": residual}


def ifrf_residual(trace: Trace, k: Any) -> FloatArray:
    """Return the residual of the iFRF at evaluations `k`, an index: shape (..., F, 4), as in `ResidualRow`."""
    healthy = trace.ifrf_expected.H[k]
    difference = trace.ifrf.H[k] - healthy
    f = np.broadcast_to(trace.ifrf.frequencies, healthy.shape)
    return np.stack([f, difference.real, difference.imag, np.abs(healthy)], axis=-1)


def residual_rows(residual: FloatArray) -> tuple[ResidualRow, ...]:
    """Return the residual of one evaluation as it is stored, shape (F, 4): None where it is unknown."""
    rows: list[Any] = residual.tolist()
    if np.isfinite(residual).all():
        return tuple(map(tuple, rows))
    return tuple((row[0], *(x if math.isfinite(x) else None for x in row[1:])) for row in rows)
