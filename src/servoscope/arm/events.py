"""Short torques from outside, as of a push or a collision: found in what the healthy arm leaves of the torque."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from servoscope.arm.model import ArmModel
from servoscope.arm.regression import ArmSignals
from servoscope.core.arrays import BoolArray, FloatArray

EVENT_WINDOW_S = 0.5  # over which the torque is averaged
EVENT_MARGIN = 2.0  # times the largest of healthy recordings
MIN_EVENT_LIMIT = 8.0  # times the noise
MIN_EVENT_SHARE = 0.2  # share of the rms torque of a joint
BREAKAWAY = 1.5  # times Coulomb friction that may hold a joint at rest
BRAKED_SHARE = 0.1  # share of the torque that the weight asks for, below which brakes hold the arm
MAX_EVENT_S = 8.0  # what lasts longer is a change
MAX_EVENT_SHARE = 0.5  # share of the recording's time that events may take
EVENT_PAUSE_S = 1.0  # shorter pauses belong to an event


class ArmEvent(NamedTuple):
    """A torque from outside: when [s], and the joints in which it was seen, the largest first."""

    from_s: float
    to_s: float
    joints: tuple[str, ...]
    torque: float  # largest of the first joint [N m]


def outside_torque(
    signals: ArmSignals,
    design: FloatArray,
    residual: FloatArray,
    noise: FloatArray,
    model: ArmModel,
    theta: FloatArray,
) -> FloatArray:
    """Return what friction cannot explain of the residual's average over half a second, (n, M).

    Nothing where brakes hold the arm: at rest, the drives give hardly a part of the torque that its weight asks for.
    """
    from scipy.ndimage import maximum_filter1d, uniform_filter1d

    # all that the friction of a joint may be; at rest it has any sign
    joints = np.arange(model.arm.size)
    coulomb, by_load = model.friction_columns[:, 1], len(model.names) + joints
    own = design[joints, coulomb]
    load = np.abs(design[joints, by_load] / np.where(own == 0.0, np.inf, own))
    held = BREAKAWAY * (np.abs(theta[coulomb])[:, None] + np.abs(theta[by_load])[:, None] * load)
    period = float(np.median(np.diff(signals.t)))
    rows = max(1, round(EVENT_WINDOW_S / period))
    # of all joints together: some carry no weight
    drives, weight = (np.square(x / noise[:, None]).sum(0) for x in (signals.tau, signals.tau - residual))
    braked = ~signals.moving.any(0) & (drives < BRAKED_SHARE**2 * weight)
    allowed = np.where(signals.moving, 0.0, held)
    allowed = np.where(maximum_filter1d(braked, 2 * rows + 1), np.inf, allowed)
    mean = uniform_filter1d(residual, rows, axis=1)
    return np.asarray(np.sign(mean) * np.maximum(np.abs(mean) - allowed, 0.0))


def find_events(t: FloatArray, outside: FloatArray, limits: FloatArray, names: tuple[str, ...]) -> list[ArmEvent]:
    """Return the events of a recording; none where what exceeds the limits lasts, so that it is a change.

    `t`: (M,) [s]; `outside`: `outside_torque` (n, M); `limits`: (n,).
    """
    over = np.abs(outside) > limits[:, None]
    rows = np.flatnonzero(over.any(0))
    if not rows.size:
        return []
    events = []
    for span in np.split(rows, np.flatnonzero(np.diff(t[rows]) > EVENT_PAUSE_S) + 1):
        torque = np.abs(outside[:, span[0] : span[-1] + 1]).max(1)
        order = np.argsort(-torque / limits)
        joints = tuple(names[j] for j in order if torque[j] > limits[j])
        events.append(ArmEvent(float(t[span[0]]), float(t[span[-1]]), joints, float(torque[order[0]])))
    took = sum(event.to_s - event.from_s for event in events)
    short = max(event.to_s - event.from_s for event in events) <= MAX_EVENT_S
    return events if short and took <= MAX_EVENT_SHARE * (t[-1] - t[0]) else []


def outside_events(t: FloatArray, events: Sequence[ArmEvent]) -> BoolArray:
    """Return which rows (M,) no event touches."""
    clear = np.ones(t.size, dtype=np.bool_)
    for event in events:
        clear &= (t < event.from_s - EVENT_WINDOW_S) | (t > event.to_s + EVENT_WINDOW_S)
    return clear


def target_jumps(t: FloatArray, target: FloatArray | None, events: Sequence[ArmEvent]) -> list[bool]:
    """Return of each event whether the target position (N, n) jumps in it, beyond all that it does outside of events.

    `t`: (N,) [s]; all False where no target is logged.
    """
    if target is None:
        return [False] * len(events)
    jump = np.zeros(t.size)
    jump[1:-1] = np.abs(np.diff(target, 2, axis=0)).max(1)
    limit = EVENT_MARGIN * jump[outside_events(t, events)].max(initial=0.0)
    spans = [(t > event.from_s - EVENT_WINDOW_S) & (t < event.to_s + EVENT_WINDOW_S) for event in events]
    return [bool(jump[span].max(initial=0.0) > limit) for span in spans]
