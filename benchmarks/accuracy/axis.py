"""Motor axes that are not quite their model: Stribeck friction, cogging, a belt; simulated apart from the package."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np

import servoscope as ss
from servoscope.core.arrays import FloatArray
from servoscope.signals import clean

RATE = 500.0  # Hz
SUBSTEPS = 16
SECONDS = 60.0
LIMIT = 200.0  # of u [N]
POSITION_GAIN, VELOCITY_GAIN, INTEGRAL_GAIN = 15.0, 900.0, 9000.0
NOISE_Y, NOISE_U = 5e-7, 0.05  # m, N
PITCH = 0.024  # of the magnets [m]


@dataclass(frozen=True)
class Axis:
    """A linear axis: u = M y'' + F_v y' + F_c sign(y'), and what its model leaves out."""

    mass: float = 20.0  # kg
    viscous: float = 80.0  # N s/m
    coulomb: float = 12.0  # N
    gain: float = 1.0  # of what u does
    static: float = 0.0  # N beyond Coulomb friction at speed 0 (Stribeck)
    stribeck_speed: float = 0.02  # m/s
    cogging: float = 0.0  # N
    belt_hz: float = 0.0  # resonance of the load on its belt; 0: rigid
    load_share: float = 0.5  # of the mass that is behind the belt
    load: float = 0.0  # N against the motor
    shift: float = 0.0  # of the sensor [m]
    slack: float = 0.0  # between belt and load, from one end of the gap to the other [m]


AXES = {
    "ideal": Axis(),
    "stribeck": Axis(static=6.0),
    "cogging": Axis(cogging=3.0),
    "belt": Axis(belt_hz=25.0),
}


@numba.njit(cache=True)
def _run(r, axes, switches, n_y, n_u, gains, limit, dt, substeps):  # type: ignore[no-untyped-def]
    """Return u and y; cascade of position and velocity loop, semi-implicit Euler between the samples.

    `axes` (S, 13) holds from the samples `switches` (S,) on.
    """
    N = len(r)
    u, y = np.zeros(N), np.zeros(N)
    x, v, xl, vl, integral, before = r[0], 0.0, r[0], 0.0, 0.0, r[0]
    speed = 0.0
    h = dt / substeps
    at = 0
    for k in range(N):
        while at + 1 < len(switches) and k >= switches[at + 1]:
            at += 1
        m, b, c, gain, static, v_s, cogging, pitch, w, share, load_force, shift, slack = axes[at]
        y[k] = x + shift + n_y[k]
        speed += 0.5 * ((y[k] - before) / dt - speed)
        before = y[k]
        ahead = (r[min(k + 1, N - 1)] - r[k]) / dt
        error = ahead + gains[0] * (r[k] - y[k]) - speed
        want = gains[1] * error + integral
        u[k] = min(max(want, -limit), limit)
        if want == u[k]:
            integral += gains[2] * error * dt
        motor, load = m * (1.0 - share), m * share
        stiffness = w * w * motor * load / m
        for _ in range(substeps):
            friction = c + static * np.exp(-((v / v_s) ** 2))
            force = gain * (u[k] + n_u[k]) - b * v - cogging * np.sin(2.0 * np.pi * x / pitch) - load_force
            if w > 0.0:
                twist = xl - x - min(max(xl - x, -0.5 * slack), 0.5 * slack)
                spring = stiffness * twist + (0.02 * stiffness / w * (vl - v) if twist != 0.0 or slack == 0.0 else 0.0)
                vl -= h * spring / load
                xl += h * vl
                total, force = motor, force + spring
            else:
                total = m
            free = v + h * force / total
            stop = h * friction / total
            v = free - stop if free > stop else (free + stop if free < -stop else 0.0)
            x += h * v
    return u, y


def moves(seed: int, size: float = 0.2, time: float = 1.0, seconds: float = SECONDS) -> FloatArray:
    """Return moves of least jerk between random places within `size` [m], each of 0.8 to 1.6 `time` [s].."""
    rng, t = np.random.default_rng(seed), np.arange(round(seconds * RATE)) / RATE
    r, begin, place = np.zeros(len(t)), 0.5, 0.0
    while begin < seconds:
        lasts, to = time * rng.uniform(0.8, 1.6), rng.uniform(-size, size)
        s = np.clip((t - begin) / lasts, 0.0, 1.0)
        r = np.where(t >= begin, place + (to - place) * (10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5), r)
        begin, place = begin + lasts, to
    return r


def random_motion(seed: int, hz: float = 2.0, acceleration: float = 6.0, seconds: float = SECONDS) -> FloatArray:
    """Return a sum of sines up to `hz` with a root mean square acceleration [m/s^2]."""
    rng, t = np.random.default_rng(seed), np.arange(round(seconds * RATE)) / RATE
    f = rng.uniform(0.1, hz, 40)
    phase, size = rng.uniform(0.0, 2.0 * np.pi, 40), rng.normal(size=40)
    scale = acceleration / np.sqrt(0.5 * ((size * (2.0 * np.pi * f) ** 2) ** 2).sum())
    return np.asarray(scale * (size * np.sin(2.0 * np.pi * f * t[:, None] + phase)).sum(axis=1))


def record(axis: Axis, r: FloatArray, seed: int, faulty: Axis | None = None, at: float = 30.0) -> ss.Recording:
    """Simulate an axis, which is another one from a time on [s]."""
    return record_course([(0.0, axis), (at, faulty or axis)], r, seed)


def record_course(course: Sequence[tuple[float, Axis]], r: FloatArray, seed: int) -> ss.Recording:
    """Simulate an axis that changes: each holds from its time [s] on."""
    rng = np.random.default_rng(seed)
    axes = np.array([_parameters(axis) for _, axis in course])
    switches = np.array([round(at * RATE) for at, _ in course])
    noise_y, noise_u = NOISE_Y * rng.normal(size=len(r)), NOISE_U * rng.normal(size=len(r))
    gains = (POSITION_GAIN, VELOCITY_GAIN, INTEGRAL_GAIN)
    u, y = _run(r, axes, switches, noise_y, noise_u, gains, LIMIT, 1.0 / RATE, SUBSTEPS)
    return _recording(r, u, y, seed)


def _parameters(a: Axis) -> tuple[float, ...]:
    friction = a.mass, a.viscous, a.coulomb, a.gain, a.static, a.stribeck_speed
    belt = 2.0 * np.pi * a.belt_hz, a.load_share
    return (*friction, a.cogging, PITCH, *belt, a.load, a.shift, a.slack)


@functools.cache
def loop() -> ss.Loop:
    """Return the loop file of all axes: a rigid mass with viscous and Coulomb friction."""
    return ss.Loop.from_dict(
        {
            "name": "axis",
            "sample_rate": RATE,
            "input_limits": [-LIMIT, LIMIT],
            "plant": {"kind": "polynomial", "order": 2, "friction": "coulomb", "offset": True},
            "monitor": {"cutoff": 10.0},
        }
    )


def _recording(r: FloatArray, u: FloatArray, y: FloatArray, seed: int) -> ss.Recording:
    return clean(np.arange(len(r)) / RATE, r, u, y, name=f"seed {seed}", sample_rate=RATE)
