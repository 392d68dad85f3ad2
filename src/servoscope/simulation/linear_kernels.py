"""The compiled inner loops: PI controller and plant, sample by sample; importing this file imports numba.

The state that a loop carries from chunk to chunk is one row of floats, zero before the first sample: the controller's
sum, the number of the last plant (counted from 1), and the plant's state. What acts on the plant has the m + 2 samples
before the chunk in front of its own. All arrays come from outside: kernels that neither allocate nor slice compile
three times as fast.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray, IntArray
from servoscope.core.errors import SimulationError
from servoscope.core.jit import kernel, subroutine
from servoscope.models.discretise import transition
from servoscope.models.plants import Column, Plant

if TYPE_CHECKING:
    from servoscope.models.loop import Loop


INTEGRAL, LAST_PLANT, HEADER_SIZE = 0, 1, 2  # places in the row; the plant's state follows the head


class ControllerConstants(NamedTuple):
    """The controller and what lies between it and the plant, in plain numbers."""

    proportional_gain: float  # k_p
    integral_gain: float  # k_i T
    low: float  # limits of u
    high: float
    deadzone_low: float  # dead zone: nothing passes; empty if low > high
    deadzone_high: float
    delay_samples: int  # whole samples of the delay
    delay_fraction: float  # and the rest of it, 0 to 1 sample


class AxisConstants(NamedTuple):
    """A motor axis of order 1 or 2 per plant p and direction d (0 forward, 1 backward) over one sub-step."""

    order: int
    Phi: FloatArray  # (p, d, 2, 2), of (y, y')
    g: FloatArray  # (p, d, 2), response to a unit force
    gain: FloatArray  # (p,), input_gain
    stiffness: FloatArray  # (p,)
    coulomb: FloatArray  # (p,)
    offset: FloatArray  # (p,)
    # (p, 2), force at no speed and one over the speed of half of it, of Stribeck friction
    stribeck: FloatArray
    load: FloatArray  # (p, 3), amplitude, factor on y and phase of the friction that follows the magnitude of a sine
    waves: FloatArray  # (p, w, 3), amplitude, factor on y and phase of each force that is a sine of y
    steps: int  # sub-steps per sample
    speed: bool  # whether y is the speed


@subroutine
def control_step(
    settings: ControllerConstants, r: float, n_u: float, n_y: float, free: float, share: float, total: float
) -> tuple[float, float, float, float]:
    """One update u = k_p e + k_i T sum e; returns u, u after the limits, what acts on the plant, the new sum.

    ``free`` is y without the present u and ``share`` how much of u reaches y at once, with a first-order
    hold only: then u and y follow together from one linear equation, whose solution a limit just clips.
    """
    gain = settings.proportional_gain + settings.integral_gain
    u = (gain * (r - n_y - free - share * n_u) + total) / (1.0 + gain * share)
    limited = min(max(u, settings.low), settings.high)
    passed = 0.0 if settings.deadzone_low <= limited <= settings.deadzone_high else limited
    e = r - n_y - free - share * (passed + n_u)
    return gain * e + total, limited, passed + n_u, total + settings.integral_gain * e


@functools.partial(kernel, heap=False)
def run_linear(
    A: FloatArray, b_next: FloatArray, b_now: FloatArray, b_late: FloatArray, c: FloatArray, fresh: FloatArray,
    which: IntArray, settings: ControllerConstants, r: FloatArray, n_u: FloatArray, n_y: FloatArray, s: FloatArray,
    u: FloatArray, limited: FloatArray, acting: FloatArray, y: FloatArray,
) -> None:  # fmt: skip
    """Run the closed loop of linear plants; which[k] names the plant from sample k to k + 1.

    Shapes: A (p, n, n), b_next, b_now, b_late, c (p, n), fresh (n,) to work in; which, r, n_u, n_y (N,). Writes u, u
    after the limits, and y without noise, each (N,), what acts on the plant (m + 2 + N,), and carries s (HEAD + n,) on.
    """
    N, n, m = len(r), len(fresh), settings.delay_samples
    past, total, last = m + 2, s[INTEGRAL], int(s[LAST_PLANT])
    for k in range(N):
        p = which[k - 1] if k > 0 else max(last - 1, 0)
        free = 0.0
        share = 0.0
        if k > 0 or last > 0:
            ahead = acting[past + k - m] if m > 0 else 0.0
            now = acting[past + k - 1 - m]
            late = acting[past + k - 2 - m]
            for i in range(n):
                value = b_next[p, i] * ahead + b_now[p, i] * now + b_late[p, i] * late
                for j in range(n):
                    value += A[p, i, j] * s[HEADER_SIZE + j]
                fresh[i] = value
                free += c[p, i] * value
                if m == 0:
                    share += c[p, i] * b_next[p, i]
            for i in range(n):
                s[HEADER_SIZE + i] = fresh[i]
        u[k], limited[k], drive, total = control_step(settings, r[k], n_u[k], n_y[k], free, share, total)
        acting[past + k] = drive
        if m == 0 and (k > 0 or last > 0):
            for i in range(n):
                s[HEADER_SIZE + i] += b_next[p, i] * drive
        y[k] = free + share * drive
    s[INTEGRAL] = total
    s[LAST_PLANT] = which[N - 1] + 1 if N > 0 else last


@functools.partial(kernel, heap=False)
def run_axis(
    motion: AxisConstants, which: IntArray, settings: ControllerConstants, r: FloatArray, n_u: FloatArray,
    n_y: FloatArray, s: FloatArray, u: FloatArray, limited: FloatArray, acting: FloatArray, y: FloatArray,
) -> None:  # fmt: skip
    """Run the closed loop of axes with friction; arguments as in `run_linear`, the plant's state has n = 2.

    Friction is semi-implicit: the force that would stop the axis within the sub-step is applied if it is
    below the Coulomb friction, and then the axis sticks; otherwise the whole Coulomb friction is. So it
    stops without chatter.
    """
    m, past = settings.delay_samples, settings.delay_samples + 2
    position, speed, total = s[HEADER_SIZE], s[HEADER_SIZE + 1], s[INTEGRAL]
    for k in range(len(r)):
        y[k] = speed if motion.speed else position
        u[k], limited[k], acting[past + k], total = control_step(settings, r[k], n_u[k], n_y[k], y[k], 0.0, total)
        p = which[k]
        now, late = acting[past + k - m], acting[past + k - 1 - m]
        for step in range(motion.steps):
            arrived = (step + 0.5) / motion.steps >= settings.delay_fraction
            position, speed = _axis_step(motion, p, position, speed, motion.gain[p] * (now if arrived else late))
    s[HEADER_SIZE], s[HEADER_SIZE + 1], s[INTEGRAL] = position, speed, total


@kernel
def run_free_axis(motion: AxisConstants, position: float, speed: float, u: FloatArray, y: FloatArray) -> None:
    """Run the first axis driven by what acts on it, u (N,), from a position and a speed on; y (N,) is filled."""
    for k in range(len(u)):
        y[k] = speed if motion.speed else position
        for _ in range(motion.steps):
            position, speed = _axis_step(motion, 0, position, speed, motion.gain[0] * u[k])


@kernel
def _axis_step(motion: AxisConstants, p: int, position: float, speed: float, drive: float) -> tuple[float, float]:
    drive -= motion.offset[p]
    for w in range(motion.waves.shape[1]):
        drive -= motion.waves[p, w, 0] * np.sin(motion.waves[p, w, 1] * position + motion.waves[p, w, 2])
    push = drive - motion.stiffness[p] * position
    heading = speed if speed != 0.0 and motion.order == 2 else push
    d = 0 if heading >= 0.0 else 1
    Phi, g = motion.Phi[p, d], motion.g[p, d]
    if motion.order == 1:
        left = max(abs(push) - motion.coulomb[p], 0.0)
        step = g[0] * (left if push > 0.0 else -left)
        return position + step, step
    coasting = Phi[1, 0] * position + Phi[1, 1] * speed + g[1] * drive
    coulomb = motion.coulomb[p] + motion.stribeck[p, 0] / (1.0 + (motion.stribeck[p, 1] * speed) ** 2)
    coulomb += motion.load[p, 0] * abs(np.sin(motion.load[p, 1] * position + motion.load[p, 2]))
    if abs(coasting) <= coulomb * g[1]:
        force = drive - coasting / g[1]
        return Phi[0, 0] * position + Phi[0, 1] * speed + g[0] * force, 0.0
    force = drive - coulomb if coasting > 0.0 else drive + coulomb
    return (
        Phi[0, 0] * position + Phi[0, 1] * speed + g[0] * force,
        Phi[1, 0] * position + Phi[1, 1] * speed + g[1] * force,
    )


SUB_STEPS = 20  # per sample; the axis stops and reverses to within one of them


def axis_constants(plants: Sequence[Plant], loop: Loop) -> AxisConstants:
    """Return the sub-steps of axes of order 1 or 2 that hold their input.

    Raises SimulationError if an axis has a higher order, or the input is not held.
    """
    values = [dict(zip(plant.names, (float(v) for v in plant.theta()), strict=True)) for plant in plants]
    if any(name in value for value in values for name in ("jerk", "snap")):
        raise SimulationError("friction and offset are simulated up to order 2; without them any order is")
    if loop.hold != "zoh":
        raise SimulationError('friction and offset are simulated with hold = "zoh" only')
    duration = 1.0 / loop.sample_rate / SUB_STEPS
    steps = [[_sub_step(value, direction, duration) for direction in ("forward", "backward")] for value in values]
    stiffness, coulomb, offset = (
        np.array([value.get(name, 0.0) for value in values]) for name in ("stiffness", "coulomb_friction", "offset")
    )
    columns = [_shaped_columns(plant) for plant in plants]
    return AxisConstants(
        order=2 if "inertia" in values[0] else 1,
        Phi=np.array([[Phi for Phi, _ in pair] for pair in steps]),
        g=np.array([[g for _, g in pair] for pair in steps]),
        gain=np.array([plant.input_gain for plant in plants], dtype=np.float64),
        stiffness=stiffness,
        coulomb=coulomb,
        offset=offset,
        stribeck=np.array([each.pop(Column.STRIBECK, (0.0, 0.0, 0.0))[:2] for each in columns]),
        load=np.array([each.pop(Column.LOAD, (0.0, 0.0, 0.0)) for each in columns]),
        waves=np.array([list(each.values()) for each in columns]).reshape(len(plants), -1, 3),
        steps=SUB_STEPS,
        speed=bool(loop.plant.derivative),
    )


def _shaped_columns(plant: Plant) -> dict[Column, tuple[float, float, float]]:
    """Return coefficient, factor and phase of each column that has a shape."""
    coefficients = dict(zip(plant.extras, plant.theta()[len(plant.powers) :].tolist(), strict=True))
    return {
        name: (coefficients[name], *plant.column_shapes[name]) for name in plant.extras if name in plant.column_shapes
    }


def _sub_step(value: dict[str, float], direction: str, duration: float) -> tuple[FloatArray, FloatArray]:
    """Return the transition (2, 2) of (y, y') and its response (2,) to a unit force, in one direction."""
    viscous = value.get("viscous_friction", value.get(f"viscous_friction_{direction}", 0.0))
    stiffness, inertia = value.get("stiffness", 0.0), value.get("inertia", 0.0)
    if inertia == 0.0:
        Phi, g, _ = transition(np.array([[-stiffness / viscous]]), np.array([[1.0 / viscous]]), duration)
        return np.diag([Phi[0, 0], 0.0]), np.array([g[0], 0.0])
    A = np.array([[0.0, 1.0], [-stiffness / inertia, -viscous / inertia]])
    Phi, g, _ = transition(A, np.array([[0.0], [1.0 / inertia]]), duration)
    return Phi, g
