"""The exact one-step predictor of y from u as logged: one plant, sampled, with the gains of its Kalman filter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.estimation.noise_model import WhiteNoise
from servoscope.fit.kernels import Array, innovations
from servoscope.fit.plant_kernels import sample_plants
from servoscope.models.discretise import discretise, split_delay
from servoscope.models.loop import Loop
from servoscope.models.plants import Plant
from servoscope.models.plants.base import StateSpace

MAX_GAIN_SAMPLES = 1024  # samples after a restart until the gain stays as it is
FIRST_STATE_STDS = 3.0  # standard deviations of u that the unknown first state may come from
DOUBLINGS = 8  # 2^8 samples before a restart that it may come from


class Predictor(NamedTuple):
    """One plant or several in a row; the arrays are those of `servoscope.fit.kernels.innovations`."""

    A: Array
    b: Array
    b_late: Array
    c: Array
    K: Array
    S: Array

    @classmethod
    def concatenate(cls, predictors: Sequence[Predictor]) -> Predictor:
        """Put plants in a row."""
        return cls(*(np.ascontiguousarray(np.concatenate(parts)) for parts in zip(*predictors, strict=True)))

    def innovations(
        self,
        onset: int,
        duration: int,
        u: FloatArray,
        y: FloatArray,
        restart: BoolArray,
        plants: IntArray | None = None,
    ) -> Array:
        """Return the innovations of a recording in standard deviations under a change of the plant.

        Shape (N,), or (V, N) for V variants of the change, the rows of `plants` (V, p): which ones it goes through.
        """
        rows = np.arange(len(self.b))[None] if plants is None else plants
        e: Array = innovations(*self, rows, onset, duration, u, y, restart)
        return e[0] if plants is None else e


class PlantVariants(NamedTuple):
    """Variants of a change: predictors in a row, and which of them each goes through, (V, p)."""

    predictor: Predictor
    plants: IntArray


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

    def predictor(self, plant: Plant, later_s: float = 0.0, noise: WhiteNoise | None = None) -> Predictor:
        """Return the predictor of a plant, as `predictors` does of several."""
        A, B, C = plant.state_space()
        return self.predictors((A[None], B[None], C[None]), np.ones(1), later_s, noise)

    def predictors(
        self, state_spaces: StateSpace, output_gains: Array, later_s: float = 0.0, noise: WhiteNoise | None = None
    ) -> Predictor:
        """Return the predictors of P plants in a row, of matrices (P, n, n), (P, n, 1) and (P, 1, n).

        ``x(k+1) = A x + b (u + n_u),  y = c x + n_y`` with the input held between samples. u as logged is known, so
        the loop being closed changes nothing, and no controller is needed (Ljung, 1999, section 13.4).

        The parameters of the plants may be complex, and `output_gains` (P,) multiply their y. `later_s` [s] is delay
        beyond the loop file's; `noise` takes the place of the factory's, but for the state after a restart.
        """
        F, g, c = state_spaces
        F, g = F * self.scale / self.scale[:, None], g[..., 0] / self.scale
        c = c[:, 0] * self.scale * output_gains[:, None]
        kind = np.result_type(F, g, c)  # one for all: each further mixture would be compiled anew
        F, g, c = (np.ascontiguousarray(part, dtype=kind) for part in (F, g, c))
        samples, late = split_delay(self.fractional_delay_s + later_s, self.loop.sample_rate)
        A, b, b_late = np.empty_like(F), np.empty_like(g), np.empty_like(g)
        K, S = np.empty((len(g), MAX_GAIN_SAMPLES, g.shape[1]), kind), np.empty((len(g), MAX_GAIN_SAMPLES), kind)
        noise = noise or self.noise
        variances = noise.u_std**2, noise.y_std**2
        P = self.initial_covariance.astype(kind)
        sample_plants(F, g, 1.0 / self.loop.sample_rate, late, c, *variances, P, A, b, b_late, K, S, n=g.shape[1])
        if samples:  # one sample later than the loop file says
            b, b_late = b_late, b
        return Predictor(A, b, b_late, c, K, S)

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
        P, power = (FIRST_STATE_STDS * self.u_std) ** 2 * np.outer(b, b), A
        for _ in range(DOUBLINGS):
            P, power = P + power @ P @ power.T, power @ power
        return np.asarray(P + (self.noise.y_std**2 / (c @ c) ** 2) * np.outer(c, c))
