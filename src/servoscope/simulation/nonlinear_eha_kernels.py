"""The compiled loop of the nonlinear rig: controller, valve, oil, friction and stops."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.jit import maximum, sqrt, where
from servoscope.core.jit.array_function import ArrayFunction
from servoscope.core.jit.arrays import Array, Variable
from servoscope.simulation.linear_kernels import (
    HEADER_SIZE,
    INTEGRAL,
    ControllerConstants,
    control_step,
    runge_kutta_step,
)


def derivative(printer: Any, p: Any, row: Any, drive: Any, x: Sequence[Any]) -> list[Any]:
    """Return the time derivative of x = [y, y', p_L, spool, spool'] under a held drive; row as in `run_rig`."""
    speed, pressure = x[1], x[2]
    has_valve = p.valve > 0.0
    spool = where(has_valve, x[3], drive)
    flow, friction = row[0] * spool, Variable(printer, row[3] * speed)
    extends = flow > 0.0
    if p.square_root:
        left = where(extends, 1.0 - pressure * row[1], p.area_ratio + pressure * row[1])
        flow = flow * where(left >= 0.0, sqrt(left), -sqrt(-left))
    else:
        flow = flow * where(extends, 1.0, sqrt(p.area_ratio))
    with printer.when(p.coulomb + p.breakaway > 0.0):
        ratio = speed / p.stribeck_speed
        stribeck = p.coulomb + p.breakaway * printer.call_library("exp", -ratio * ratio)
        friction.value = friction.value + stribeck * printer.call_library("tanh", speed / p.smooth_speed)
    return [
        speed,
        (p.area * pressure - friction.value - p.stiffness * x[0]) * p.mobility,
        (flow - row[2] * pressure - p.area * speed) * row[4],
        where(has_valve, x[4], 0.0),
        where(has_valve, p.valve * (p.valve * (drive - x[3]) - 2.0 * p.damping * x[4]), 0.0),
    ]


def integrate_state(printer: Any, p: Any, row: Any, x: Any, drive: Any, duration: Any) -> None:
    """Move the state x (5,) on under a held drive: Runge and Kutta's fourth order.

    A stop takes all momentum: beyond it the piston is put back and rests.
    """
    steps = maximum(printer.truncate((printer.number(p.substeps) * duration / p.T - 1e-9).call("ceil")), 1)
    h = duration / printer.number(steps)
    for _ in printer.loop(0, steps):
        runge_kutta_step(x, 5, h, functools.partial(derivative, printer, p, row, drive))
        with printer.when(abs(x[0]) >= p.half_stroke):
            x[0] = where(x[0] > 0.0, p.half_stroke, -p.half_stroke)
            x[1] = where(x[0] * x[1] > 0.0, 0.0, x[1])


def run_rig(
    rig: Mapping[str, Any], settings: ControllerConstants, rows: FloatArray, r: FloatArray, n_u: FloatArray,
    n_y: FloatArray, s: FloatArray, u: FloatArray, limited: FloatArray, acting: FloatArray, y: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Run the closed loop of the rig, and carry s (HEAD + 5,) on: see `servoscope.simulation.linear_kernels`.

    `rig` holds the constants of the rig by name; ``rows`` (N, 5) flow gain, 1/p_s, leakage, viscous friction and
    1/capacity from each sample to the next; r, n_u, n_y have shape (N,). Writes u, u after the limits, what acts on the
    valve before the delay (m + 2 + N,), and y; returns y as measured, load pressure and spool, each (N,).
    """
    measured, pressure, spool = np.empty((3, r.size))
    signals = rows, r, n_u, n_y, s, u, limited, acting, y, measured, pressure, spool
    _run_rig(tuple(rig.values()), settings, *signals, names=tuple(rig))
    return measured, pressure, spool


@ArrayFunction
def _run_rig(
    printer: Any, rig: Any, settings: ControllerConstants, rows: Any, r: Any, n_u: Any, n_y: Any, s: Any,
    u: Any, limited: Any, acting: Any, y: Any, measured: Any, pressure: Any, spool: Any, *, names: tuple[str, ...],
) -> None:  # fmt: skip
    p = SimpleNamespace(**dict(zip(names, rig, strict=True)))
    m, x, total = settings.delay_samples, Array.scratch(printer, "double", 5), Variable(printer, s[INTEGRAL])
    past, first = m + 2, settings.delay_fraction * p.T
    for i in range(5):
        x[i] = s[HEADER_SIZE + i]
    for k in printer.loop(0, r.shape[0]):
        y[k], pressure[k], spool[k] = x[0], x[2], x[3]
        seen = x[0] + n_y[k]
        rounded = p.resolution * (seen / p.resolution).call("rint")
        measured[k] = where(p.resolution > 0.0, rounded, seen)
        error = measured[k] - x[0]
        u[k], limited[k], acting[past + k], total.value = control_step(
            settings, r[k], n_u[k], error, x[0], 0.0, total.value
        )
        now, late = acting[past + k - m], acting[past + k - 1 - m]
        with printer.when(settings.delay_fraction > 0.0):
            integrate_state(printer, p, rows[k], x, late, first)
        integrate_state(printer, p, rows[k], x, now, (1.0 - settings.delay_fraction) * p.T)
        x[3], x[4] = where(p.valve > 0.0, x[3], now), where(p.valve > 0.0, x[4], 0.0)
    for i in range(5):
        s[HEADER_SIZE + i] = x[i]
    s[INTEGRAL] = total.value
