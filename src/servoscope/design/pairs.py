"""Several faults at once: which other explanations, single faults and pairs, come close to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from servoscope.design.distances import descended
from servoscope.design.scene import Scene
from servoscope.plants import Fault, FloatArray
from servoscope.refinement.window import Window


def explanations(scene: Scene, ratios: Mapping[str, float]) -> dict[str, float]:
    """Return how far every single fault and every other pair is from some faults, by names joined with plus signs.

    Squared distances, as `servoscope.design.distances.apart` has them; `information.confusion` of them is the
    probability of a wrong name. Explanations that contain the truth are left out: they come as close as they like, and
    pay for their freedom by their probabilities.

    Raises
    ------
    SimulationError
        If the loop is unstable with the faults.
    """
    window = scene.window(ratios)
    names, m = tuple(ratios), window.nuisances
    own = window.residual(np.append(np.zeros(m), np.log(list(ratios.values()))), names, scene.growth)
    found: dict[str, float] = {}
    best: dict[str, float] = {}
    every = scene.loop.plant.faults
    for several in ((one,) for one in every):
        z, squared = _closest(
            scene, window, several, own, [_start(scene, window, several[0], own), *_known(several, ratios)]
        )
        best[several[0].parameter] = float(z[m])
        found[several[0].name] = squared
    for pair in combinations(every, 2):
        alone = [np.array([best[f.parameter] if f is g else 0.0 for f in pair]) for g in pair]
        squared = _closest(scene, window, pair, own, [*alone, *_known(pair, ratios)])[1]
        found[" + ".join(fault.name for fault in pair)] = squared
    true = {fault.name for fault in every if fault.parameter in ratios}
    return {name: squared for name, squared in found.items() if not true <= set(name.split(" + "))}


def _known(faults: Sequence[Fault], ratios: Mapping[str, float]) -> list[FloatArray]:
    return [np.log([ratios.get(fault.parameter, 1.0) for fault in faults])]


def _start(scene: Scene, window: Window, fault: Fault, own: FloatArray) -> FloatArray:
    ladder = scene.ladders[fault.parameter]
    e = {x: window.innovations(predictor, scene.growth) - own[: window.samples] for x, predictor in ladder.items()}
    return np.array([min(e, key=lambda x: float(e[x] @ e[x]))])


def _closest(
    scene: Scene, window: Window, faults: Sequence[Fault], own: FloatArray, starts: Sequence[FloatArray]
) -> tuple[FloatArray, float]:
    """Return the closest point of an explanation, [d, x], and its squared distance."""
    tries = [np.append(np.zeros(window.nuisances), x) for x in starts]
    ends = [descended(scene, window, faults, own, z, held=True) for z in tries]
    z, left = min(ends, key=lambda end: float(end[1] @ end[1]))
    if window.nuisances:
        z, left = descended(scene, window, faults, own, z, held=False)
    return z, float(left @ left)
