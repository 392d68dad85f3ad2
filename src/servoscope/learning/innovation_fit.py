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
from servoscope.fit.plant_experiment import (
    LAGS,
    MAX_AUTOCORRELATION,
    PlantExperiment,
    initial_noise,
    robust_covariance,
)
from servoscope.fit.search import fit
from servoscope.models.loop import Loop
from servoscope.signals import Recording

FILE_ERROR = 0.2  # standard deviation of the logarithm of a parameter in a loop file that is not right
STARTS = (-2.0, 2.0)  # standard deviations of the prior, at which a search begins again for each parameter
MIN_PARAMETER_PROBABILITY = 1e-3  # probability below which other parameters are not believed
# and below which a file's own are not: four that stand in for twelve wrong ones lead to wrong names
MIN_FILE_PROBABILITY = 0.05
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

    @property
    def explains(self) -> bool:
        """Whether the plant is of the kind of the loop file: its parameters are the healthy ones then."""
        return self.largest_autocorrelation <= MAX_AUTOCORRELATION


def fit_innovations(loop: Loop, recordings: Sequence[Recording], noise: WhiteNoise) -> InnovationFit | None:
    """Fit plant and noise to healthy recordings; None where the predictor cannot be written down."""
    plant, begin = loop.plant, initial_noise(loop, recordings, noise)
    if begin is None:
        return None
    near = np.full(len(plant.parameters), PRIOR_STD)
    likely = _search(PlantExperiment.from_recordings(loop, recordings, plant, plant.parameters, near, begin))
    if likely is None or likely.is_likely(near, MIN_FILE_PROBABILITY):
        return likely
    names = plant.physical_parameters
    spread = FILE_ERROR * np.array([plant.error_factors.get(name, 1.0) for name in names])
    # from a file that is wrong there are local minima on the way
    starts = [way * size * unit for unit, size in zip(np.eye(len(names)), spread, strict=True) for way in STARTS]
    wrong = _search(PlantExperiment.from_recordings(loop, recordings, plant, names, spread, begin), starts)
    # what is further off than files are says that something else is wrong, a delay for example
    return wrong if wrong is None or wrong.is_likely(spread) else None


def _search(experiment: PlantExperiment, starts: Sequence[FloatArray] = ()) -> InnovationFit | None:
    """Search from the loop file and from other parameters (m,); None where there is no noise."""
    m, free = len(experiment.names), experiment.all_but_delay
    ends = [fit(experiment.search, experiment.start(x), free) for x in (None, *starts)]
    best = min(ends, key=lambda end: end.cost)
    noise = experiment.fitted_noise(best)
    if noise is None:
        return None
    largest = largest_autocorrelation(best.residual, LAGS)
    whiteness = largest * math.sqrt(len(best.residual))
    C = robust_covariance(best) if whiteness > MAX_AUTOCORRELATION_STDS else best.covariance
    return InnovationFit(experiment.names, best.x[:m], C[:m, :m], noise, largest, whiteness)
