"""Logs of simulated loops: servo loops with known defects of the recording, and valves that stick or do not."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from servoscope.signals.samples import Samples

Floats = npt.NDArray[np.float64]

ROWS, RATE_HZ = 3000, 50.0
FROZEN_S, SATURATED, COMPRESSED = 2.0, 0.05, 10
DEFECTS = {
    "none": (),
    "saturation, 5 % of the time": ("u at its upper limit",),
    "freezing of 2 s": ("frozen y",),
    "compression 10:1, lines": ("straight lines in y",),
    "compression 10:1, held": ("straight lines in y",),
    "manual for half of the log": ("u does not react",),
}


def loops(number: int, seed: int) -> tuple[Floats, Floats, Floats]:
    """Return r, u and y of speed loops under PI control, shape (number, N): noise, friction, and grids are drawn."""
    rng = np.random.default_rng(seed)
    t = np.arange(ROWS) / RATE_HZ
    waves = rng.uniform(0.05, 1.0, (3, number, 1)), rng.uniform(0.1, 1.0, (3, number, 1))
    r = sum(a * np.sin(2.0 * np.pi * f * t + 6.0 * a) for f, a in zip(*waves, strict=True))
    steps = np.repeat(rng.standard_normal((number, ROWS // 250)), 250, axis=1)
    r = np.where(rng.random((number, 1)) < 0.5, steps, r)
    noise, lag, gain = (
        10.0 ** rng.uniform(low, high, number) for low, high in ((-3.5, -1.5), (-1.3, -0.3), (-0.3, 0.7))
    )
    lag = np.maximum(lag, 3.0 * (1.0 + gain) / RATE_HZ)  # the loop is stable as sampled
    friction = rng.uniform(0.0, 0.3, number)
    u, y, speed, total = np.zeros_like(r), np.zeros_like(r), np.zeros(number), np.zeros(number)
    measured = rng.standard_normal(r.shape) * noise[:, None]
    for k in range(ROWS):
        y[:, k] = speed + measured[:, k]
        e = r[:, k] - y[:, k]
        total += e / RATE_HZ
        u[:, k] = gain * (e + total / (3.0 * lag))
        speed = speed + (u[:, k] - friction * np.tanh(speed / 0.05) - speed) * np.minimum(1.0 / RATE_HZ / lag, 0.5)
    grid = np.where(rng.random(number) < 0.3, np.ptp(y, axis=1) / 4096.0, 0.0)[:, None]
    y = np.where(grid > 0.0, np.round(y / np.maximum(grid, 1e-300)) * grid, y)
    return r, u, y


def spoil(defect: str, r: Floats, u: Floats, y: Floats, rng: np.random.Generator) -> Samples:
    """Return one log with a defect."""
    u, y, t = u.copy(), y.copy(), np.arange(ROWS) / RATE_HZ
    if defect.startswith("saturation"):
        u = np.minimum(u, np.quantile(u, 1.0 - SATURATED))
    elif defect.startswith("freezing"):
        first = int(rng.integers(100, ROWS - 300))
        y[first : first + int(FROZEN_S * RATE_HZ)] = y[first]
    elif defect.startswith("compression"):
        kept = np.arange(0, ROWS, COMPRESSED)
        held = defect.endswith("held")
        u, y = (x[kept[np.arange(ROWS) // COMPRESSED]] if held else np.interp(t, t[kept], x[kept]) for x in (u, y))
    elif defect.startswith("manual"):
        u[ROWS // 2 :] = u[ROWS // 2]
    return Samples.from_columns(t, r, u, y)


def logs(number: int, seed: int) -> Iterator[tuple[str, Samples]]:
    """Yield defect and samples, each defect `number` times."""
    r, u, y = loops(number, seed)
    rng = np.random.default_rng([seed, 1])
    for defect in DEFECTS:
        for k in range(number):
            yield defect, spoil(defect, r[k], u[k], y[k], rng)


def valve_logs(number: int, noise: float, seed: int) -> Iterator[tuple[bool, Samples]]:
    """Yield whether the valve sticks, and samples of process loops under PI control, `number` of each.

    A valve sticks by 1 to 5 % of the range of u (two parameters: Choudhury, Thornhill and Shah, Control Eng. Practice
    13, 2005, 641); noise: its standard deviation as a share of half of that. The others have a load that swings.
    """
    for k in range(2 * number):
        yield k % 2 == 0, _valve_log(k % 2 == 0, noise, np.random.default_rng([seed, k]))


def _valve_log(sticks: bool, noise: float, rng: np.random.Generator) -> Samples:
    rows, dead, lag = 1500, int(rng.integers(1, 6)), rng.uniform(5.0, 30.0)
    speed = 1.0 / lag
    gain, reset = lag / (dead + rng.uniform(1.0, 2.5) * max(dead, lag / 4.0)), lag
    integrates = bool(rng.random() < 0.25)
    if integrates:
        speed, gain, reset = 0.05, 20.0 / (3.0 * max(dead, 3)), 12.0 * max(dead, 3)
    band = rng.uniform(1.0, 5.0)
    jump = band * rng.uniform(0.3, 1.0)
    swing, period = rng.uniform(0.5, 1.5), rng.uniform(40.0, 200.0)
    drift, white = rng.standard_normal((2, rows))
    u, y, stem, level, total, load = np.zeros(rows), np.zeros(rows), np.zeros(rows), 0.0, 0.0, 0.0
    for k in range(rows):
        y[k] = level + noise * (0.5 * band if sticks else 1.0) * white[k]
        total -= gain * y[k] / reset
        u[k] = total - gain * y[k]
        stem[k] = stem[k - 1] if sticks else u[k]
        if abs(u[k] - stem[k]) > 0.5 * (band + jump):
            stem[k] = u[k] - np.sign(u[k] - stem[k]) * 0.5 * (band - jump)
        load = 0.97 * load + 0.05 * drift[k]
        flow = stem[max(k - dead, 0)] + load + (0.0 if sticks else swing * np.sin(2.0 * np.pi * k / period))
        level += speed * (flow if integrates else flow - level)
    return Samples.from_columns(10.0 * np.arange(rows), np.full(rows, 50.0), 50.0 + u, 50.0 + y)
