"""A servo axis of two masses, apart from the package: LuGre friction, backlash, cogging, torque ripple, temperature.

The motor drives a load through an elastic coupling with clearance; position and speed controllers act on the motor's
encoder. Units: m, N, kg, s; u is the motor current in A. Friction, motor constant and lubricant depend on the
temperature, which is logged. `simulate_axis` integrates with small fixed steps; `derivative` is the same equation for
a general ODE solver.

LuGre friction: Canudas de Wit, Olsson, Astrom, Lischinsky, 1995.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numba
import numpy as np

import servoscope as ss
from servoscope.core.arrays import FloatArray
from servoscope.signals import clean

RATE = 250.0  # Hz
SUBSTEPS = 40  # integration steps per sample
CYCLE_S, CYCLES = 8.0, 4
LIMIT_A = 12.0
REFERENCE_C = 25.0  # temperature of the nominal parameters
COLD_C, WARM_C = 18.0, 34.0  # range of the recordings
NOISE_Y, NOISE_U, RESOLUTION = 5e-7, 0.01, 1e-6  # m, A, m
DAY_FRICTION, DAY_FORCE = 0.015, 0.15  # scatter between days: relative, N
# targets [m] and durations [s] of the production cycle: move, then rest
MOVES = ((0.25, 0.9, 0.5), (0.10, 0.7, 0.4), (0.30, 1.0, 0.5), (0.27, 0.5, 0.4), (0.0, 1.2, 1.9))


class Parameters(NamedTuple):
    """Physical parameters of the axis and gains of its controllers."""

    motor: float = 8.0  # kg, referred to the slide
    load: float = 7.0  # kg
    stiffness: float = 1.3e5  # N/m of the coupling
    damping: float = 70.0  # N s/m of the coupling
    backlash: float = 1.5e-5  # m, whole clearance
    viscous_motor: float = 60.0  # N s/m
    viscous_load: float = 40.0
    coulomb: float = 14.0  # N
    static: float = 20.0  # N
    stribeck_speed: float = 0.02  # m/s
    bristle_stiffness: float = 1e5  # N/m
    bristle_damping: float = 300.0  # N s/m
    motor_constant: float = 20.0  # N/A
    cogging: float = 2.5  # N
    magnet_pitch: float = 0.012  # m
    ripple: float = 0.012  # share of the motor's force
    eccentricity: float = 3e-6  # m, of the encoder
    encoder_pitch: float = 0.010  # m per turn
    force: float = 3.0  # N, of the cable chain
    k_p: float = 25.0  # 1/s
    k_v: float = 70.0  # A s/m
    k_i: float = 2000.0  # A/m
    viscous_per_kelvin: float = -0.022  # relative
    coulomb_per_kelvin: float = -0.006
    constant_per_kelvin: float = -0.0011


INDEX = {name: k for k, name in enumerate(Parameters._fields)}
HEALTHY = Parameters()


@dataclass(frozen=True)
class Change:
    """A fault: factors on parameters from a time on [s]."""

    kind: str
    size: float
    at_s: float = 0.0

    def apply(self, parameters: Parameters) -> Parameters:
        """Return the parameters of the faulty axis."""
        changed = {name: getattr(parameters, name) * self.size for name in KINDS[self.kind]}
        return parameters._replace(**changed)


# what a fault of each kind multiplies
KINDS = {
    "friction": ("coulomb", "static"),
    "backlash": ("backlash",),
    "coupling stiffness": ("stiffness",),
    "payload": ("load",),
    "motor constant": ("motor_constant",),
    "encoder eccentricity": ("eccentricity",),
    "controller gain": ("k_v", "k_i"),
}
# small, medium and large; chosen once so that T^2 of nine features finds about half of them
SIZES = {
    "friction": (1.08, 1.2, 1.5),
    "backlash": (3.0, 8.0, 20.0),
    "coupling stiffness": (0.7, 0.45, 0.25),
    "payload": (1.06, 1.15, 1.4),
    "motor constant": (0.98, 0.95, 0.88),
    "encoder eccentricity": (3.0, 8.0, 20.0),
    "controller gain": (0.9, 0.75, 0.5),
}
MIDDLE_S = 0.5 * CYCLE_S * CYCLES
FAULTS = tuple(Change(kind, size, at_s) for kind in KINDS for size in SIZES[kind] for at_s in (0.0, MIDDLE_S))


@numba.njit(cache=True)
def parameters_at(p, temperature):  # type: ignore[no-untyped-def]
    """Return viscous friction of motor and load, Coulomb and static friction, and motor constant at a temperature."""
    dT = temperature - REFERENCE_C
    viscous = np.exp(p[23] * dT)
    dry = 1.0 + p[24] * dT
    return p[5] * viscous, p[6] * viscous, p[7] * dry, p[8] * dry, p[12] * (1.0 + p[25] * dT)


@numba.njit(cache=True)
def derivative(x, u, p, temperature):  # type: ignore[no-untyped-def]
    """Return the derivative of (motor position, motor speed, load position, load speed, bristle deflection)."""
    b_motor, b_load, coulomb, static, constant = parameters_at(p, temperature)
    position, speed, load, load_speed, z = x
    level = coulomb + (static - coulomb) * np.exp(-((speed / p[9]) ** 2))
    dz = speed - p[10] * abs(speed) / level * z
    # micro-damping vanishes with speed, so that the model stays passive
    friction = p[10] * z + p[11] * np.exp(-((speed / p[9]) ** 2)) * dz
    twist = position - load
    slack = min(max(twist, -0.5 * p[4]), 0.5 * p[4])
    contact = abs(twist) > 0.5 * p[4]
    spring = p[2] * (twist - slack) + (p[3] * (speed - load_speed) if contact else 0.0)
    drive = constant * u * (1.0 + p[15] * np.sin(12.0 * np.pi * position / p[14]))
    drive -= p[13] * np.sin(2.0 * np.pi * position / p[14])
    return np.array(
        [
            speed,
            (drive - spring - friction - b_motor * speed) / p[0],
            load_speed,
            (spring - b_load * load_speed - p[18]) / p[1],
            dz,
        ]
    )


@numba.njit(cache=True)
def measure(position, p, noise, resolution):  # type: ignore[no-untyped-def]
    """Return what the motor's encoder shows."""
    y = position + p[16] * np.sin(2.0 * np.pi * position / p[17]) + noise
    return resolution * np.round(y / resolution) if resolution > 0.0 else y


