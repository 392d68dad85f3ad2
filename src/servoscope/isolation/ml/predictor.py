"""The exact one-step predictor of y from u as logged: one plant, sampled, with the gains of its Kalman filter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.estimation.noise_model import WhiteNoise
from servoscope.isolation.ml.kernels import Array
from servoscope.models.discretise import discretise, discretise_uncached, split_delay
from servoscope.models.loop import Loop
from servoscope.models.plants import Plant

LONGEST = 1024  # samples after a restart until the gain stays as it is
LOUD = 3.0  # standard deviations of u that the unknown first state may come from
DOUBLINGS = 8  # 2^8 samples before a restart that it may come from


class Predictor(NamedTuple):
    """One plant or several in a row; the arrays are those of `servoscope.isolation.ml.kernels.innovations`."""

    A: Array
    b: Array
    b_late: Array
    c: Array
    K: Array
    S: Array

    @classmethod
    def concatenate(cls, each: Sequence[Predictor]) -> Predictor:
        """Put plants in a row."""
        return cls(*(np.ascontiguousarray(np.concatenate(parts)) for parts in zip(*each, strict=True)))

    def innovations(self, since: int, over: int, u: FloatArray, y: FloatArray, restart: BoolArray) -> Array:
        """Return the innovations of a recording in standard deviations, shape (N,), under a change of the plant."""
        from servoscope.isolation.ml.kernels import innovations

        A, b, late, c, K, S = (part[None] for part in self)
        return innovations(A, b, late, c, K, S, since, over, u, y, restart)


@dataclass(frozen=True, eq=False)
class PredictorFactory:
    """Where predictors are made."""

    loop: Loop  # sampling and delay; `Loop.hold` is ``zoh``, or u would know of the noise that it meets
    noise: WhiteNoise  # of the loop
    # units of the plant's states, shape (n,), the same for all plants: pressures beside displacements would spoil the
    # covariance
    scale: FloatArray
    u_std: float  # standard deviation of u as recorded, which says how far the state may be from rest at a restart

    @classmethod
    def from_input(cls, loop: Loop, noise: WhiteNoise, u: FloatArray) -> PredictorFactory:
        """Prepare for a recording's u (N,)."""
        from scipy.linalg import matrix_balance

        _, (scale, _) = matrix_balance(loop.plant.state_space()[0], permute=False, separate=True)
        return cls(loop, noise, np.asarray(scale, dtype=np.float64), float(np.sqrt((u**2).mean())))

    def predictor(
        self, plant: Plant, output_gain: float = 1.0, later_s: float = 0.0, noise: WhiteNoise | None = None
    ) -> Predictor:
        """Return the predictor of a plant.

        ``x(k+1) = A x + b (u + n_u),  y = c x + n_y`` with the input held between samples. u as logged is known, so
        the loop being closed changes nothing, and no controller is needed (Ljung, 1999, section 13.4).

        The parameters of the plant may be complex. `later_s` [s] is delay beyond the loop file's; `noise` takes the
        place of the factory's, but for the state after a restart.
        """
        from servoscope.isolation.ml.kernels import gains

        d = discretise_uncached(plant.state_space(), self.loop.sample_rate, "zoh", self.fractional_delay_s + later_s)
        A, b, late = d.A * self.scale / self.scale[:, None], d.b_now / self.scale, d.b_late / self.scale
        c = d.c * self.scale * output_gain
        kind = np.result_type(A, b, c)  # one for all: each further mixture would be compiled anew
        A, b, late, c = (np.ascontiguousarray(part, dtype=kind) for part in (A, b, late, c))
        if d.delay_samples:  # one sample later than the loop file says
            b, late = late, b
        noise = noise or self.noise
        Q = noise.u_std**2 * (b[:, None] * b + late[:, None] * late)
        K, S = np.zeros((LONGEST, len(b)), A.dtype), np.zeros(LONGEST, A.dtype)
        gains(A, Q, c, noise.y_std**2, self.initial_covariance.astype(kind), K, S)
        return Predictor(A[None], b[None], late[None], c[None], K[None], S[None])

    @property
    def fractional_delay_s(self) -> float:
        """Part of the loop file's delay that is no whole sample [s]."""
        return split_delay(self.loop.delay, self.loop.sample_rate)[1] / self.loop.sample_rate

    @property
    def integer_delay(self) -> int:
        """Whole samples of the loop file's delay."""
        return split_delay(self.loop.delay, self.loop.sample_rate)[0]

    @cached_property
    def initial_covariance(self) -> FloatArray:
        """Covariance of the first state after a restart, (n, n): what a loud and white u would have left."""
        d = discretise(self.loop.plant.state_space(), self.loop.sample_rate, hold="zoh")
        A, b, c = d.A * self.scale / self.scale[:, None], d.b_now / self.scale, d.c * self.scale
        P, power = (LOUD * self.u_std) ** 2 * np.outer(b, b), A
        for _ in range(DOUBLINGS):
            P, power = P + power @ P @ power.T, power @ power
        return np.asarray(P + (self.noise.y_std**2 / (c @ c) ** 2) * np.outer(c, c))
