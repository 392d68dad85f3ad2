"""The compiled loop of data quality: sample after sample, so that cutting the stream into blocks changes nothing."""

from __future__ import annotations

from typing import Any

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.jit import inline, kernel
from servoscope.signals.quality.findings import KINDS
from servoscope.signals.quality.settings import QualityLimits
from servoscope.signals.timebase import BACKWARD_STEP, GAP_STEP, LATE_SAMPLES

WAITING, SILENT, FROZEN_Y, FROZEN_U, GAP, JITTER, RATE, CLOCK = range(len(KINDS))
R, U, Y, E = range(4)

MAX_FINDINGS = 12  # findings that one sample can make
EPOCH_WINDOWS = 60  # windows after which old ranges are forgotten, and with them a spike
MOTION_SHARE = 0.1  # of its range: a signal that moves by less has not moved
MOTION_STEPS = 3.0  # smallest changes: likewise
NOISE_LEVELS = 8.0  # smallest changes that noise at rest has to cover ...
TURN_SHARE = 0.4  # ... and share of samples at which it turns; white noise turns at two of three


@kernel
def check_samples(
    limits: QualityLimits,
    states: Any,
    t: FloatArray,
    r: FloatArray,
    u: FloatArray,
    y: FloatArray,
    begin: int,
    out: FloatArray,
) -> tuple[int, int]:
    """Check samples from `begin` on, until the block ends or `out` is full.

    `states`: one record of `STATE_DTYPE`, changed in place, shape (1,); `t, r, u, y`: the block, shape (N,); `out`:
    receives the findings as kind, begins, time, value, limit, shape (K, 5). Returns where the next call goes on and
    the number of findings.
    """
    s, n = states[0], 0
    for k in range(begin, len(t)):
        if n + MAX_FINDINGS > len(out):
            return k, n
        now = t[k] if np.isfinite(t[k]) else s.t
        if np.isfinite(t[k]):
            n = _check_step(limits, s, t[k], out, n)
        else:
            s.missing += 1.0
        if np.isfinite(r[k]) and np.isfinite(u[k]) and np.isfinite(y[k]):
            n = _check_values(limits, s, now, r[k], u[k], y[k], out, n)
        elif np.isfinite(t[k]):
            s.missing += 1.0
        s.samples += 1.0
        share = _missing_share(limits, s)
        if share > limits.missing and s.active[GAP] == 0.0:
            n = _write_finding(s, GAP, True, now, share, limits.missing, out, n)
        if s.samples >= limits.window:
            n = _check_window(limits, s, now, out, n)
    return len(t), n


@kernel
def check_rows(limits: QualityLimits, states: Any, t: FloatArray, signals: FloatArray, out: FloatArray) -> None:
    """Check a block of each asset: `states` (assets,), t (assets, N), r, u and y (assets, 3, N); findings are lost."""
    for a in range(len(t)):
        begin = 0
        while begin < t.shape[1]:
            x = signals[a]
            begin, _ = check_samples(limits, states[a : a + 1], t[a], x[0], x[1], x[2], begin, out)


@inline
def _check_step(limits: QualityLimits, s: Any, t: float, out: FloatArray, n: int) -> int:
    """Judge the step to a time stamp."""
    step = t - s.t
    periods = np.rint(step / limits.period)
    far = step > limits.silent_s and s.active[SILENT] == 0.0
    if s.count == 0.0:
        s.since[WAITING] = t
    elif far or step <= BACKWARD_STEP * limits.period:
        # A silence as long as that would have been noticed: it is the clock that jumped.
        s.jumps += 1.0
        n = _write_finding(s, CLOCK, True, t, step, limits.silent_s, out, n)
    else:
        # A stamp that is late makes one step longer and the next one shorter: in whole periods the two make up.
        if not limits.gap_s < step <= limits.silent_s:  # a log that pauses lacks nothing
            s.missing += periods - 1.0
        if periods < LATE_SAMPLES:  # a longer step does not tell a rate
            s.span += step
            s.periods += periods
        if step <= GAP_STEP * limits.period:
            s.steps += 1.0
            s.jittery += abs(step - limits.period) > limits.jitter
    s.count += 1.0
    s.t = t
    return n


