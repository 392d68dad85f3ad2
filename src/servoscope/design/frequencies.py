"""Which frequencies of the iFRF show the faults best, and apart from each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servoscope.baseline.plant_fit import fault_directions
from servoscope.core.arrays import FloatArray
from servoscope.design.scenario import Scenario
from servoscope.estimation.filter_bank import nominal_theta
from servoscope.estimation.frequency_response import frequency_response

LOWEST = 0.1  # Hz
CANDIDATES = 60
CHOSEN = 3
APART = 1.5  # smallest factor between two of them


@dataclass(frozen=True, eq=False)
class FrequencySensitivity:
    """How well single frequencies show k faults, shapes (F, k)."""

    frequencies: FloatArray  # in Hz, shape (F,)
    alone: FloatArray  # standard deviations by which the iFRF moves for a small change, per logarithm of the ratio
    isolated: FloatArray  # the part of that which no other fault's residual at the same frequency can explain

    def score(self, chosen: list[int]) -> float:
        """Return the mean logarithm of what the best of some frequencies shows of each fault apart from the others."""
        return float(np.log(np.maximum(self.isolated[chosen].max(axis=0), 1e-12)).mean())


def frequency_sensitivity(scene: Scenario, covariance: FloatArray, frequencies: FloatArray) -> FrequencySensitivity:
    """Measure how well some frequencies (F,) show the faults, theta_hat having a covariance (n, n)."""
    plant = scene.baseline.plant
    directions = fault_directions(scene.loop, plant, nominal_theta(scene.loop, plant))
    D = np.array([directions[name] for name in scene.names])
    bank = scene.baseline.pipeline().bank
    moved = frequency_response(bank, frequencies, D, np.broadcast_to(covariance, (len(D), *covariance.shape)))
    g = np.stack([moved.H.real, moved.H.imag], axis=-1)  # (k, F, 2)
    white = np.linalg.solve(np.linalg.cholesky(moved.covariance[0]), np.moveaxis(g, 0, -1))  # (F, 2, k)
    length = np.linalg.norm(white, axis=1)
    unit = white / np.maximum(length, 1e-300)[:, None, :]
    cosine = np.abs(np.einsum("fik,fil->fkl", unit, unit))
    cosine[:, np.arange(len(D)), np.arange(len(D))] = 0.0
    sine = np.sqrt(np.maximum(1.0 - cosine.max(axis=-1) ** 2, 0.0))
    return FrequencySensitivity(np.asarray(frequencies), length, length * sine)


def best_frequencies(scene: Scenario, covariance: FloatArray) -> FrequencySensitivity:
    """Choose three frequencies between 0.1 Hz and half of Nyquist's, greedily: each adds as much as it can."""
    highest = scene.loop.sample_rate / 4.0
    candidates = np.geomspace(min(LOWEST, highest / 10.0), highest, CANDIDATES)
    candidates = np.unique([float(f"{f:.2g}") for f in candidates])
    all_of_them = frequency_sensitivity(scene, covariance, candidates)
    chosen: list[int] = []
    for _ in range(CHOSEN):
        near = [candidates[i] for i in chosen]
        left = [i for i, f in enumerate(candidates) if all(abs(np.log(f / other)) > np.log(APART) for other in near)]
        chosen.append(max(left, key=lambda i: all_of_them.score([*chosen, i])))
    chosen.sort()
    return FrequencySensitivity(candidates[chosen], all_of_them.alone[chosen], all_of_them.isolated[chosen])
