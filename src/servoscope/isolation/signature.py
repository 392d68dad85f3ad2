"""Signatures: the curves along which the coefficients move as one fault grows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.models.plants import Fault

MAX_FREE_RATIO = 0.3  # smallest ratio of a fault up to which its coefficient may as well change its sign


@dataclass(frozen=True)
class Signature:
    """The curve along which theta_hat moves as one fault grows."""

    fault: Fault
    shift: Callable[[float], FloatArray]  # coordinate -> change of theta_hat, shape (n,)
    ratio: Callable[[float], float]  # coordinate -> ratio of the parameter to its healthy value
    low: float  # low, high: range of the coordinate; the prior is uniform on it
    high: float
    healthy_std: float = (
        0.0  # standard deviation of the healthy value on the coordinate's scale: the size is relative to it
    )
    # angle by which the curve may be off, in standard deviations of the coefficients [rad], or of each of them (n,)
    angle: float | FloatArray = 0.0
    # coordinate -> covariance of the shift, shape (n, n), where the direction itself was learned from recordings
    scatter: Callable[[float], FloatArray] | None = None


def parameter_signature(fault: Fault, shift_of_ratio: Callable[[float], FloatArray], vague: float = 0.0) -> Signature:
    """Return the signature of a physical parameter: the coordinate is the logarithm of the ratio."""
    low, high = np.log(fault.ratio_range)

    def shift(x: float) -> FloatArray:
        return shift_of_ratio(float(np.exp(x)))

    return Signature(fault, shift, lambda x: float(np.exp(x)), low, high, vague)


def coefficient_signature(fault: Fault, direction: FloatArray) -> Signature:
    """Return the signature of a coefficient: theta moves along `direction`, its value of today, either way.

    One whose smallest ratio is near 1 hardly falls: friction, a lag.
    """
    reach = max(fault.ratio_range[1] - 1.0, 1.0)
    low = -reach if fault.ratio_range[0] <= MAX_FREE_RATIO else fault.ratio_range[0] - 1.0
    return Signature(fault, lambda x: x * direction, lambda x: 1.0 + x, low, reach)
