"""What one asset's estimate says of the size of each fault: score and information, all that the fleet has to know."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servoscope.baseline import Baseline
from servoscope.detection import whiten
from servoscope.diagnosis import Trace
from servoscope.identification import fault_directions

__all__ = ["Evidence", "evidence_of"]


@dataclass(frozen=True)
class Evidence:
    """The log-likelihood of small changes s of the logarithms of m parameters: s' score - s' information s / 2.

    With d the deviation of theta from what a healthy loop would show, C its covariance and V the directions
    d theta / d s, the score is V' C^-1 d and the information V' C^-1 V: sufficient for s, whatever it is compared with.

    Parameters
    ----------
    names
        Of the parameters.
    score
        Shape (m,).
    information
        Shape (m, m).
    """

    names: tuple[str, ...]
    score: tuple[float, ...]
    information: tuple[tuple[float, ...], ...]


def evidence_of(baseline: Baseline, trace: Trace) -> Evidence:
    """Return the evidence at the end of a trace; none (all zero) where the estimator had learned nothing."""
    directions = fault_directions(baseline.loop, baseline.plant, np.array(baseline.theta))
    names = tuple(
        dict.fromkeys(fault.parameter for fault in baseline.loop.plant.faults if fault.parameter in directions)
    )
    m = len(names)
    if not len(trace.t) or not trace.ready[-1] or not m:
        return Evidence(names, (0.0,) * m, ((0.0,) * m,) * m)
    V = np.array([directions[name] for name in names]).T
    covariance = trace.covariance[-1] + baseline.cov()
    columns = np.column_stack([V, trace.theta[-1] - trace.expected[-1]])
    white = whiten(covariance[None], columns[None])[0]
    score, information = white[:, :m].T @ white[:, m], white[:, :m].T @ white[:, :m]
    return Evidence(names, tuple(score.tolist()), tuple(tuple(row) for row in information.tolist()))
