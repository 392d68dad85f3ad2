"""The compiled inner loops: PI controller and plant, sample by sample; importing this file imports numba.

What a loop carries from one piece to the next stands in one row of floats, zero before the first sample: the
controller's sum, the number of the last plant (counted from 1), and the plant's state. What acts on the plant has the
m + 2 samples before the piece in front of its own. All arrays come from outside: kernels that allocate none, and cut
none into parts, compile three times as fast.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from servoscope.compiled import kernel
from servoscope.plants import FloatArray

IntArray = npt.NDArray[np.int64]

TOTAL, LAST, HEAD = 0, 1, 2  # places in the row; the plant's state follows the head


class Settings(NamedTuple):
    """The controller and what lies between it and the plant, in plain numbers."""

    proportional: float  # k_p
    integrating: float  # k_i T
    low: float  # limits of u
    high: float
    shut_low: float  # dead zone: nothing passes; empty if shut_low > shut_high
    shut_high: float
    m: int  # delay in whole samples
    rest: float  # and the rest of it, 0 <= rest < 1


class Motion(NamedTuple):
    """A motor axis of order 1 or 2 per plant p and direction d (0 forward, 1 backward) over one sub-step."""

    order: int
    Phi: FloatArray  # (p, d, 2, 2), of (y, y')
    g: FloatArray  # (p, d, 2), response to a unit force
    gain: FloatArray  # (p,), input_gain
    stiffness: FloatArray  # (p,)
    coulomb: FloatArray  # (p,)
    offset: FloatArray  # (p,)
    steps: int  # sub-steps per sample


@kernel
def control(
    settings: Settings, r: float, n_u: float, n_y: float, free: float, share: float, total: float
) -> tuple[float, float, float, float]:
    """One update u = k_p e + k_i T sum e; returns u, u after the limits, what acts on the plant, the new sum.

    ``free`` is y without the present u and ``share`` how much of u reaches y at once, with a first-order
    hold only: then u and y follow together from one linear equation, whose solution a limit just clips.
    """
    gain = settings.proportional + settings.integrating
    u = (gain * (r - n_y - free - share * n_u) + total) / (1.0 + gain * share)
    limited = min(max(u, settings.low), settings.high)
    passed = 0.0 if settings.shut_low <= limited <= settings.shut_high else limited
    e = r - n_y - free - share * (passed + n_u)
    return gain * e + total, limited, passed + n_u, total + settings.integrating * e


@functools.partial(kernel, heap=False)
def run_linear(
    A: FloatArray, b_next: FloatArray, b_now: FloatArray, b_late: FloatArray, c: FloatArray, fresh: FloatArray,
    which: IntArray, settings: Settings, r: FloatArray, n_u: FloatArray, n_y: FloatArray, s: FloatArray,
    u: FloatArray, limited: FloatArray, acting: FloatArray, y: FloatArray,
) -> None:  # fmt: skip
    """Run the closed loop of linear plants; which[k] names the plant from sample k to k + 1.

    Shapes: A (p, n, n), b_next, b_now, b_late, c (p, n), fresh (n,) to work in; which, r, n_u, n_y (N,). Writes u, u
    after the limits, and y without noise, each (N,), what acts on the plant (m + 2 + N,), and carries s (HEAD + n,) on.
    """
    N, n, m = len(r), len(fresh), settings.m
    past, total, last = m + 2, s[TOTAL], int(s[LAST])
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
                    value += A[p, i, j] * s[HEAD + j]
                fresh[i] = value
                free += c[p, i] * value
                if m == 0:
                    share += c[p, i] * b_next[p, i]
            for i in range(n):
                s[HEAD + i] = fresh[i]
        u[k], limited[k], drive, total = control(settings, r[k], n_u[k], n_y[k], free, share, total)
        acting[past + k] = drive
        if m == 0 and (k > 0 or last > 0):
            for i in range(n):
                s[HEAD + i] += b_next[p, i] * drive
        y[k] = free + share * drive
    s[TOTAL] = total
    s[LAST] = which[N - 1] + 1 if N > 0 else last


@functools.partial(kernel, heap=False)
def run_axis(
    motion: Motion, which: IntArray, settings: Settings, r: FloatArray, n_u: FloatArray, n_y: FloatArray, s: FloatArray,
    u: FloatArray, limited: FloatArray, acting: FloatArray, y: FloatArray,
) -> None:  # fmt: skip
    """Run the closed loop of axes with friction; arguments as in `run_linear`, the plant's state has n = 2.

    Friction is semi-implicit: the force that would stop the axis within the sub-step is applied if it is
    below the Coulomb friction, and then the axis sticks; otherwise the whole Coulomb friction is. So it
    stops without chatter.
    """
    m, past = settings.m, settings.m + 2
    position, speed, total = s[HEAD], s[HEAD + 1], s[TOTAL]
    for k in range(len(r)):
        y[k] = position
        u[k], limited[k], acting[past + k], total = control(settings, r[k], n_u[k], n_y[k], position, 0.0, total)
        p = which[k]
        now, late = acting[past + k - m], acting[past + k - 1 - m]
        for step in range(motion.steps):
            arrived = (step + 0.5) / motion.steps >= settings.rest
            drive = motion.gain[p] * (now if arrived else late) - motion.offset[p]
            position, speed = _advance(motion, p, position, speed, drive)
    s[HEAD], s[HEAD + 1], s[TOTAL] = position, speed, total


@kernel
def _advance(motion: Motion, p: int, position: float, speed: float, drive: float) -> tuple[float, float]:
    push = drive - motion.stiffness[p] * position
    heading = speed if speed != 0.0 and motion.order == 2 else push
    d = 0 if heading >= 0.0 else 1
    Phi, g = motion.Phi[p, d], motion.g[p, d]
    if motion.order == 1:
        left = max(abs(push) - motion.coulomb[p], 0.0)
        step = g[0] * (left if push > 0.0 else -left)
        return position + step, step
    coasting = Phi[1, 0] * position + Phi[1, 1] * speed + g[1] * drive
    if abs(coasting) <= motion.coulomb[p] * g[1]:
        force = drive - coasting / g[1]
        return Phi[0, 0] * position + Phi[0, 1] * speed + g[0] * force, 0.0
    force = drive - motion.coulomb[p] if coasting > 0.0 else drive + motion.coulomb[p]
    return (
        Phi[0, 0] * position + Phi[0, 1] * speed + g[0] * force,
        Phi[1, 0] * position + Phi[1, 1] * speed + g[1] * force,
    )
