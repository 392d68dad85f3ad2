"""Fig. 2: sensitivities of G and H to the four parameters, analytic, and how far apart their directions are."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import ComplexArray, FloatArray
from servoscope.models.plants.eha import EHA


def sensitivity_of_H(plant: EHA, f_hz: npt.ArrayLike) -> ComplexArray:
    """Return kappa_i dH/dkappa_i of eq. (2) at frequencies [Hz], shape (4, F), in the order p_s, C_ie, b_p, beta."""
    s = 2j * np.pi * np.atleast_1d(np.asarray(f_hz, dtype=np.float64))
    scale = plant.A_p * plant.flow_gain
    oil = plant.capacity * s + plant.C_ie
    mechanics = plant.m_p * s**2 + plant.b_p * s + plant.k_p
    H = (oil * mechanics + plant.A_p**2 * s) / scale
    return np.array(
        [
            -H / 2.0,  # H is proportional to p_s^-1/2
            plant.C_ie * mechanics / scale,
            oil * plant.b_p * s / scale,
            -plant.capacity * s * mechanics / scale,  # V_o/(2 beta) falls as beta grows
        ]
    )


def sensitivity_of_G(plant: EHA, f_hz: npt.ArrayLike) -> ComplexArray:
    """Return kappa_i dG/dkappa_i of eq. (1), shape (4, F): dG = -G^2 dH, all four turned by the same angle."""
    H = plant.frequency_response(np.atleast_1d(np.asarray(f_hz, dtype=np.float64)))
    return np.asarray(-sensitivity_of_H(plant, f_hz) / H**2)


def angle_between(a: npt.ArrayLike, b: npt.ArrayLike) -> FloatArray:
    """Return the angle between two directions in the complex plane as lines, 0 to 90 degrees."""
    turned = np.angle(np.asarray(a) * np.conj(np.asarray(b)))
    return np.asarray(np.degrees(np.minimum(np.abs(turned), np.pi - np.abs(turned))))
