"""What no fault of the list is and yet looks like one: gains of sensors, a delay, other parts of the plant."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.messages import Message, message, text_message
from servoscope.design.fisher_information import MISNAMED, cosines, equivalent_distance
from servoscope.design.result import MimicStudy
from servoscope.design.scenario import Scenario
from servoscope.fit.predictor import Predictor
from servoscope.isolation.ml.window import COMPLEX_STEP, SENSOR_GAIN

PARALLEL = 1e-6  # 1 - cosine^2 below which two changes are one and the same
AMOUNTS = {"relative": 0.01, "samples": 0.1}  # of mimics
DELAY_STEP = 0.01  # samples of delay by which the derivative is taken


@dataclass(frozen=True, eq=False)
class MimicCause:
    """A change that is no fault of the list."""

    name: str  # name, words: short and long
    words: Message
    unit: str  # what `column` is the derivative by: a relative change, or samples of delay
    column: FloatArray  # innovations by the change, shape (N + m,)


def mimic_causes(scene: Scenario) -> list[MimicCause]:
    """Return what else may change: further parts of the plant, gains of both sensors, the delay."""
    window, plant, m = scene.healthy, scene.baseline.plant, scene.healthy.nuisance_count
    names = (*plant.causes, SENSOR_GAIN)
    J = window.jacobian(np.zeros(m + len(names)), names, scene.profile, slice(m, None))
    causes = [
        MimicCause(name, text_message(plant.causes[name]), "relative", J[:, i]) for i, name in enumerate(plant.causes)
    ]
    healthy, factory = window.healthy, window.factory
    stronger = factory.predictor(plant.model_copy(update={"input_gain": plant.input_gain * (1.0 + 1j * COMPLEX_STEP)}))
    later = factory.predictor(plant, later_s=DELAY_STEP / scene.loop.sample_rate)
    return [
        *causes,
        MimicCause("gain of y", message("design.gain_of_y"), "relative", J[:, -1]),
        MimicCause(
            "gain of u",
            message("design.gain_of_u"),
            "relative",
            _innovation_column(scene, stronger).imag / COMPLEX_STEP,
        ),
        MimicCause(
            "delay",
            message("design.delay"),
            "samples",
            (_innovation_column(scene, later) - _innovation_column(scene, healthy)).real / DELAY_STEP,
        ),
    ]


def match_mimic(scene: Scenario, cause: MimicCause) -> MimicStudy:
    """Return which fault a small change of a cause looks like, what the healthy parameters can take up left out."""
    column = scene.project_out_nuisances(cause.column[:, None])
    faults = scene.project_out_nuisances(scene.sensitivity)
    cosine = cosines(column, faults)[0]
    i = int(np.argmax(np.abs(cosine)))
    size = float(faults[:, i] @ column[:, 0]) / max(float(faults[:, i] @ faults[:, i]), 1e-300)
    own = max(1.0 - float(cosine[i]) ** 2, 0.0)
    length = float(np.linalg.norm(column))
    told = equivalent_distance(MISNAMED) / (length * math.sqrt(own)) if own > PARALLEL and length > 0.0 else None
    amount, names = AMOUNTS[cause.unit], [fault.name for fault in scene.loop.plant.faults]
    return MimicStudy(
        name=cause.name,
        words=cause.words,
        amount=amount,
        unit=cause.unit,
        cosines=dict(zip(names, cosine.tolist(), strict=True)),
        imitates=names[i],
        looks_like=float(np.exp(amount * size)),
        told_apart=told,
    )


def _innovation_column(scene: Scenario, changed: Predictor) -> np.ndarray[tuple[int, ...], np.dtype[np.complex128]]:
    """Return innovations (N,) with a changed predictor from the onset on, and nothing for the prior, (N + m,)."""
    window, profile = scene.healthy, scene.profile
    both = [Predictor(*(part.astype(np.complex128) for part in predictor)) for predictor in (window.healthy, changed)]
    e = window.innovations(Predictor.concatenate(both), profile)
    return np.concatenate([e, np.zeros(window.nuisance_count)])
