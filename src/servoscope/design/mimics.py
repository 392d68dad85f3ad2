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
    J = window.jacobian(np.zeros(m + len(names)), names, scene.growth, m)
    found = [Cause(name, plant.causes[name], "relative", J[:, i]) for i, name in enumerate(names)]
    healthy, bench = window.healthy, window.bench
    step = 1j * TINY
    # gains of the filter need not follow: a healthy loop has no innovations that they could weigh differently
    louder = healthy._replace(c=healthy.c * (1.0 + step))
    stronger = healthy._replace(b=healthy.b * (1.0 + step), late=healthy.late * (1.0 + step))
    later = bench.predictor(plant, later_s=LATER / scene.loop.sample_rate)
    return [
        *found,
        Cause("gain of y", "another gain of the sensor of y", "relative", _column(scene, louder).imag / TINY),
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
