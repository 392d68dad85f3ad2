"""Several faults at once: which other explanations, single faults and pairs, come close to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.design.isolability import minimise_distance
from servoscope.design.scenario import Scenario
from servoscope.isolation.ml.window import RefitWindow
from servoscope.models.plants import Fault


def explanation_distances(scene: Scenario, ratios: Mapping[str, float]) -> dict[str, float]:
    """Return how far every single fault and every other pair is from some faults, by names joined with plus signs.

    Squared distances, as `servoscope.design.isolability.apart` has them; `information.confusion` of them is the
    probability of a wrong name. Explanations that contain the truth are left out: they come as close as they like, and
    pay for their freedom by their probabilities.
    """
    window = scene.window(ratios)
    names, m = tuple(ratios), window.nuisance_count
    own = window.residual(np.append(np.zeros(m), np.log(list(ratios.values()))), names, scene.profile)
    found: dict[str, float] = {}
    best: dict[str, float] = {}
    every = scene.loop.plant.faults
    for several in ((one,) for one in every):
        z, squared = _closest_explanation(
            scene, window, several, own, [_start(scene, window, several[0], own), *_true_sizes(several, ratios)]
        )
        best[several[0].parameter] = float(z[m])
        found[several[0].name] = squared
    for pair in combinations(every, 2):
        alone = [np.array([best[f.parameter] if f is g else 0.0 for f in pair]) for g in pair]
        squared = _closest_explanation(scene, window, pair, own, [*alone, *_true_sizes(pair, ratios)])[1]
        found[" + ".join(fault.name for fault in pair)] = squared
    true = {fault.name for fault in every if fault.parameter in ratios}
    return {name: squared for name, squared in found.items() if not true <= set(name.split(" + "))}


def _true_sizes(faults: Sequence[Fault], ratios: Mapping[str, float]) -> list[FloatArray]:
    return [np.log([ratios.get(fault.parameter, 1.0) for fault in faults])]


def _start(scene: Scenario, window: RefitWindow, fault: Fault, own: FloatArray) -> FloatArray:
    grid = scene.size_grids[fault.parameter]
    e = {x: window.innovations(predictor, scene.profile) - own[: window.samples] for x, predictor in grid.items()}
    return np.array([min(e, key=lambda x: float(e[x] @ e[x]))])


def _closest_explanation(
    scene: Scenario, window: RefitWindow, faults: Sequence[Fault], own: FloatArray, starts: Sequence[FloatArray]
) -> tuple[FloatArray, float]:
    """Return the closest point of an explanation, [d, x], and its squared distance."""
    tries = [np.append(np.zeros(window.nuisance_count), x) for x in starts]
    ends = [minimise_distance(scene, window, faults, own, z, held=True) for z in tries]
    z, left = min(ends, key=lambda end: float(end[1] @ end[1]))
    if window.nuisance_count:
        z, left = minimise_distance(scene, window, faults, own, z, held=False)
    return z, float(left @ left)
