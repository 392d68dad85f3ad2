"""Healthy parameters and noise by the innovations of the exact predictor: nothing between samples is left out.

The likelihood of y given u as logged is the joint one, in closed loop too (Ljung, 1999, section 13.4). Free are the
logarithms of the plant's parameters, held by a prior, and of the ratio of the noises; their level is concentrated out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servoscope.baseline.plant_fit import PRIOR_STD
from servoscope.core.arrays import FloatArray
from servoscope.estimation.noise_model import WhiteNoise, largest_autocorrelation
from servoscope.estimation.tuning import sandwich_covariance, sum_covariance
from servoscope.isolation.ml.kernels import Array
from servoscope.isolation.ml.window import ChangeProfile, RefitWindow
from servoscope.models.loop import Loop
from servoscope.signals import Recording

MAX_SAMPLES = 60_000  # samples of a recording that are looked at
NOISE_PRIOR = 3.0  # standard deviation of the logarithm of the ratio of the noises
DIFFERENCE = 1e-4  # of that logarithm, for its derivative
STEPS, ROUNDS = 12, 3  # of a search at one level of the noise, and levels
MIN_NOISE_RATIO = 1e-3  # of the noise on y relative to that on u, in their usual units: what is quieter was simulated
FILE_ERROR = 0.2  # standard deviation of the logarithm of a parameter in a loop file that is not right
STARTS = (-2.0, 2.0)  # standard deviations of the prior, at which a search begins again for each parameter
MIN_PARAMETER_PROBABILITY = 1e-3  # probability below which other parameters are not believed
# and below which a file's own are not: four that stand in for twelve wrong ones lead to wrong names
MIN_FILE_PROBABILITY = 0.05
LAGS = 20
SILENT_NOISE_SHARE = 1e-6  # of the noise's variance: what is quieter was simulated without any
# autocorrelation of innovations up to which a plant is believed to be of the kind of the loop file
MAX_AUTOCORRELATION = 0.1
MAX_AUTOCORRELATION_STDS = 4.0  # standard deviations of an autocorrelation, from which innovations are not white


@dataclass(frozen=True, eq=False)
class InnovationFit:
    """The likeliest healthy plant."""

    names: tuple[str, ...]  # parameters, m
    x: FloatArray  # logarithms of the parameters relative to the loop file's, shape (m,)
    covariance: FloatArray  # of them, inflated where the innovations are not white, shape (m, m)
    noise: WhiteNoise
    largest_autocorrelation: float  # of the innovations, up to `LAGS`
    whiteness: float  # the same in standard deviations

    def is_likely(self, spread: FloatArray, unlikely: float = MIN_PARAMETER_PROBABILITY) -> bool:
        """Whether the prior of a standard deviation per parameter (m,) allows the parameters."""
        from scipy import special

        return float(((self.x / spread) ** 2).sum()) <= float(special.chdtri(len(self.x), unlikely))

    def contradicts(self, x: FloatArray) -> bool:
        """Whether other logarithms (m,) are further off than chance puts them in one of a thousand cases."""
        from scipy import special

        if (
            self.largest_autocorrelation > MAX_AUTOCORRELATION
        ):  # the plant is not of this kind, and its parameters mean little
            return False
        if len(x) < len(self.names):  # the loop file itself is wrong, and all of its parameters were fitted
            return True
        off = self.x - x
        return float(off @ np.linalg.solve(self.covariance, off)) > float(
            special.chdtri(len(x), MIN_PARAMETER_PROBABILITY)
        )


def fit_innovations(loop: Loop, recordings: Sequence[Recording], noise: WhiteNoise) -> InnovationFit | None:
    """Fit plant and noise to healthy recordings; None where the predictor cannot be written down."""
    plant = loop.plant
    if not noise.y_std > 0.0 or loop.hold != "zoh" or not plant.has_physics or not plant.linear or plant.extras:
        return None
    u_std = max(noise.u_std, MIN_NOISE_RATIO * float(np.mean([rec.u.std() for rec in recordings])))
    begin = WhiteNoise(u_std=u_std, y_std=noise.y_std)
    windows = [
        RefitWindow.of_healthy(loop, plant, begin, rec).cut(0, min(rec.samples, MAX_SAMPLES)) for rec in recordings
    ]
    near = np.full(len(plant.parameters), PRIOR_STD)
    found = _InnovationSearch(windows, begin, plant.parameters, near).run()
    if found is None or found.is_likely(near, MIN_FILE_PROBABILITY):
        return found
    names = plant.physical_parameters
    spread = FILE_ERROR * np.array([plant.error_factors.get(name, 1.0) for name in names])
    # from a file that is wrong there are local minima on the way
    starts = [way * size * unit for unit, size in zip(np.eye(len(names)), spread, strict=True) for way in STARTS]
    wrong = _InnovationSearch(windows, begin, names, spread).run([np.zeros(len(names)), *starts])
    # what is further off than files are says that something else is wrong, a delay for example
    return wrong if wrong is None or wrong.is_likely(spread) else None


class _InnovationSearch:
    """Gauss and Newton, the noise's level known from the step before; z = [x, log ratio of the noises]."""

    def __init__(
        self, windows: Sequence[RefitWindow], noise: WhiteNoise, names: tuple[str, ...], spread: FloatArray
    ) -> None:
        self.windows, self.noise, self.names = windows, noise, names
        self.plant = windows[0].plant
        self.spread = np.append(spread, NOISE_PRIOR)
        self.samples = sum(window.samples for window in windows)
        self.power = 1.0

    def run(self, starts: Sequence[FloatArray] = ()) -> InnovationFit | None:
        """Search from the loop file, or from several starts (m,), of which the likeliest end counts."""
        ends = [self._fit(np.append(x, 0.0)) for x in starts or [np.zeros(len(self.names))]]
        found = [end for end in ends if end is not None]
        return self._describe(*min(found, key=lambda end: self._cost(end[0]))) if found else None

    def _cost(self, z: FloatArray) -> float:
        """Return -2 log likelihood times prior."""
        e = self.innovations(z)
        return self.samples * math.log(float(e @ e)) + float(((z / self.spread) ** 2).sum())

    def _fit(self, z: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Return the end of a search and its Jacobian; None where there is no noise."""
        from scipy.optimize import least_squares as minimise

        for _ in range(ROUNDS):
            e, volume = self._standardised(z)
            if float(e @ e) < SILENT_NOISE_SHARE * self.samples:
                return None
            self.power = float(e @ e * np.exp(volume)) / self.samples
            found = minimise(self.residual, z, self.jacobian, x_scale=self.spread, max_nfev=STEPS, bounds=(-6.0, 6.0))
            z = np.asarray(found.x)
        return z, np.asarray(found.jac)

    def _noise(self, z: Array) -> WhiteNoise:
        return WhiteNoise(u_std=self.noise.u_std * float(np.exp(z[-1].real)), y_std=self.noise.y_std)

    def _standardised(self, z: Array) -> tuple[Array, Array]:
        """Return the innovations in standard deviations at the search's own level, (N,), and their mean log S."""
        changed = self.plant.scaled(dict(zip(self.names, np.exp(z[:-1]), strict=True)))
        parts, volume, noise = [], 0.0 * z[0], self._noise(z)
        for window in self.windows:
            predictor = window.factory.predictor(changed, noise=noise)
            parts.append(window.innovations(predictor, ChangeProfile(window.samples)))
            # gains settle within seconds: the variance at their end stands for all
            volume = volume + window.samples / self.samples * np.log(predictor.S[0, -1])
        return np.concatenate(parts), volume

    def innovations(self, z: Array) -> Array:
        """Return innovations whose sum of squares ranks as the likelihood does, shape (N,)."""
        e, volume = self._standardised(z)
        return np.asarray(e * np.exp(0.5 * volume))

    def residual(self, z: FloatArray) -> FloatArray:
        """Return what least squares makes small: innovations at the noise's level, and prior, shape (N + m + 1,)."""
        return np.concatenate([self.innovations(z) / np.sqrt(self.power), z / self.spread])

    def jacobian(self, z: FloatArray) -> FloatArray:
        """Return its derivatives, by complex steps but for the noise's."""
        columns = []
        for i in range(len(z) - 1):
            moved = z.astype(np.complex128)
            moved[i] += 1e-30j
            columns.append(self.innovations(moved).imag / 1e-30)
        step = DIFFERENCE * np.eye(len(z))[-1]
        columns.append((self.innovations(z + step) - self.innovations(z - step)) / (2.0 * DIFFERENCE))
        return np.vstack([np.array(columns).T / np.sqrt(self.power), np.diag(1.0 / self.spread)])

    def _describe(self, z: FloatArray, J: FloatArray) -> InnovationFit:
        e, _ = self._standardised(z)
        largest = largest_autocorrelation(e, LAGS)
        whiteness = largest * math.sqrt(self.samples)
        C: FloatArray = np.asarray(np.linalg.inv(J.T @ J))
        if whiteness > MAX_AUTOCORRELATION_STDS:
            C = _inflate(C, J, self.residual(z), self.samples)
        level = math.sqrt(float(e @ e) / self.samples)
        return InnovationFit(self.names, z[:-1], C[:-1, :-1], self._noise(z).times(level), largest, whiteness)


def _inflate(C: FloatArray, J: FloatArray, e: FloatArray, N: int) -> FloatArray:
    """Return the covariance with each standard deviation that of correlated innovations, where that is larger."""
    X = sum_covariance(J[:N] * e[:N, None], LAGS)
    robust = sandwich_covariance(C, X + J[N:].T @ J[N:], np.ones(len(C)))
    factor = np.sqrt(np.maximum(np.diag(robust) / np.diag(C), 1.0))
    return np.asarray(C * np.outer(factor, factor))