@inline
def _check_values(
    limits: QualityLimits, s: Any, t: float, r: float, u: float, y: float, out: FloatArray, n: int
) -> int:
    """Judge the values of a complete sample."""
    e = r - y
    if s.values == 0.0:
        for epoch in range(2):
            for i, x in enumerate((r, u, y, e)):
                s.ranges[epoch, i, 0] = s.ranges[epoch, i, 1] = x
    for i, x in enumerate((r, u, y, e)):
        _widen(s.ranges[0, i], x)
    turned = s.direction * (y - s.last[Y]) < 0.0
    for i, x in enumerate((r, u, y)):
        change = abs(x - s.last[i])
        if s.values == 0.0 or change > 0.0:
            s.same[i] = 0.0
        if s.values > 0.0 and change > 0.0 and (s.smallest_change[i] == 0.0 or change < s.smallest_change[i]):
            s.smallest_change[i] = change
        s.same[i] += 1.0
    if y != s.last[Y]:
        s.direction = y - s.last[Y]
    s.last[R], s.last[U], s.last[Y] = r, u, y
    s.values += 1.0
    _track_range(s.r_range, r, s.same[Y] == 1.0)
    _track_range(s.y_range, y, s.same[U] == 1.0)
    _track_range(s.e_range, e, s.same[U] == 1.0)
    _learn_rest_noise(limits, s, y, turned)
    frozen_s = limits.frozen * limits.period
    if s.active[FROZEN_Y] != 0.0 and s.same[Y] == 1.0:
        n = _write_finding(s, FROZEN_Y, False, t, 0.0, frozen_s, out, n)
    elif s.active[FROZEN_Y] == 0.0 and s.same[Y] > limits.frozen and _y_should_move(limits, s):
        n = _write_finding(s, FROZEN_Y, True, t, _width(s.r_range), frozen_s, out, n)
    if s.active[FROZEN_U] != 0.0 and s.same[U] == 1.0:
        n = _write_finding(s, FROZEN_U, False, t, 0.0, frozen_s, out, n)
    elif s.active[FROZEN_U] == 0.0 and s.same[U] > limits.frozen and _u_should_move(s, u):
        n = _write_finding(s, FROZEN_U, True, t, _width(s.e_range), frozen_s, out, n)
    return n


@inline
def _learn_rest_noise(limits: QualityLimits, s: Any, y: float, turned: bool) -> None:
    """Learn, while r rests, whether y is noisy there: it turns at most samples, over many of its smallest changes."""
    same, stretch = s.same[R], limits.frozen
    begins = (same if same < stretch else same % stretch) == 1.0  # a division is what costs most, and motion needs none
    if begins:
        # The first stretch of a rest is left for the motion to settle.
        if same > 2.0 * stretch and s.turns >= TURN_SHARE * stretch:
            s.noisy = max(s.noisy, 1.0 * (_width(s.rest_range) >= NOISE_LEVELS * s.smallest_change[Y]))
        s.turns = 0.0
    s.turns += turned
    _track_range(s.rest_range, y, begins)


@inline
def _y_should_move(limits: QualityLimits, s: Any) -> bool:
    if s.noisy > 0.0:
        return True
    if limits.travel > 0.0:
        return _width(s.r_range) > limits.travel
    # A y that has never moved has no scale of its own.
    return _has_moved(s, s.r_range, Y if s.smallest_change[Y] > 0.0 else R)