@numba.njit(cache=True)
def control(p, state, r, ahead, y, dt):  # type: ignore[no-untyped-def]
    """Return u and advance the controller's state (integral, filtered speed, last y) in place."""
    state[1] += 0.5 * ((y - state[2]) / dt - state[1])
    state[2] = y
    error = ahead + p[19] * (r - y) - state[1]
    want = p[20] * error + state[0]
    u = min(max(want, -LIMIT_A), LIMIT_A)
    if u == want:
        state[0] += p[21] * error * dt
    return u


@numba.njit(cache=True)
def _run(r, healthy, faulty, switch, temperature, noise, dt, substeps, resolution):  # type: ignore[no-untyped-def]
    N = len(r)
    u, y = np.zeros(N), np.zeros(N)
    x, state, h = np.zeros(5), np.zeros(3), dt / substeps
    for k in range(N):
        p = healthy if k < switch else faulty
        y[k] = measure(x[0], p, noise[0, k], resolution)
        ahead = (r[min(k + 1, N - 1)] - r[k]) / dt
        u[k] = control(p, state, r[k], ahead, y[k], dt)
        for _ in range(substeps):  # the midpoint rule
            half = x + 0.5 * h * derivative(x, u[k] + noise[1, k], p, temperature[k])
            x = x + h * derivative(half, u[k] + noise[1, k], p, temperature[k])
    return u, y


def production(speed: float = 1.0, cycles: int = CYCLES) -> FloatArray:
    """Return the reference of the production cycle, moves of least jerk and rests, at a share of its speed."""
    t = np.arange(round(CYCLE_S / speed * cycles * RATE)) / RATE * speed % CYCLE_S
    r, begin, place = np.zeros(len(t)), 0.0, 0.0
    for target, duration, rest in MOVES:
        s = np.clip((t - begin) / duration, 0.0, 1.0)
        r = np.where(t >= begin, place + (target - place) * (10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5), r)
        begin, place = begin + duration + rest, target
    return r


def simulate_axis(
    parameters: Parameters,
    r: FloatArray,
    temperature: FloatArray,
    noise: FloatArray,
    change: Change | None = None,
    resolution: float = RESOLUTION,
) -> tuple[FloatArray, FloatArray]:
    """Return u and y, shape (N,) each; `noise`: of y and of the current, shape (2, N)."""
    faulty = parameters if change is None else change.apply(parameters)
    switch = len(r) if change is None else round(change.at_s * RATE)
    arrays = np.array(parameters), np.array(faulty)
    return _run(r, *arrays, switch, temperature, noise, 1.0 / RATE, SUBSTEPS, resolution)


def record_day(
    seed: int, change: Change | None = None, start_c: float | None = None, speed: float = 1.0
) -> ss.Recording:
    """Return the recording of a day, seeded: the axis scatters from day to day and warms while it runs."""
    rng = np.random.default_rng(seed)
    r = production(speed)
    begin = rng.uniform(COLD_C, WARM_C - 1.5) if start_c is None else start_c
    warming = rng.uniform(0.3, 1.5)
    temperature = begin + warming * (1.0 - np.exp(-np.arange(len(r)) / RATE / 20.0))
    day = 1.0 + DAY_FRICTION * rng.normal(size=2)
    scattered = HEALTHY._replace(
        coulomb=HEALTHY.coulomb * day[0],
        static=HEALTHY.static * day[0],
        viscous_motor=HEALTHY.viscous_motor * day[1],
        viscous_load=HEALTHY.viscous_load * day[1],
        force=HEALTHY.force + DAY_FORCE * rng.normal(),
    )
    noise = np.array([[NOISE_Y], [NOISE_U]]) * rng.normal(size=(2, len(r)))
    u, y = simulate_axis(scattered, r, temperature, noise, change)
    logged = temperature + 0.1 * rng.normal(size=len(r))
    name = "healthy" if change is None else f"{change.kind} x {change.size:g} from {change.at_s:g} s"
    recording = clean(np.arange(len(r)) / RATE, r, u, y, name=f"{name} #{seed}", sample_rate=RATE)
    return replace(recording, channels={"temperature": logged})


def learned_days(count: int = 7, seed: int = 0) -> list[ss.Recording]:
    """Return the healthy days that are learned from; their temperatures are spread over the range."""
    order = np.random.default_rng(seed).permutation(count)
    starts = COLD_C + (WARM_C - 1.5 - COLD_C) * order / (count - 1.0)
    return [record_day(1000 * seed + k, start_c=float(start)) for k, start in enumerate(starts)]


def healthy_days(count: int = 32, seed: int = 0) -> list[ss.Recording]:
    """Return further healthy days."""
    return [record_day(1000 * seed + 100 + k) for k in range(count)]


def faulty_days(changes: Sequence[Change] = FAULTS, seed: int = 0) -> list[ss.Recording]:
    """Return one day per fault."""
    return [record_day(1000 * seed + 200 + k, change) for k, change in enumerate(changes)]
