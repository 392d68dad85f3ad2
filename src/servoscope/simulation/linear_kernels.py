"""The compiled inner loops: PI controller and plant, sample by sample.

The state that a loop carries from chunk to chunk is one row of floats, zero before the first sample: the controller's
sum, the number of the last plant (counted from 1), and the plant's state. What acts on the plant has the m + 2 samples
before the chunk in front of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import SimulationError
from servoscope.core.jit import Int, maximum, minimum, where
from servoscope.core.jit.array_function import ArrayFunction
from servoscope.core.jit.arrays import Variable
from servoscope.models.discretise import transition
from servoscope.models.loop import Loop
from servoscope.models.plants import Column, Plant

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
    negative_gain: float = 1.0  # negative_gain, positive_gain: what u < 0 and u > 0 act by, with two areas
    positive_gain: float = 1.0


class AxisConstants(NamedTuple):
    """A motor axis of order 1 or 2 per plant p and direction d (0 forward, 1 backward) over one sub-step."""

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


def control_step(
    settings: ControllerConstants, r: Any, n_u: Any, n_y: Any, free: Any, share: Any, total: Any
) -> tuple[Any, Any, Any, Any]:
    """One update u = k_p e + k_i T sum e; returns u, u after the limits, what acts on the plant, the new sum.

    ``free`` is y without the present u and ``share`` how much of u reaches y at once, with a first-order
    hold only: then u and y follow together from one linear equation, whose solution a limit just clips.
    """
    gain = settings.proportional_gain + settings.integral_gain
    u = (gain * (r - n_y - free - share * n_u) + total) / (1.0 + gain * share)
    limited = minimum(maximum(u, settings.low), settings.high)
    passed = where((limited >= settings.deadzone_low) & (limited <= settings.deadzone_high), 0.0, limited)
    e = r - n_y - free - share * (passed + n_u)
    acting = passed * where(passed < 0.0, settings.negative_gain, settings.positive_gain) + n_u
    return gain * e + total, limited, acting, total + settings.integral_gain * e


def runge_kutta_step(x: Any, states: int, h: Any, slope: Callable[[Sequence[Any]], Sequence[Any]]) -> None:
    """Move an array of states on by h: Runge and Kutta's fourth order."""
    begin, slopes = [x[i] for i in range(states)], list[Sequence[Any]]()
    at = begin
    for share in (0.5, 0.5, 1.0, None):
        slopes.append(slope(at))
        if share is not None:
            at = [value + share * h * speed for value, speed in zip(begin, slopes[-1], strict=True)]
    for i, (a, b, c, d) in enumerate(zip(*slopes, strict=True)):
        x[i] = begin[i] + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)


@ArrayFunction
def run_linear(
    printer: Any, A: Any, b_next: Any, b_now: Any, b_late: Any, c: Any, which: Any, settings: ControllerConstants,
    r: Any, n_u: Any, n_y: Any, s: Any, u: Any, limited: Any, acting: Any, y: Any, *, n: int,
) -> None:  # fmt: skip
    """Run the closed loop of linear plants; which[k] names the plant from sample k to k + 1.

    Shapes: A (p, n, n), b_next, b_now, b_late, c (p, n); which, r, n_u, n_y (N,). Writes u, u after the limits, and y
    without noise, each (N,), what acts on the plant (m + 2 + N,), and carries s (HEAD + n,) on.
    """
    N, m = r.shape[0], settings.delay_samples
    past, total, last = m + 2, Variable(printer, s[INTEGRAL]), printer.truncate(s[LAST_PLANT])
    at_once: Any = m <= 0
    for k in printer.loop(0, N):
        p = where(k > 0, which[maximum(k - 1, 0)], maximum(last - 1, 0))
        free, share = Variable(printer, 0.0), Variable(printer, 0.0)
        goes_on = (k > 0) | (last > 0)
        with printer.when(goes_on):
            ahead = where(m > 0, acting[past + k - m], 0.0)
            now, late, state = (
                acting[past + k - 1 - m],
                acting[past + k - 2 - m],
                [s[HEADER_SIZE + j] for j in range(n)],
            )
            for i in range(n):
                value = b_next[p, i] * ahead + b_now[p, i] * now + b_late[p, i] * late
                for j in range(n):
                    value = value + A[p, i, j] * state[j]
                s[HEADER_SIZE + i] = value
                free.value = free.value + c[p, i] * value
                share.value = share.value + where(at_once, c[p, i] * b_next[p, i], 0.0)
        step = control_step(settings, r[k], n_u[k], n_y[k], free.value, share.value, total.value)
        u[k], limited[k], acting[past + k], total.value = step
        with printer.when(at_once & goes_on):
            for i in range(n):
                s[HEADER_SIZE + i] = s[HEADER_SIZE + i] + b_next[p, i] * step[2]
        y[k] = free.value + share.value * step[2]
    s[INTEGRAL] = total.value
    s[LAST_PLANT] = printer.number(where(N > 0, which[maximum(N - 1, 0)] + 1, last))


