"""The compiled loop of data quality: sample after sample, so that cutting the stream into blocks changes nothing."""

from __future__ import annotations

import math
from typing import Any

from servoscope.core.jit import maximum, minimum, where
from servoscope.core.jit.array_function import ArrayFunction
from servoscope.core.jit.arrays import Variable
from servoscope.signals.quality.settings import KINDS, QualityLimits
from servoscope.signals.timebase import BACKWARD_STEP, GAP_STEP, LATE_SAMPLES

WAITING, SILENT, FROZEN_Y, FROZEN_U, GAP, JITTER, RATE, CLOCK = range(len(KINDS))
R, U, Y, E = range(4)

MAX_FINDINGS = 12  # findings that one sample can make
EPOCH_WINDOWS = 60  # windows after which old ranges are forgotten, and with them a spike
MOTION_SHARE = 0.1  # of its range: a signal that moves by less has not moved
MOTION_STEPS = 3.0  # smallest changes: likewise
NOISE_LEVELS = 8.0  # smallest changes that noise at rest has to cover ...
MIN_CHANGES = 10.0  # of u, and ...
CHANGED_SHARE = 0.1  # ... share of samples at which it changes, where a controller sets it: else it is a staircase
TURN_SHARE = 0.4  # ... and share of samples at which it turns; white noise turns at two of three


@ArrayFunction
def check_samples(
    printer: Any, limits: QualityLimits, states: Any, t: Any, r: Any, u: Any, y: Any, begin: Any, out: Any, count: Any
) -> Any:
    """Check samples from `begin` on, until the block ends or `out` is full; return where the next call goes on.

    `states`: one record of `STATE_DTYPE`, changed in place, shape (1,); `t, r, u, y`: the block, shape (N,); `out`:
    receives the findings as kind, begins, time, value, limit, shape (K, 5), and `count` (1,) their number.
    """
    check = SampleCheck(printer, limits, states[0], out)
    k = Variable(printer, begin)
    for _ in printer.loop_while(lambda: (k.value < t.shape[0]) & (check.count.value + MAX_FINDINGS <= out.shape[0])):
        check.check_sample(t[k.value], r[k.value], u[k.value], y[k.value])
        k.value = k.value + 1
    count[0] = check.count.value
    return k.value


@ArrayFunction
def check_rows(printer: Any, limits: QualityLimits, states: Any, t: Any, signals: Any, out: Any) -> None:
    """Check a block of each asset: `states` (assets,), t (assets, N), r, u and y (assets, 3, N); findings are lost."""
    for a in printer.loop(0, t.shape[0]):
        check, x = SampleCheck(printer, limits, states[a], out), signals[a]
        for k in printer.loop(0, t.shape[1]):
            check.count.value = 0
            check.check_sample(t[a, k], x[R, k], x[U, k], x[Y, k])


