"""The exact predictor of the closed loop: standardised innovations, and what a change adds to them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

import servoscope as ss
from accuracy.rig import FAULT_AT, loop
from servoscope.plants import FloatArray, Plant
from servoscope.simulation import FaultEvent, reference
from servoscope.simulation.closed_loop import NOISE_U_STD, NOISE_Y_STD
from servoscope.simulation.discretise import discretise


class Predictor(NamedTuple):
    """Transfer functions from y and u to the innovation e = y - y_hat, over one denominator, and its variance S."""

    from_y: FloatArray
    from_u: FloatArray
    denominator: FloatArray
    S: float


def predictor(plant: Plant, u_std: float = NOISE_U_STD, y_std: float = NOISE_Y_STD) -> Predictor:
    """Return the steady Kalman predictor of y for white noise that enters with u and adds to y.

    ``x(k+1) = A x + b (u + n_u), y = c x + n_y``. The controller's u is known, so the loop being closed changes
    nothing (Anderson and Moore, 1979, chapter 9).
    """
    from scipy import linalg, signal

    d = discretise(plant.state_space(), loop().sample_rate)
    # states in SI differ by ten decades, which the Riccati equation would not survive
    _, (scale, _) = linalg.matrix_balance(d.A, permute=False, separate=True)
    A, b, c = d.A * scale / scale[:, None], d.b_now / scale, d.c * scale
    P = linalg.solve_discrete_are(A.T, c[:, None], u_std**2 * np.outer(b, b), np.array([[y_std**2]]))
    S = float(c @ P @ c) + y_std**2
    K = A @ P @ c / S
    closed = A - np.outer(K, c)
    numerators, denominator = zip(
        *(signal.ss2tf(closed, column[:, None], -c[None, :], [[direct]]) for column, direct in ((K, 1.0), (b, 0.0))),
        strict=True,
    )
    return Predictor(numerators[0][0], numerators[1][0], denominator[0], S)


def innovations(p: Predictor, recording: ss.Recording) -> FloatArray:
    """Return the innovations of a recording that begins at rest, in standard deviations, shape (N,)."""
    from scipy.signal import lfilter

    e = lfilter(p.from_y, p.denominator, recording.y) + lfilter(p.from_u, p.denominator, recording.u)
    return np.asarray(e / np.sqrt(p.S))


def information(fault: FaultEvent, kind: str, seconds: float) -> FloatArray:
    """Return the Kullback-Leibler information of each sample after a change [nat].

    The change moves the mean of the healthy innovations by what the noise-free faulty loop leaves of them: half of
    its square in variances. It changes the noise's colour too; that adds less than 3 % here and is left out.
    """
    r = reference(kind, seconds, loop().sample_rate)
    quiet, _ = ss.simulate(loop(), r, faults=(fault,), noise_u_std=0.0, noise_y_std=0.0)
    return innovations(predictor(loop().plant), quiet)[quiet.t >= FAULT_AT] ** 2 / 2.0
