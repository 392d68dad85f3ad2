"""What a small sine on the reference would buy: radii with and without it, and its price in u."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.design.fisher_information import cramer_rao_std, fisher_matrix, linear_isolability_radius
from servoscope.design.scenario import Scenario
from servoscope.simulation import simulate_response

SHARES = (0.01, 0.05)  # amplitudes, of the reference's rms
CANDIDATES = 16  # frequencies that are tried
LOWEST = 0.1  # Hz
LARGEST = 100.0  # logarithm that stands for a radius that does not exist


@dataclass(frozen=True, eq=False)
class DitherEffect:
    """A sine on the reference."""

    # frequency_hz, share, amplitude: its frequency, and its amplitude as a share of the reference's rms and in units
    # of the output
    frequency_hz: float
    share: float
    amplitude: float
    extra_u_rms: float  # rms of what it adds to u
    # std, radius: cramer-Rao standard deviations of each size alone, and isolability radii as they are for small
    # changes, with the healthy parameters as well known as they are then; logarithms, shapes (k,)
    std: FloatArray
    radius: FloatArray


def without_dither(scene: Scenario) -> DitherEffect:
    """Return the same for the reference as it is."""
    return DitherEffect(0.0, 0.0, 0.0, 0.0, *_std_and_radius(scene))


def best_dither(scene: Scenario) -> list[DitherEffect]:
    """Choose the frequency at which the largest dither shrinks the radii most; return it with each amplitude."""
    frequencies = np.geomspace(LOWEST, scene.loop.sample_rate / 4.0, CANDIDATES)
    frequencies = np.unique([float(f"{f:.2g}") for f in frequencies])
    tried = [_evaluate_dither(scene, float(f), SHARES[-1]) for f in frequencies]
    gained = [float(np.log(np.minimum(each.radius, LARGEST)).sum()) for each in tried]
    chosen = tried[int(np.argmin(gained))]
    return [*(_evaluate_dither(scene, chosen.frequency_hz, share) for share in SHARES[:-1]), chosen]


def _evaluate_dither(scene: Scenario, frequency_hz: float, share: float) -> DitherEffect:
    r = scene.r
    amplitude = share * float(np.std(r))
    sine = amplitude * np.sin(2.0 * np.pi * frequency_hz * np.arange(len(r)) / scene.loop.sample_rate)
    plants = [scene.baseline.plant]
    more = (
        simulate_response(scene.loop, r + sine, plants=plants)[0] - simulate_response(scene.loop, r, plants=plants)[0]
    )
    extra = float(np.sqrt((more[scene.onset :] ** 2).mean()))
    richer = Scenario.from_baseline(scene.baseline, r + sine, scene.after_s)
    return DitherEffect(frequency_hz, share, amplitude, extra, *_std_and_radius(richer))


def _std_and_radius(scene: Scenario) -> tuple[FloatArray, FloatArray]:
    F = fisher_matrix(scene, exact=False)
    return cramer_rao_std(F)[0], np.array([linear_isolability_radius(F, i) for i in range(len(F))])
