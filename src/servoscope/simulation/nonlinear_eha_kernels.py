"""The compiled loop of the nonlinear rig: controller, valve, oil, friction and stops; importing this imports numba."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.jit import kernel, subroutine
from servoscope.simulation.linear_kernels import HEADER_SIZE, INTEGRAL, ControllerConstants, control_step


class RigConstants(NamedTuple):
    """What does not change during a recording, in plain numbers and SI units."""

    mobility: float  # 1/m_p: there are no divisions in the innermost loop
    stiffness: float
    area: float
    square_root: bool
    coulomb: float
    breakaway: float  # static friction beyond Coulomb friction
    stribeck_speed: float
    smooth_speed: float
    half_stroke: float
    valve: float  # natural frequency in rad/s; 0: the spool follows at once
    damping: float
    resolution: float  # of the position sensor; 0: continuous
    T: float
    substeps: int


@subroutine
def derivative(p: RigConstants, row: FloatArray, x: FloatArray, drive: float, out: FloatArray) -> None:
    """Write the time derivative of x = [y, y', p_L, spool, spool'] under a held drive to `out`; row as in `run_rig`."""
    speed, pressure = x[1], x[2]
    spool = x[3] if p.valve > 0.0 else drive
    flow = row[0] * spool
    if p.square_root:
        left = 1.0 - pressure * row[1] if spool > 0.0 else 1.0 + pressure * row[1]
        flow *= np.sqrt(left) if left >= 0.0 else -np.sqrt(-left)
    friction = row[3] * speed
    if p.coulomb + p.breakaway > 0.0:
        ratio = speed / p.stribeck_speed
        friction += (p.coulomb + p.breakaway * np.exp(-ratio * ratio)) * np.tanh(speed / p.smooth_speed)
    out[0] = speed
    out[1] = (p.area * pressure - friction - p.stiffness * x[0]) * p.mobility
    out[2] = (flow - row[2] * pressure - p.area * speed) * row[4]
    if p.valve > 0.0:
        out[3] = x[4]
        out[4] = p.valve * (p.valve * (drive - x[3]) - 2.0 * p.damping * x[4])


@subroutine
def integrate_state(
    p: RigConstants, row: FloatArray, x: FloatArray, drive: float, duration: float, k: FloatArray
) -> None:
    """Move the state x (5,) on under a held drive: Runge and Kutta's fourth order; k (5, 5) is room to work in.

    A stop takes all momentum: beyond it the piston is put back and rests.
    """
    steps = max(1, int(np.ceil(p.substeps * duration / p.T - 1e-9)))
    h = duration / steps
    at = k[4]
    n = 5 if p.valve > 0.0 else 3
    for _ in range(steps):
        derivative(p, row, x, drive, k[0])
        for i in range(n):
            at[i] = x[i] + 0.5 * h * k[0, i]
        derivative(p, row, at, drive, k[1])
        for i in range(n):
            at[i] = x[i] + 0.5 * h * k[1, i]
        derivative(p, row, at, drive, k[2])
        for i in range(n):
            at[i] = x[i] + h * k[2, i]
        derivative(p, row, at, drive, k[3])
        for i in range(n):
            x[i] += h / 6.0 * (k[0, i] + 2.0 * k[1, i] + 2.0 * k[2, i] + k[3, i])
        if abs(x[0]) >= p.half_stroke:
            x[0] = p.half_stroke if x[0] > 0.0 else -p.half_stroke
            if x[0] * x[1] > 0.0:
                x[1] = 0.0


@kernel
def run_rig(
    p: RigConstants, settings: ControllerConstants, rows: FloatArray, r: FloatArray, n_u: FloatArray,
    n_y: FloatArray, s: FloatArray, u: FloatArray, limited: FloatArray, acting: FloatArray, y: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Run the closed loop of the rig, and carry s (HEAD + 5,) on: see `servoscope.simulation.linear_kernels`.

    ``rows`` (N, 5) holds flow gain, 1/p_s, leakage, viscous friction and 1/capacity from each sample to the next; r,
    n_u, n_y have shape (N,). Writes u, u after the limits, what acts on the valve before the delay (m + 2 + N,), and y;
    returns y as measured, load pressure and spool, each (N,).
    """
    N, m = r.size, settings.delay_samples
    measured, pressure, spool = np.empty(N), np.empty(N), np.empty(N)
    x, room, past = s[HEADER_SIZE : HEADER_SIZE + 5], np.empty((5, 5)), m + 2
    total = s[INTEGRAL]
    for k in range(N):
        y[k], pressure[k], spool[k] = x[0], x[2], x[3]
        measured[k] = y[k] + n_y[k]
        if p.resolution > 0.0:
            measured[k] = p.resolution * np.rint(measured[k] / p.resolution)
        error = measured[k] - y[k]
        u[k], limited[k], acting[past + k], total = control_step(settings, r[k], n_u[k], error, y[k], 0.0, total)
        now, late = acting[past + k - m], acting[past + k - 1 - m]
        if settings.delay_fraction > 0.0:
            integrate_state(p, rows[k], x, late, settings.delay_fraction * p.T, room)
        integrate_state(p, rows[k], x, now, (1.0 - settings.delay_fraction) * p.T, room)
        if p.valve == 0.0:
            x[3], x[4] = now, 0.0
    s[INTEGRAL] = total
    return measured, pressure, spool
