"""A wind turbine in full load with pitch actuators, sensors and their faults; the truth of `pitch.py`.

Actuators, sensors, noise, sample rate, speed controller and faults are those of the benchmark of Odgaard, Stoustrup
and Kinnaert (IEEE Transactions on Control Systems Technology 21(4), 2013); rotor and wind are simpler. Three blades
follow one reference, two sensors each; a turbine of 4.8 MW with one inertia, torque at constant power, and an analytic
power coefficient; wind of 14 to 20 m/s with turbulence through two first-order filters.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.linalg import expm

import servoscope as ss
from servoscope.core.arrays import FloatArray
from servoscope.signals import clean

RATE = 100.0
NOISE = 0.2  # degrees, standard deviation of each sensor
HEALTHY, AIR, PRESSURE = (11.11, 0.6), (5.73, 0.45), (3.42, 0.9)  # natural frequency [rad/s] and damping
DYNAMICS = {"air in oil": AIR, "low pressure": PRESSURE}
RAMP_S = {"air in oil": 0.0, "low pressure": 30.0}
ONSET_S = 300.0
SENSORS = ("sensor 1", "sensor 2")
SENSOR_KINDS = {"sensor fixed": "fixed", "sensor gain 1.2": "gain", "sensor offset": "offset"}
FIXED_AT, GAIN, OFFSET = 5.0, 1.2, 0.5  # degrees; ratio; degrees
STEPS = 40  # of the ramp, each with exactly discretised dynamics


def ray(fault: str) -> dict[str, float]:
    """Return the ratios of the coefficients of beta_ref = beta + (2 xi/w) beta' + beta''/w^2 by physics."""
    (w, xi), (to_w, to_xi) = HEALTHY, DYNAMICS[fault]
    return {"inertia": round((w / to_w) ** 2, 4), "viscous_friction": round(to_xi / to_w / (xi / w), 4)}


class Turbine(NamedTuple):
    """A turbine in full load."""

    radius: float = 57.5  # m
    inertia: float = 55e6  # kg m^2, seen from the rotor
    gear: float = 95.0
    rated: float = 162.0  # rad/s of the generator
    power: float = 4.8e6  # W
    efficiency: float = 0.98
    density: float = 1.225  # kg/m^3


def dynamics(w: float, xi: float) -> tuple[FloatArray, FloatArray]:
    """Return A (2, 2) and B (2,) of beta'' = w^2 (beta_ref - beta) - 2 xi w beta', exact for a held reference."""
    A, B = np.array([[0.0, 1.0], [-w * w, -2.0 * xi * w]]), np.array([0.0, w * w])
    exact = expm(A / RATE)
    return exact, np.linalg.solve(A, (exact - np.eye(2)) @ B)


@njit  # type: ignore[untyped-decorator]
def power_coefficient(tip_ratio: float, beta: float) -> float:
    """Return Heier's (1998) analytic power coefficient of a rotor; beta in degrees."""
    inverse = 1.0 / (tip_ratio + 0.08 * beta) - 0.035 / (beta**3 + 1.0)
    value = 0.5176 * (116.0 * inverse - 0.4 * beta - 5.0) * np.exp(-21.0 * inverse) + 0.0068 * tip_ratio
    return max(value, 0.0)


