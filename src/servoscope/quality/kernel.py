"""The compiled loop of data quality: sample after sample, so that cutting the stream into blocks changes nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.compiled import inlined, kernel
from servoscope.quality.findings import KINDS
from servoscope.quality.settings import Limits

FloatArray = npt.NDArray[np.float64]

WAITING, SILENT, FROZEN_Y, FROZEN_U, GAP, JITTER, RATE, CLOCK = range(len(KINDS))
R, U, Y, E = range(4)

MOST = 12  # findings that one sample can tell
LONG = 1.5  # samples: a longer step is no jitter
LATE = 10.0  # samples: so long a step does not tell a rate
BACK = -0.5  # samples: a step further back is a clock that was set, and not jitter
EPOCH = 60  # windows after which old ranges are forgotten, and with them a spike
SHARE = 0.1  # of its range: who moves by less has not moved
RESOLVED = 3.0  # smallest changes: likewise
LEVELS = 8.0  # smallest changes that noise at rest has to cover ...
TURNING = 0.4  # ... and share of samples at which it turns; white noise turns at two of three


@kernel
def look(
    limits: Limits,
    states: Any,
    t: FloatArray,
    r: FloatArray,
    u: FloatArray,
    y: FloatArray,
    begin: int,
    told: FloatArray,
) -> tuple[int, int]:
    """Look at samples from `begin` on, until the block or the room for findings ends.

    Parameters
    ----------
    limits
        What is allowed.
    states
        One record of `servoscope.quality.state.LAYOUT`, changed in place; shape (1,).
    t, r, u, y
        The block, shape (N,).
    begin
        Where to go on.
    told
        Takes the findings: kind, begins, time, value, limit; shape (K, 5).

    Returns
    -------
    int, int
        Where the next call goes on, and the number of findings.
    """
    s, n = states[0], 0
    for k in range(begin, len(t)):
        if n + MOST > len(told):
            return k, n
        now = t[k] if np.isfinite(t[k]) else s.t
        if np.isfinite(t[k]):
            n = _step(limits, s, t[k], told, n)
        else:
            s.missing += 1.0
        if np.isfinite(r[k]) and np.isfinite(u[k]) and np.isfinite(y[k]):
            n = _values(limits, s, now, r[k], u[k], y[k], told, n)
        elif np.isfinite(t[k]):
            s.missing += 1.0
        s.samples += 1.0
        share = _missing(limits, s)
        if share > limits.missing and s.stands[GAP] == 0.0:
            n = _tell(s, GAP, True, now, share, limits.missing, told, n)
        if s.samples >= limits.window:
            n = _window(limits, s, now, told, n)
    return len(t), n


@inlined
def _step(limits: Limits, s: Any, t: float, told: FloatArray, n: int) -> int:
    """Judge the step to a time stamp."""
    step = t - s.t
    periods = np.rint(step / limits.period)
    far = step > limits.silent_s and s.stands[SILENT] == 0.0
    if s.count == 0.0:
        s.since[WAITING] = t
    elif far or step <= BACK * limits.period:
        # A silence as long as that would have been noticed: it is the clock that jumped.
        s.jumps += 1.0
        n = _tell(s, CLOCK, True, t, step, limits.silent_s, told, n)
    else:
        # A stamp that is late makes one step longer and the next one shorter: in whole periods the two make up.
        s.missing += periods - 1.0
        if periods < LATE:
            s.span += step
            s.periods += periods
        if step <= LONG * limits.period:
            s.steps += 1.0
            s.jittery += abs(step - limits.period) > limits.jitter
    s.count += 1.0
    s.t = t
    return n


@inlined
def _values(limits: Limits, s: Any, t: float, r: float, u: float, y: float, told: FloatArray, n: int) -> int:
    """Judge the values of a complete sample."""
    e = r - y
    if s.values == 0.0:
        for epoch in range(2):
            for i, x in enumerate((r, u, y, e)):
                s.ranges[epoch, i, 0] = s.ranges[epoch, i, 1] = x
    for i, x in enumerate((r, u, y, e)):
        _widen(s.ranges[0, i], x)
    turned = s.way * (y - s.last[Y]) < 0.0
    for i, x in enumerate((r, u, y)):
        change = abs(x - s.last[i])
        if s.values == 0.0 or change > 0.0:
            s.same[i] = 0.0
        if s.values > 0.0 and change > 0.0 and (s.least[i] == 0.0 or change < s.least[i]):
            s.least[i] = change
        s.same[i] += 1.0
    if y != s.last[Y]:
        s.way = y - s.last[Y]
    s.last[R], s.last[U], s.last[Y] = r, u, y
    s.values += 1.0
    _meanwhile(s.r_meanwhile, r, s.same[Y] == 1.0)
    _meanwhile(s.y_meanwhile, y, s.same[U] == 1.0)
    _meanwhile(s.e_meanwhile, e, s.same[U] == 1.0)
    _rest(limits, s, y, turned)
    lasted = limits.frozen * limits.period
    if s.stands[FROZEN_Y] != 0.0 and s.same[Y] == 1.0:
        n = _tell(s, FROZEN_Y, False, t, 0.0, lasted, told, n)
    elif s.stands[FROZEN_Y] == 0.0 and s.same[Y] > limits.frozen and _y_should_move(limits, s):
        n = _tell(s, FROZEN_Y, True, t, _width(s.r_meanwhile), lasted, told, n)
    if s.stands[FROZEN_U] != 0.0 and s.same[U] == 1.0:
        n = _tell(s, FROZEN_U, False, t, 0.0, lasted, told, n)
    elif s.stands[FROZEN_U] == 0.0 and s.same[U] > limits.frozen and _u_should_move(s, u):
        n = _tell(s, FROZEN_U, True, t, _width(s.e_meanwhile), lasted, told, n)
    return n


@inlined
def _rest(limits: Limits, s: Any, y: float, turned: bool) -> None:
    """Learn, while r rests, whether y is noisy there: it turns at most samples, over many of its smallest changes."""
    if s.same[R] % limits.frozen == 1.0:
        # The first stretch of a rest is left for the motion to settle.
        if s.same[R] > 2.0 * limits.frozen and s.turns >= TURNING * limits.frozen:
            s.noisy = max(s.noisy, 1.0 * (_width(s.y_at_rest) >= LEVELS * s.least[Y]))
        s.turns = 0.0
    s.turns += turned
    _meanwhile(s.y_at_rest, y, s.same[R] % limits.frozen == 1.0)


@inlined
def _y_should_move(limits: Limits, s: Any) -> bool:
    if s.noisy > 0.0:
        return True
    if limits.travel > 0.0:
        return _width(s.r_meanwhile) > limits.travel
    # A y that has never moved has no scale of its own.
    return _moved(s, s.r_meanwhile, Y if s.least[Y] > 0.0 else R)


@inlined
def _u_should_move(s: Any, u: float) -> bool:
    """Tell whether the controller has had to act; at the end of its range u is limited, and not frozen."""
    lowest, highest = min(s.ranges[0, U, 0], s.ranges[1, U, 0]), max(s.ranges[0, U, 1], s.ranges[1, U, 1])
    inside = lowest < u < highest and highest - lowest > RESOLVED * s.least[U]
    acted = _width(s.e_meanwhile) > SHARE * _range(s, E)
    return bool(inside and acted and _moved(s, s.y_meanwhile, Y))


@inlined
def _moved(s: Any, meanwhile: FloatArray, i: int) -> bool:
    """Tell whether a signal went further than what i does without moving: a share of its range, a few of its steps."""
    return bool(_width(meanwhile) > max(SHARE * _range(s, i), RESOLVED * s.least[i]))


@inlined
def _range(s: Any, i: int) -> float:
    return float(max(s.ranges[0, i, 1], s.ranges[1, i, 1]) - min(s.ranges[0, i, 0], s.ranges[1, i, 0]))


@inlined
def _width(lowest_highest: FloatArray) -> float:
    return float(lowest_highest[1] - lowest_highest[0])


@inlined
def _widen(lowest_highest: FloatArray, x: float) -> None:
    lowest_highest[0] = min(lowest_highest[0], x)
    lowest_highest[1] = max(lowest_highest[1], x)


@inlined
def _meanwhile(lowest_highest: FloatArray, x: float, anew: bool) -> None:
    if anew:
        lowest_highest[0] = lowest_highest[1] = x
    else:
        _widen(lowest_highest, x)


@inlined
def _missing(limits: Limits, s: Any) -> float:
    """Return the share of the window that is missing, if no more is until its end."""
    missing = max(s.missing, 0.0)
    return float(missing / (missing + limits.window))


@inlined
def _window(limits: Limits, s: Any, t: float, told: FloatArray, n: int) -> int:
    """Judge a complete window, and begin the next."""
    # What is found ends at half of its limit, so that it does not come and go.
    if s.stands[GAP] != 0.0 and _missing(limits, s) < 0.5 * limits.missing:
        n = _tell(s, GAP, False, t, _missing(limits, s), limits.missing, told, n)
    if s.stands[CLOCK] != 0.0 and s.jumps == 0.0:
        n = _tell(s, CLOCK, False, t, 0.0, limits.silent_s, told, n)
    if s.steps >= 0.5 * limits.window:  # fewer say nothing, good or bad
        n = _judged(s, JITTER, s.jittery / s.steps, limits.jittery, t, told, n)
        if s.jittery <= limits.jittery * s.steps and s.span > 0.0:  # stamps that jitter do not tell a rate
            n = _judged(s, RATE, s.periods * limits.period / s.span - 1.0, limits.rate_error, t, told, n)
        if s.stands[WAITING] != 0.0:
            n = _tell(s, WAITING, False, t, 0.0, 0.0, told, n)
    s.samples, s.steps, s.jittery, s.periods, s.span, s.missing, s.jumps = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    s.windows += 1.0
    if s.windows >= EPOCH and s.values > 0.0:
        s.windows = 0.0
        for i in range(4):
            for j in range(2):
                s.ranges[1, i, j] = s.ranges[0, i, j]
                s.ranges[0, i, j] = s.last[i] if i < E else s.last[R] - s.last[Y]
    return n


@inlined
def _judged(s: Any, kind: int, value: float, limit: float, t: float, told: FloatArray, n: int) -> int:
    stands = s.stands[kind] != 0.0
    if (abs(value) > limit and not stands) or (abs(value) < 0.5 * limit and stands):
        return _tell(s, kind, not stands, t, value, limit, told, n)
    return n


@inlined
def _tell(s: Any, kind: int, begins: bool, t: float, value: float, limit: float, told: FloatArray, n: int) -> int:
    s.stands[kind] = 1.0 if begins else 0.0
    s.since[kind] = t
    told[n, 0], told[n, 1], told[n, 2], told[n, 3], told[n, 4] = kind, s.stands[kind], t, value, limit
    return n + 1