class SampleCheck:
    """Writes how samples are checked: `s` is the state of an asset, `out` receives findings."""

    def __init__(self, printer: Any, limits: QualityLimits, s: Any, out: Any) -> None:
        self.printer, self.limits, self.s, self.out, self.count = printer, limits, s, out, Variable(printer, 0)

    def check_sample(self, t: Any, r: Any, u: Any, y: Any) -> None:
        """Write how one sample is checked."""
        s, limits, when = self.s, self.limits, self.printer.when
        timed, complete = abs(t) < math.inf, (abs(r) < math.inf) & (abs(u) < math.inf) & (abs(y) < math.inf)
        now = where(timed, t, s.t)
        with when(timed):
            self._check_step(t)
        with when(complete):
            self._check_values(now, r, u, y)
        s.missing = s.missing + where(timed & complete, 0.0, 1.0)
        s.samples = s.samples + 1.0
        share = self._missing_share()
        with when((share > limits.missing) & self._is_quiet(GAP)):
            self._write_finding(GAP, 1.0, now, share, limits.missing)
        with when(s.samples >= self.printer.number(limits.window)):
            self._check_window(now)

    def _check_step(self, t: Any) -> None:
        """Judge the step to a time stamp."""
        s, limits, when = self.s, self.limits, self.printer.when
        step = t - s.t
        periods = (step / limits.period).call("rint")
        is_first = s.count.is_equal(0.0)
        far = (step > limits.silent_s) & self._is_quiet(SILENT)
        jumps = ~is_first & (far | (step <= limits.period * BACKWARD_STEP))
        with when(is_first):
            s.since[WAITING] = t
        with when(jumps):  # a silence as long as that would have been noticed: it is the clock that jumped
            s.jumps = s.jumps + 1.0
            self._write_finding(CLOCK, 1.0, t, step, limits.silent_s)
        with when(~(is_first | jumps)):
            # A stamp that is late makes one step longer and the next one shorter: in whole periods the two make up.
            pauses = (step > limits.gap_s) & (step <= limits.silent_s)  # a log that pauses lacks nothing
            s.missing = s.missing + where(pauses, 0.0, periods - 1.0)
            tells = periods < LATE_SAMPLES  # a longer step does not tell a rate
            s.span = s.span + where(tells, step, 0.0)
            s.periods = s.periods + where(tells, periods, 0.0)
            steps = step <= limits.period * GAP_STEP
            s.steps = s.steps + where(steps, 1.0, 0.0)
            s.jittery = s.jittery + where(steps & (abs(step - limits.period) > limits.jitter), 1.0, 0.0)
        s.count = s.count + 1.0
        s.t = t

    def _check_values(self, t: Any, r: Any, u: Any, y: Any) -> None:
        """Judge the values of a complete sample."""
        s, limits, when = self.s, self.limits, self.printer.when
        signals, e, is_first = (r, u, y), r - y, s.values.is_equal(0.0)
        with when(is_first):
            for epoch in range(2):
                for i, x in enumerate((*signals, e)):
                    s.ranges[epoch, i, 0] = s.ranges[epoch, i, 1] = x
        for i, x in enumerate((*signals, e)):
            _widen(s.ranges[0, i], x)
        turned = s.direction * (y - s.last[Y]) < 0.0
        frozen = self.printer.number(limits.frozen)
        self._count_changes_of_u(~is_first & (abs(u - s.last[U]) > 0.0), frozen)
        for i, x in enumerate(signals):
            change, smallest = abs(x - s.last[i]), s.smallest_change[i]
            moved = change > 0.0
            s.same[i] = where(is_first | moved, 0.0, s.same[i]) + 1.0
            smaller = ~is_first & moved & (smallest.is_equal(0.0) | (change < smallest))
            s.smallest_change[i] = where(smaller, change, smallest)
        s.direction = where(y.is_equal(s.last[Y]), s.direction, y - s.last[Y])
        s.last[R], s.last[U], s.last[Y] = signals
        s.values = s.values + 1.0
        new_y, new_u = s.same[Y].is_equal(1.0), s.same[U].is_equal(1.0)
        _track_range(s.r_range, r, new_y)
        _track_range(s.y_range, y, new_u)
        _track_range(s.e_range, e, new_u)
        self._learn_rest_noise(y, turned)
        for kind, signal, span, new in ((FROZEN_Y, Y, s.r_range, new_y), (FROZEN_U, U, s.e_range, new_u)):
            active = ~self._is_quiet(kind)
            with when(active & new):
                self._write_finding(kind, 0.0, t, 0.0, frozen * limits.period)
            with when(~active & (s.same[signal] > frozen)):
                should_move = self._y_should_move() if signal == Y else self._u_should_move(r, u)
                with when(should_move):
                    self._write_finding(kind, 1.0, t, _width(span), frozen * limits.period)

    def _learn_rest_noise(self, y: Any, turned: Any) -> None:
        """Learn whether y is noisy while r rests: it turns at most samples, over many of its smallest changes."""
        s, p, same = self.s, self.printer, self.s.same[R]
        stretch, place = p.number(self.limits.frozen), Variable(p, same)
        with p.when(same >= stretch):  # a division is what costs most, and motion needs none
            place.value = p.number(p.truncate(same) % self.limits.frozen)
        begins = place.value.is_equal(1.0)
        with p.when(begins):
            # The first stretch of a rest is left for the motion to settle.
            turns = (same > stretch * 2.0) & (s.turns >= stretch * TURN_SHARE)
            noisy = _width(s.rest_range) >= s.smallest_change[Y] * NOISE_LEVELS
            s.noisy = where(turns & noisy, 1.0, s.noisy)
            s.turns = 0.0
        s.turns = s.turns + where(turned, 1.0, 0.0)
        _track_range(s.rest_range, y, begins)

    def _y_should_move(self) -> Any:
        s, travel = self.s, self.limits.travel
        # A y that has never moved has no scale of its own.
        moved = where(s.smallest_change[Y] > 0.0, self._least_motion(Y), self._least_motion(R))
        return (s.noisy > 0.0) | (_width(s.r_range) > where(travel > 0.0, travel, moved))

    def _count_changes_of_u(self, changed: Any, frozen: Any) -> None:
        """Count samples and changes of u since it was last the same for as long as what is frozen."""
        s = self.s
        anew = changed & (s.same[U] > frozen)
        s.u_changes = where(anew, 0.0, s.u_changes + where(changed, 1.0, 0.0))
        s.u_samples = where(anew, 0.0, s.u_samples + 1.0)

    def _u_should_move(self, r: Any, u: Any) -> Any:
        """Return whether there is a controller, and has had to act; at the end of its range u is limited, not frozen.

        None is where u is a staircase, or where r is constant or u itself, as logs of open loops have it.
        """
        s = self.s
        least = maximum((s.u_samples - s.same[U]) * CHANGED_SHARE, MIN_CHANGES)
        is_controlled = (s.u_changes >= least) & ~r.is_equal(u) & (self._range(R) > 0.0)
        lowest, highest = (limit(s.ranges[0, U, j], s.ranges[1, U, j]) for j, limit in enumerate((minimum, maximum)))
        inside = (lowest < u) & (u < highest) & (highest - lowest > s.smallest_change[U] * MOTION_STEPS)
        acted = _width(s.e_range) > self._range(E) * MOTION_SHARE
        return is_controlled & inside & acted & (_width(s.y_range) > self._least_motion(Y))

    def _least_motion(self, i: int) -> Any:
        """Return how far a signal goes without moving: a share of its range, a few of its steps."""
        return maximum(self._range(i) * MOTION_SHARE, self.s.smallest_change[i] * MOTION_STEPS)

    def _range(self, i: int) -> Any:
        ranges = self.s.ranges
        return maximum(ranges[0, i, 1], ranges[1, i, 1]) - minimum(ranges[0, i, 0], ranges[1, i, 0])

    def _missing_share(self) -> Any:
        """Return the share of the window that is missing, if no more is until its end."""
        missing = maximum(self.s.missing, 0.0)
        return missing / (missing + self.printer.number(self.limits.window))

    def _check_window(self, t: Any) -> None:
        """Judge a complete window, and begin the next."""
        s, limits, when = self.s, self.limits, self.printer.when
        # What is found ends at half of its limit, so that it does not come and go.
        share = self._missing_share()
        with when(~self._is_quiet(GAP) & (share < limits.missing * 0.5)):
            self._write_finding(GAP, 0.0, t, share, limits.missing)
        with when(~self._is_quiet(CLOCK) & s.jumps.is_equal(0.0)):
            self._write_finding(CLOCK, 0.0, t, 0.0, limits.silent_s)
        with when(s.steps >= self.printer.number(limits.window) * 0.5):  # fewer say nothing, good or bad
            self._update_finding(JITTER, s.jittery / s.steps, limits.jittery, t)
            with when((s.jittery <= limits.jittery * s.steps) & (s.span > 0.0)):  # stamps that jitter tell no rate
                self._update_finding(RATE, s.periods * limits.period / s.span - 1.0, limits.rate_error, t)
            with when(~self._is_quiet(WAITING)):
                self._write_finding(WAITING, 0.0, t, 0.0, 0.0)
        for name in ("samples", "steps", "jittery", "periods", "span", "missing", "jumps"):
            setattr(s, name, 0.0)
        s.windows = s.windows + 1.0
        with when((s.windows >= EPOCH_WINDOWS) & (s.values > 0.0)):
            s.windows = 0.0
            for i in range(4):
                for j in range(2):
                    s.ranges[1, i, j] = s.ranges[0, i, j]
                    s.ranges[0, i, j] = s.last[i] if i < E else s.last[R] - s.last[Y]

    def _is_quiet(self, kind: int) -> Any:
        return self.s.active[kind].is_equal(0.0)

    def _update_finding(self, kind: int, value: Any, limit: Any, t: Any) -> None:
        quiet, size = self._is_quiet(kind), abs(value)
        begins = quiet & (size > limit)
        with self.printer.when(begins | (~quiet & (size < limit * 0.5))):
            self._write_finding(kind, where(begins, 1.0, 0.0), t, value, limit)

    def _write_finding(self, kind: int, begins: Any, t: Any, value: Any, limit: Any) -> None:
        self.s.active[kind] = begins
        self.s.since[kind] = t
        row = self.out[self.count.value]
        row[0], row[1], row[2], row[3], row[4] = float(kind), begins, t, value, limit
        self.count.value = self.count.value + 1


def _width(span: Any) -> Any:
    return span[1] - span[0]


def _widen(span: Any, x: Any) -> None:
    span[0], span[1] = minimum(span[0], x), maximum(span[1], x)


def _track_range(span: Any, x: Any, anew: Any) -> None:
    span[0], span[1] = where(anew, x, minimum(span[0], x)), where(anew, x, maximum(span[1], x))