@njit  # type: ignore[untyped-decorator]
def run(
    wind: FloatArray, A: FloatArray, B: FloatArray, which: FloatArray, turbine: tuple[float, ...], rate: float
) -> FloatArray:
    """Return reference and the three pitch angles, shape (N, 4); `which`: the dynamics of blade 1 at each sample."""
    radius, inertia, gear, rated, power, efficiency, density = turbine
    omega, integral, dt = rated, 10.0, 1.0 / rate
    x, out = np.zeros((3, 2)), np.empty((wind.size, 4))
    x[:, 0] = 10.0
    swept = 0.5 * density * np.pi * radius**2
    for k in range(wind.size):
        error = omega - rated
        reference = 4.0 * error + integral
        if -2.0 < reference < 90.0:  # the integral waits at a limit
            integral += error * dt
        reference = min(max(reference, -2.0), 90.0)
        out[k, 0], out[k, 1:] = reference, x[:, 0]
        rotor = omega / gear
        aero = 0.0
        for blade in range(3):
            angle = max(x[blade, 0], -0.9)
            aero += swept * wind[k] ** 3 * power_coefficient(rotor * radius / wind[k], angle) / rotor / 3.0
            i = int(which[k]) if blade == 0 else 0
            a, b = x[blade, 0], x[blade, 1]
            x[blade, 0] = A[i, 0, 0] * a + A[i, 0, 1] * b + B[i, 0] * reference
            x[blade, 1] = A[i, 1, 0] * a + A[i, 1, 1] * b + B[i, 1] * reference
        omega += dt * gear * (aero - power / (efficiency * rotor)) / inertia
        omega = min(max(omega, 0.5 * rated), 1.5 * rated)
    return out


def make_wind(duration_s: float, seed: int) -> FloatArray:
    """Return wind speeds [m/s]: a mean that wanders slowly, and turbulence of 8 % through first-order filters."""
    from scipy.signal import lfilter

    rng, n = np.random.default_rng(seed), int(duration_s * RATE)
    parts = []
    for period_s, std in ((600.0, 1.0), (15.0, 1.1), (2.0, 0.4)):
        a = np.exp(-1.0 / (period_s * RATE))
        start = rng.normal(0.0, std)
        shocks = std * np.sqrt(1.0 - a * a) * rng.normal(size=n)
        parts.append(lfilter([1.0], [1.0, -a], shocks, zi=[a * start])[0])
    return np.asarray(np.clip(rng.uniform(15.5, 18.5) + sum(parts), 13.5, 24.0))


def course(fault: str, samples: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the dynamics A (K, 2, 2), B (K, 2) and which of them blade 1 has at each sample."""
    w, xi = HEALTHY
    to = DYNAMICS.get(fault, HEALTHY)
    shares = np.linspace(0.0, 1.0, STEPS + 1)
    # the benchmark moves w^2 and 2 xi w linearly from healthy to faulty
    squares = (1.0 - shares) * w * w + shares * to[0] ** 2
    damping = (1.0 - shares) * 2.0 * xi * w + shares * 2.0 * to[1] * to[0]
    each = [dynamics(float(np.sqrt(s)), float(d / (2.0 * np.sqrt(s)))) for s, d in zip(squares, damping, strict=True)]
    t = np.arange(samples) / RATE - ONSET_S
    ramp = RAMP_S.get(fault)
    reached = np.zeros(samples) if ramp is None else np.clip(t / ramp if ramp else 1e9 * t, 0.0, 1.0)
    which = np.round(reached * STEPS)
    return np.array([A for A, _ in each]), np.array([B for _, B in each]), which


def measure(fault: str, duration_s: float, seed: int, blades: Sequence[int] = (0,)) -> list[ss.Recording]:
    """Return recordings of some blades, with the fault in blade 1; none: healthy."""
    samples = int(duration_s * RATE)
    out = run(make_wind(duration_s, seed), *course(fault, samples), tuple(Turbine()), RATE)
    rng, t = np.random.default_rng(10_000 + seed), np.arange(samples) / RATE
    found = []
    for blade in range(3):
        x = out[:, 1 + blade, None] + rng.normal(0.0, NOISE, (samples, 2))
        if blade == 0 and fault in SENSOR_KINDS:
            wrong = {
                "fixed": np.full(samples, FIXED_AT),
                "gain": GAIN * x[:, 0],
                "offset": x[:, 0] + OFFSET,
            }[SENSOR_KINDS[fault]]
            x[:, 0] = np.where(t >= ONSET_S, wrong, x[:, 0])
        if blade in blades:
            u = out[:, 0]
            named = dict(zip(SENSORS, x.T, strict=True))
            name = f"{fault or 'healthy'} {seed}, blade {blade + 1}"
            found.append(clean(t, u, u, x.mean(axis=1), name=name, sample_rate=RATE, channels=named))
    return found
