"""What a small sine on the reference would buy: radii with and without it, and its price in u."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servoscope.design.information import bound, deviations, fisher
from servoscope.design.scene import Scene
from servoscope.plants import FloatArray
from servoscope.simulation import response

SHARES = (0.01, 0.05)  # amplitudes, of the reference's rms
CANDIDATES = 16  # frequencies that are tried
LOWEST = 0.1  # Hz
LARGEST = 100.0  # logarithm that stands for a radius that does not exist


@dataclass(frozen=True, eq=False)
class Dithered:
    """A sine on the reference.

    Parameters
    ----------
    frequency_hz, share, amplitude
        Its frequency, and its amplitude as a share of the reference's rms and in units of the output.
    extra_u_rms
        Rms of what it adds to u.
    std, radius
        Cramer-Rao standard deviations of each size alone, and isolability radii as they are for small changes, with
        the healthy parameters as well known as they are then; logarithms, shapes (k,).
    """

    frequency_hz: float
    share: float
    amplitude: float
    extra_u_rms: float
    std: FloatArray
    radius: FloatArray


def without(scene: Scene) -> Dithered:
    """Return the same for the reference as it is."""
    return Dithered(0.0, 0.0, 0.0, 0.0, *_known(scene))


def best(scene: Scene) -> list[Dithered]:
    """Choose the frequency at which the largest dither shrinks the radii most; return it with each amplitude."""
    frequencies = np.geomspace(LOWEST, scene.loop.sample_rate / 4.0, CANDIDATES)
    frequencies = np.unique([float(f"{f:.2g}") for f in frequencies])
    tried = [_dithered(scene, float(f), SHARES[-1]) for f in frequencies]
    gained = [float(np.log(np.minimum(each.radius, LARGEST)).sum()) for each in tried]
    chosen = tried[int(np.argmin(gained))]
    return [*(_dithered(scene, chosen.frequency_hz, share) for share in SHARES[:-1]), chosen]


def _dithered(scene: Scene, frequency_hz: float, share: float) -> Dithered:
    r = scene.r
    amplitude = share * float(np.std(r))
    sine = amplitude * np.sin(2.0 * np.pi * frequency_hz * np.arange(len(r)) / scene.loop.sample_rate)
    plants = [scene.baseline.plant]
    more = response(scene.loop, r + sine, plants=plants)[0] - response(scene.loop, r, plants=plants)[0]
    extra = float(np.sqrt((more[scene.onset :] ** 2).mean()))
    richer = Scene.of(scene.baseline, r + sine, scene.after_s)
    return Dithered(frequency_hz, share, amplitude, extra, *_known(richer))


def _known(scene: Scene) -> tuple[FloatArray, FloatArray]:
    F = fisher(scene, exact=False)
    return deviations(F)[0], np.array([bound(F, i) for i in range(len(F))])
