"""From theta and its covariance to the inverse frequency response H_hat(f), its residual and confidence ellipses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import ComplexArray, FloatArray
from servoscope.estimation.filter_bank import FilterBank

CHI2_95_2DOF = 5.991464547107979  # chi-square quantile, 2 degrees of freedom: an ellipse that holds 95 %


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """H_hat at the monitored frequencies."""

    frequencies: FloatArray  # in Hz, shape (F,)
    H: ComplexArray  # complex, shape (..., F)
    covariance: FloatArray  # of [Re H, Im H], shape (..., F, 2, 2)

    def ellipse(self, points: int = 64) -> FloatArray:
        """Return 95 % confidence ellipses around H, real and imaginary parts, shape (..., F, points, 2)."""
        angle = np.linspace(0.0, 2.0 * np.pi, points)
        circle = np.sqrt(CHI2_95_2DOF) * np.stack([np.cos(angle), np.sin(angle)])
        value, vector = np.linalg.eigh(self.covariance)
        axes = vector * np.sqrt(np.maximum(value, 0.0))[..., None, :]
        centre = np.stack([self.H.real, self.H.imag], axis=-1)
        return np.asarray(centre[..., None, :] + np.swapaxes(axes @ circle, -1, -2))


def frequency_response(
    bank: FilterBank, frequencies: npt.ArrayLike, theta: FloatArray, covariance: FloatArray
) -> FrequencyResponse:
    """Evaluate ``H_hat(f) = E(f) theta`` and ``Cov = E Cov(theta) E^H``, as real and imaginary parts.

    Frequencies (F,) are in Hz; theta (..., n) has the covariance (..., n, n).
    """
    f = np.atleast_1d(np.asarray(frequencies, dtype=np.float64))
    E = bank.E(f)
    parts = np.stack([E.real, E.imag], axis=1)  # (F, 2, n)
    covariance_H = np.einsum("fin,...nm,fjm->...fij", parts, covariance, parts)
    return FrequencyResponse(f, theta @ E.T, covariance_H)


class ResponseRow(NamedTuple):
    """An estimated response at one frequency, the nominal one, and the covariance of the estimate's two parts."""

    frequency_hz: float
    real: float
    imag: float
    nominal_real: float
    nominal_imag: float
    real_variance: float
    covariance: float
    imag_variance: float


def response_rows(estimate: FrequencyResponse, nominal: FrequencyResponse, k: Any) -> FloatArray:
    """Return a response as plain numbers, the fields of `ResponseRow`, shape (..., F, 8), at an index `k` of arrays."""
    H, healthy, C = estimate.H[k], nominal.H[k], estimate.covariance[k]
    f = np.broadcast_to(estimate.frequencies, H.shape)
    parts = (f, H.real, H.imag, healthy.real, healthy.imag, C[..., 0, 0], C[..., 0, 1], C[..., 1, 1])
    return np.stack(parts, axis=-1)
