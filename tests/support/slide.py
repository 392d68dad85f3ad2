"""Logs of a rigid slide under a P-PI cascade at 2 kHz, with dry friction, thinned out to the rate of a slower log."""

from __future__ import annotations

import numpy as np
from belt_axis import (
    COULOMB,
    ENCODER_STEP,
    INERTIA,
    INTEGRAL_HZ,
    POSITION_GAIN,
    SPEED_HZ,
    TORQUE_NOISE,
    VISCOUS,
    Array,
    random_moves,
)
from numba import njit

CONTROL_RATE, SUB_STEPS = 2000.0, 10


@njit(cache=False)  # type: ignore[untyped-decorator]
def _run(r: Array, noise: Array, coulomb: Array) -> tuple[Array, Array]:
    speed_gain = INERTIA * 2.0 * np.pi * SPEED_HZ
    step = 1.0 / CONTROL_RATE / SUB_STEPS
    u, y = np.zeros(len(r)), np.zeros(len(r))
    x, v, integral = 0.0, 0.0, 0.0
    for i in range(len(r)):
        y[i] = np.round(x / ENCODER_STEP) * ENCODER_STEP
        error = POSITION_GAIN * (r[i] - x) - v
        integral += speed_gain * 2.0 * np.pi * INTEGRAL_HZ * error / CONTROL_RATE
        u[i] = speed_gain * error + integral + noise[i]
        for _ in range(SUB_STEPS):
            v += step / INERTIA * (u[i] - VISCOUS * v)
            v -= np.sign(v) * min(abs(v), step / INERTIA * coulomb[i])  # Karnopp (1985)
            x += step * v
    return u, y


def slide(seed: int, seconds: float, rate: float, ratio: float = 1.0) -> dict[str, Array]:
    """Return the columns t, r, u and y; Coulomb friction changes by a ratio half-way. A seed is one motion."""
    rng, samples = np.random.default_rng(seed), round(seconds * CONTROL_RATE)
    r = random_moves(rng, samples, CONTROL_RATE)
    coulomb = np.where(np.arange(samples) < samples / 2, COULOMB, ratio * COULOMB)
    u, y = _run(r, TORQUE_NOISE * rng.standard_normal(samples), coulomb)
    every = round(CONTROL_RATE / rate)
    columns = {"t": np.arange(samples) / CONTROL_RATE, "r": r, "u": u, "y": y}
    return {name: column[::every] for name, column in columns.items()}
