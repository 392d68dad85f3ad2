"""What the exact predictor of the plant leaves of a recording, and what a change adds to that."""

from __future__ import annotations

import numpy as np

import servoscope as ss
from accuracy.rig import FAULT_AT, loop
from servoscope.core.arrays import FloatArray
from servoscope.estimation.noise_model import WhiteNoise
from servoscope.fit.predictor import PredictorFactory
from servoscope.isolation.ml.window import ChangeProfile, RefitWindow
from servoscope.models.plants import Plant
from servoscope.simulation import FaultEvent, reference
from servoscope.simulation.measurement import NOISE_U_STD, NOISE_Y_STD

TRUE = WhiteNoise(u_std=NOISE_U_STD, y_std=NOISE_Y_STD)


def known(recording: ss.Recording, plant: Plant, noise: WhiteNoise = TRUE) -> RefitWindow:
    """Return all of a recording as the refit sees it that knows plant and noise exactly."""
    bench, nothing = PredictorFactory.from_input(loop(), noise, recording.u), np.zeros((0, 0))
    return RefitWindow(plant, nothing, (), 0, recording.u, recording.y, recording.restart, bench)


def innovations(recording: ss.Recording, plant: Plant, noise: WhiteNoise = TRUE) -> FloatArray:
    """Return the innovations of a recording in standard deviations, shape (N,)."""
    window = known(recording, plant, noise)
    return np.asarray(window.innovations(window.healthy, ChangeProfile(0)), dtype=np.float64)


def information(fault: FaultEvent, kind: str, seconds: float) -> FloatArray:
    """Return the Kullback-Leibler information of each sample after a change [nat].

    The change moves the mean of the healthy innovations by what the noise-free faulty loop leaves of them: half of
    its square in variances. It changes the noise's colour too; that adds less than 3 % here and is left out.
    """
    r = reference(kind, seconds, loop().sample_rate)
    quiet, _ = ss.simulate(loop(), r, faults=(fault,), noise_u_std=0.0, noise_y_std=0.0)
    return innovations(quiet, loop().plant)[quiet.t >= FAULT_AT] ** 2 / 2.0
