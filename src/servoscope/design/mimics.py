"""What no fault of the list is and yet looks like one: gains of sensors, a delay, other parts of the plant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servoscope.design.information import MISNAMED, cosines, equivalent
from servoscope.design.scene import Scene
from servoscope.plants import FloatArray
from servoscope.refinement.predictor import Predictor
from servoscope.refinement.window import TINY

PARALLEL = 1e-6  # 1 - cosine^2 below which two changes are one and the same
LOUDER = 1e-4  # gain by which one is taken
LATER = 0.01  # samples of delay by which the derivative is taken


@dataclass(frozen=True, eq=False)
class Cause:
    """A change that is no fault of the list.

    Parameters
    ----------
    name, words
        Short and long.
    unit
        What `column` is the derivative by: a relative change, or samples of delay.
    column
        Innovations by the change, shape (N + m,).
    """

    name: str
    words: str
    unit: str
    column: FloatArray


def causes(scene: Scene) -> list[Cause]:
    """Return what else may change: further parts of the plant, gains of both sensors, the delay."""
    window, plant, m = scene.healthy, scene.baseline.plant, scene.healthy.nuisances
    names = tuple(plant.causes)
    J = window.jacobian(np.zeros(m + len(names)), names, scene.growth, slice(m, None))
    found = [Cause(name, plant.causes[name], "relative", J[:, i]) for i, name in enumerate(names)]
    healthy, bench = window.healthy, window.bench
    louder, softer = (bench.predictor(plant, output_gain=1.0 + step) for step in (LOUDER, -LOUDER))
    stronger = bench.predictor(plant.model_copy(update={"input_gain": plant.input_gain * (1.0 + 1j * TINY)}))
    later = bench.predictor(plant, later_s=LATER / scene.loop.sample_rate)
    gain_of_y = (_column(scene, louder) - _column(scene, softer)).real / (2.0 * LOUDER)
    return [
        *found,
        Cause("gain of y", "another gain of the sensor of y", "relative", gain_of_y),
        Cause("gain of u", "another gain of the input", "relative", _column(scene, stronger).imag / TINY),
        Cause("delay", "a further delay", "samples", (_column(scene, later) - _column(scene, healthy)).real / LATER),
    ]


@dataclass(frozen=True)
class Imitation:
    """Which fault a cause looks like.

    Parameters
    ----------
    cosine
        Between both, for each fault, what the healthy parameters can take up left out.
    fault
        Number of the fault with the largest.
    size
        Logarithm of its ratio that a unit of the cause looks like.
    told_apart
        Units of the cause from which on it is told from that fault with 99.5 % probability; infinite: never.
    """

    cosine: FloatArray
    fault: int
    size: float
    told_apart: float


def imitation(scene: Scene, cause: Cause) -> Imitation:
    """Return which fault a small change of a cause looks like."""
    column = scene.projected(cause.column[:, None])
    faults = scene.projected(scene.sensitivity)
    cosine = cosines(column, faults)[0]
    i = int(np.argmax(np.abs(cosine)))
    size = float(faults[:, i] @ column[:, 0]) / max(float(faults[:, i] @ faults[:, i]), 1e-300)
    own = max(1.0 - float(cosine[i]) ** 2, 0.0)
    length = float(np.linalg.norm(column))
    told = equivalent(MISNAMED) / (length * np.sqrt(own)) if own > PARALLEL and length > 0.0 else np.inf
    return Imitation(cosine, i, size, float(told))


def _column(scene: Scene, changed: Predictor) -> np.ndarray[tuple[int, ...], np.dtype[np.complex128]]:
    """Return innovations (N,) with a changed predictor from the onset on, and nothing for the prior, (N + m,)."""
    window, growth = scene.healthy, scene.growth
    both = [Predictor(*(part.astype(np.complex128) for part in each)) for each in (window.healthy, changed)]
    e = window.innovations(Predictor.of(both), growth)
    return np.concatenate([e, np.zeros(window.nuisances)])