@ArrayFunction
def run_axis(
    printer: Any, motion: AxisConstants, which: Any, settings: ControllerConstants, r: Any, n_u: Any, n_y: Any,
    s: Any, u: Any, limited: Any, acting: Any, y: Any, *, order: int,
) -> None:  # fmt: skip
    """Run the closed loop of axes with friction; arguments as in `run_linear`, the plant's state has n = 2.

    Friction is semi-implicit: the force that would stop the axis within the sub-step is applied if it is
    below the Coulomb friction, and then the axis sticks; otherwise the whole Coulomb friction is. So it
    stops without chatter.
    """
    m = settings.delay_samples
    past, total = m + 2, Variable(printer, s[INTEGRAL])
    position, speed = Variable(printer, s[HEADER_SIZE]), Variable(printer, s[HEADER_SIZE + 1])
    for k in printer.loop(0, r.shape[0]):
        output = speed.value if motion.speed else position.value
        y[k] = output
        u[k], limited[k], acting[past + k], total.value = control_step(
            settings, r[k], n_u[k], n_y[k], output, 0.0, total.value
        )
        now, late = acting[past + k - m], acting[past + k - 1 - m]
        for step in printer.loop(0, motion.steps):
            arrived = (printer.number(step) + 0.5) / printer.number(motion.steps) >= settings.delay_fraction
            drive = motion.gain[which[k]] * where(arrived, now, late)
            advance_axis(printer, motion, which[k], position, speed, drive, order)
    s[HEADER_SIZE], s[HEADER_SIZE + 1], s[INTEGRAL] = position.value, speed.value, total.value


def advance_axis(
    printer: Any, motion: AxisConstants, p: Any, position: Variable, speed: Variable, drive: Any, order: int
) -> None:
    """Write one sub-step of an axis, driven by a force."""
    at, v, force = position.value, speed.value, Variable(printer, drive - motion.offset[p])
    for w in printer.loop(0, motion.waves.shape[1]):
        wave = motion.waves[p, w]
        force.value = force.value - wave[0] * printer.call_library("sin", wave[1] * at + wave[2])
    drive = force.value
    push = drive - motion.stiffness[p] * at
    heading = where(v.is_equal(0.0), push, v) if order == 2 else push
    d = where(heading >= 0.0, Int(printer, "0"), 1)
    Phi, g = motion.Phi[p, d], motion.g[p, d]
    if order == 1:
        left = maximum(abs(push) - motion.coulomb[p], 0.0)
        step = g[0] * where(push > 0.0, left, -left)
        position.value, speed.value = at + step, step
        return
    coasting = Phi[1, 0] * at + Phi[1, 1] * v + g[1] * drive
    slowness = motion.stribeck[p, 1] * v
    coulomb = motion.coulomb[p] + motion.stribeck[p, 0] / (1.0 + slowness * slowness)
    angle = motion.load[p, 1] * at + motion.load[p, 2]
    coulomb = coulomb + motion.load[p, 0] * abs(printer.call_library("sin", angle))
    sticks = abs(coasting) <= coulomb * g[1]
    net = where(sticks, drive - coasting / g[1], where(coasting > 0.0, drive - coulomb, drive + coulomb))
    position.value = Phi[0, 0] * at + Phi[0, 1] * v + g[0] * net
    speed.value = where(sticks, 0.0, Phi[1, 0] * at + Phi[1, 1] * v + g[1] * net)


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
        Phi=np.array([[Phi for Phi, _ in pair] for pair in steps]),
        g=np.array([[g for _, g in pair] for pair in steps]),
        gain=np.array([plant.input_gain for plant in plants], dtype=np.float64),
        stiffness=stiffness,
        coulomb=coulomb,
        offset=offset,
        stribeck=np.array([terms.pop(Column.STRIBECK, (0.0, 0.0, 0.0))[:2] for terms in columns]),
        load=np.array([terms.pop(Column.LOAD, (0.0, 0.0, 0.0)) for terms in columns]),
        waves=np.array([list(terms.values()) for terms in columns]).reshape(len(plants), -1, 3),
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
