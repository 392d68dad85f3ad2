"""Logs of a motor that moves a load by a belt, under a P-PI cascade, along moves that do not repeat."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]
INERTIA, VISCOUS, COULOMB = 0.625, 1.2, 1.0
MOTOR, RESONANCE_HZ, DAMPING = 0.4, 45.0, 0.03  # inertia of the motor; of the belt between it and the load
STEP_S, CONTROL_STEPS = 1e-4, 5
POSITION_GAIN, SPEED_HZ, INTEGRAL_HZ = 25.0, 15.0, 3.0  # of the cascade; the last two are corner frequencies
TORQUE_NOISE, ENCODER_STEP = 0.03, 2e-6
FILTER_S = 0.04  # over which the set point is averaged, as controllers do against jerk


def random_moves(rng: np.random.Generator, samples: int, rate: float) -> Array:
    """Return trapezoidal moves to random places, at random speeds and accelerations, with rests between them."""
    pieces, position, total = [np.zeros(round(rate))], 0.0, round(rate)
    while total < samples:
        target = rng.uniform(-0.4, 0.4)
        distance, acceleration = abs(target - position), rng.uniform(1.0, 5.0)
        speed = min(rng.uniform(0.3, 1.2), np.sqrt(distance * acceleration))
        ramp = speed / acceleration
        t = np.arange(1, int((distance / speed + ramp) * rate) + 2) / rate
        path = np.cumsum(np.clip(np.minimum(t, distance / speed + ramp - t) / ramp, 0.0, 1.0))
        pieces.append(position + (target - position) * path / path[-1])
        pieces.append(np.full(int(rng.uniform(0.0, 0.6) * rate), target))
        position, total = target, total + len(pieces[-2]) + len(pieces[-1])
    width = round(FILTER_S * rate)
    return np.convolve(np.concatenate(pieces), np.ones(width) / width)[:samples]


@njit(cache=False)  # type: ignore[untyped-decorator]
def _run(r: Array, noise: Array, steps: int) -> tuple[Array, Array]:
    load = INERTIA - MOTOR
    w = 2.0 * np.pi * RESONANCE_HZ
    stiffness, damping = MOTOR * load / INERTIA * w**2, 2.0 * DAMPING * MOTOR * load / INERTIA * w
    speed_gain = INERTIA * 2.0 * np.pi * SPEED_HZ
    u_log, y_log = np.zeros(len(r)), np.zeros(len(r))
    x, v, x_load, v_load, integral, u = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(r)):
        y_log[i] = np.round(x / ENCODER_STEP) * ENCODER_STEP
        following = r[min(i + 1, len(r) - 1)]
        for k in range(steps):
            if k % CONTROL_STEPS == 0:
                error = POSITION_GAIN * (r[i] + (following - r[i]) * k / steps - x) - v
                integral += speed_gain * 2.0 * np.pi * INTEGRAL_HZ * error * STEP_S * CONTROL_STEPS
                u = speed_gain * error + integral + noise[i]
            if k == 0:
                u_log[i] = u
            belt = stiffness * (x - x_load) + damping * (v - v_load)
            v += STEP_S / MOTOR * (u - belt - 0.5 * VISCOUS * v)
            v_load += STEP_S / load * (belt - 0.5 * VISCOUS * v_load)
            # half of the dry friction acts on either mass: it stops what it can stop in this step (Karnopp, 1985)
            v -= np.sign(v) * min(abs(v), 0.5 * STEP_S / MOTOR * COULOMB)
            v_load -= np.sign(v_load) * min(abs(v_load), 0.5 * STEP_S / load * COULOMB)
            x += STEP_S * v
            x_load += STEP_S * v_load
    return u_log, y_log


def belt_axis(seed: int, seconds: float = 60.0, rate: float = 250.0) -> dict[str, Array]:
    """Return the columns t, r, u and y of a log."""
    rng = np.random.default_rng(seed)
    samples = round(seconds * rate)
    r = random_moves(rng, samples, rate)
    u, y = _run(r, TORQUE_NOISE * rng.standard_normal(samples), round(1.0 / rate / STEP_S))
    return {"t": np.arange(samples) / rate, "r": r, "u": u, "y": y}


def write_belt_axis(path: Path, seed: int, seconds: float = 60.0, rate: float = 250.0) -> Path:
    """Write such a log as CSV."""
    columns = belt_axis(seed, seconds, rate)
    np.savetxt(path, np.column_stack([*columns.values()]), "%.9g", ",", header=",".join(columns), comments="")
    return path