@inline
def _u_should_move(s: Any, u: float) -> bool:
    """Tell whether the controller has had to act; at the end of its range u is limited, and not frozen."""
    lowest, highest = min(s.ranges[0, U, 0], s.ranges[1, U, 0]), max(s.ranges[0, U, 1], s.ranges[1, U, 1])
    inside = lowest < u < highest and highest - lowest > MOTION_STEPS * s.smallest_change[U]
    acted = _width(s.e_range) > MOTION_SHARE * _range(s, E)
    return bool(inside and acted and _has_moved(s, s.y_range, Y))


@inline
def _has_moved(s: Any, span: FloatArray, i: int) -> bool:
    """Tell whether a signal went further than what i does without moving: a share of its range, a few of its steps."""
    return bool(_width(span) > max(MOTION_SHARE * _range(s, i), MOTION_STEPS * s.smallest_change[i]))


@inline
def _range(s: Any, i: int) -> float:
    return float(max(s.ranges[0, i, 1], s.ranges[1, i, 1]) - min(s.ranges[0, i, 0], s.ranges[1, i, 0]))


@inline
def _width(span: FloatArray) -> float:
    return float(span[1] - span[0])


@inline
def _widen(span: FloatArray, x: float) -> None:
    span[0] = min(span[0], x)
    span[1] = max(span[1], x)


@inline
def _track_range(span: FloatArray, x: float, anew: bool) -> None:
    if anew:
        span[0] = span[1] = x
    else:
        _widen(span, x)


@inline
def _missing_share(limits: QualityLimits, s: Any) -> float:
    """Return the share of the window that is missing, if no more is until its end."""
    missing = max(s.missing, 0.0)
    return float(missing / (missing + limits.window))


@inline
def _check_window(limits: QualityLimits, s: Any, t: float, out: FloatArray, n: int) -> int:
    """Judge a complete window, and begin the next."""
    # What is found ends at half of its limit, so that it does not come and go.
    if s.active[GAP] != 0.0 and _missing_share(limits, s) < 0.5 * limits.missing:
        n = _write_finding(s, GAP, False, t, _missing_share(limits, s), limits.missing, out, n)
    if s.active[CLOCK] != 0.0 and s.jumps == 0.0:
        n = _write_finding(s, CLOCK, False, t, 0.0, limits.silent_s, out, n)
    if s.steps >= 0.5 * limits.window:  # fewer say nothing, good or bad
        n = _update_finding(s, JITTER, s.jittery / s.steps, limits.jittery, t, out, n)
        if s.jittery <= limits.jittery * s.steps and s.span > 0.0:  # stamps that jitter do not tell a rate
            n = _update_finding(s, RATE, s.periods * limits.period / s.span - 1.0, limits.rate_error, t, out, n)
        if s.active[WAITING] != 0.0:
            n = _write_finding(s, WAITING, False, t, 0.0, 0.0, out, n)
    s.samples, s.steps, s.jittery, s.periods, s.span, s.missing, s.jumps = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    s.windows += 1.0
    if s.windows >= EPOCH_WINDOWS and s.values > 0.0:
        s.windows = 0.0
        for i in range(4):
            for j in range(2):
                s.ranges[1, i, j] = s.ranges[0, i, j]
                s.ranges[0, i, j] = s.last[i] if i < E else s.last[R] - s.last[Y]
    return n


@inline
def _update_finding(s: Any, kind: int, value: float, limit: float, t: float, out: FloatArray, n: int) -> int:
    active = s.active[kind] != 0.0
    if (abs(value) > limit and not active) or (abs(value) < 0.5 * limit and active):
        return _write_finding(s, kind, not active, t, value, limit, out, n)
    return n


@inline
def _write_finding(
    s: Any, kind: int, begins: bool, t: float, value: float, limit: float, out: FloatArray, n: int
) -> int:
    s.active[kind] = 1.0 if begins else 0.0
    s.since[kind] = t
    out[n, 0], out[n, 1], out[n, 2], out[n, 3], out[n, 4] = kind, s.active[kind], t, value, limit
    return n + 1
