"""From theta and its covariance to the inverse frequency response H_hat(f), its residual and confidence ellipses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from servoscope.inverse import ComplexArray, FilterBank
from servoscope.plants import FloatArray

CHI2_95 = 5.991464547107979  # chi-square quantile, 2 degrees of freedom: an ellipse that holds 95 %


@dataclass(frozen=True, eq=False)
class Response:
    """H_hat at the monitored frequencies.

    Parameters
    ----------
    frequencies
        In Hz, shape (F,).
    H
        Complex, shape (..., F).
    covariance
        Of [Re H, Im H], shape (..., F, 2, 2).
    """

    frequencies: FloatArray
    H: ComplexArray
    covariance: FloatArray

    def ellipse(self, points: int = 64) -> FloatArray:
        """Return 95 % confidence ellipses around H, real and imaginary parts, shape (..., F, points, 2)."""
        angle = np.linspace(0.0, 2.0 * np.pi, points)
        circle = np.sqrt(CHI2_95) * np.stack([np.cos(angle), np.sin(angle)])
        value, vector = np.linalg.eigh(self.covariance)
        axes = vector * np.sqrt(np.maximum(value, 0.0))[..., None, :]
        centre = np.stack([self.H.real, self.H.imag], axis=-1)
        return np.asarray(centre[..., None, :] + np.swapaxes(axes @ circle, -1, -2))


def response(bank: FilterBank, frequencies: npt.ArrayLike, theta: FloatArray, covariance: FloatArray) -> Response:
    """Evaluate ``H_hat(f) = E(f) theta`` and ``Cov = E Cov(theta) E^H``, as real and imaginary parts.

    Parameters
    ----------
    bank
        Gives E(f).
    frequencies
        In Hz, shape (F,).
    theta
        Shape (..., n).
    covariance
        Of theta, shape (..., n, n).
    """
    f = np.atleast_1d(np.asarray(frequencies, dtype=np.float64))
    E = bank.E(f)
    parts = np.stack([E.real, E.imag], axis=1)  # (F, 2, n)
    covariance_H = np.einsum("fin,...nm,fjm->...fij", parts, covariance, parts)
    return Response(f, theta @ E.T, covariance_H)
