"""Simulated loops with known causes for the assessment of one log: physical structures, drawn severities, truth.

Time is in samples and signals are in percent of span. Two families share nothing of what makes a cause: `training`
has two-parameter stiction, an ideal gap, a lag with dead time and PI control; `test` has a friction equation with mass
(Karnopp, 1985, with Stribeck's curve), a gap behind a lag, three lags, inverse response and PID control. The ranges of
`DRAWS` were fixed before any method was tuned. The training family is
wider: valves that seize, processes that are faster than the sampling, cascades, converters of few bits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from servoscope.assessment.causes import CAUSES

Floats = npt.NDArray[np.float64]

STEPS = 8  # of integration within one sample
WARM_UP = 300  # samples before the log begins
LENGTHS = (600, 750, 1000, 1500, 2500)
DRAWS = {  # ranges, drawn uniformly in the logarithm
    "stiction": (0.5, 10.0),  # S, stick band and dead band together [% of travel]
    "jump": (0.2, 1.0),  # J / S
    "backlash": (1.0, 10.0),  # gap [% of travel]
    "tight margin": (1.02, 1.35),  # gain margin
    "good margin": (2.5, 5.0),
    "sluggish margin": (15.0, 60.0),
    "noise": (0.02, 0.2),  # standard deviation of the measurement [% of span]
    "disturbance": (0.05, 0.5),  # standard deviation of the load [% of travel]
    "outside amplitude": (1.0, 8.0),  # of the load that oscillates [% of travel]
    "outside frequency": (0.15, 1.2),  # relative to the frequency of the phase crossover
    "time constant": (3.0, 30.0),  # of the process [samples]
    "dead time": (0.1, 1.0),  # relative to the time constant
    "quantum": (1.0, 4.0),  # step of the grid, or dead band of a historian, in standard deviations of the signal
}


@dataclass(frozen=True)
class Loop:
    """One simulated log and its truth."""

    cause: str
    size: float  # S of stiction, gap of backlash, gain margin, share of the record or quantum, by the cause
    r: Floats
    u: Floats
    y: Floats
    kind: str  # "flow", "level", "servo"


def simulate(number: int, seed: int, family: str) -> list[Loop]:
    """Return `number` loops, each cause in turn; the same for the same seed."""
    rng = np.random.default_rng([seed, family == "test"])
    return [loop for lanes in range(0, number, 500) for loop in _Lanes(rng, min(500, number - lanes), family).run()]


class _Lanes:
    """Loops that are simulated side by side, one per lane."""

    def __init__(self, rng: np.random.Generator, number: int, family: str) -> None:
        self.rng, self.n, self.test = rng, number, family == "test"
        self.cause = np.array([CAUSES[i % len(CAUSES)] for i in range(number)])
        self.kind = rng.choice(["flow", "level", "servo"], number, p=[0.6, 0.25, 0.15])
        # an integrating process runs away without control
        self.kind[np.isin(self.cause, ["too sluggish", "saturation", "manual"])] = "flow"
        self.integrating = self.kind != "flow"
        self._draw_process()
        self._tune()
        self._draw_signals()

    def draw(self, name: str) -> Floats:
        low, high = DRAWS[name]
        return np.asarray(low * (high / low) ** self.rng.random(self.n))

    def _draw_process(self) -> None:
        rng, n = self.rng, self.n
        self.tau = self.draw("time constant")
        if not self.test:  # plants are sampled more slowly than the test family is
            self.tau *= rng.choice([1.0, 0.25, 0.05], n, p=[0.4, 0.3, 0.3])
        self.dead = np.maximum(self.tau * self.draw("dead time"), 1.0 if self.test else 0.25)
        small = 0.02 if not self.test else 0.5
        self.lag2 = np.maximum(self.tau * small * rng.random(n), 0.25)
        self.lag3 = np.maximum(self.lag2 * rng.random(n), 0.25)
        self.inverse = np.where(rng.random(n) < 0.2, 0.8, 0.0) if self.test else np.zeros(n)
        self.gain = rng.choice([-1.0, 1.0], n) * 2.0 ** rng.uniform(-1.0, 1.0, n)
        self.valve_lag = rng.uniform(0.15, 0.8, n) if self.test else np.full(n, 0.2)

    def _response(self, w: Floats) -> npt.NDArray[np.complex128]:
        s = 1j * w
        first = np.where(self.integrating[:, None], self.tau[:, None] * s, 1.0 + self.tau[:, None] * s)
        rest = (1.0 + self.lag2[:, None] * s) * (1.0 + self.lag3[:, None] * s) * (1.0 + self.valve_lag[:, None] * s)
        zero = 1.0 - self.inverse[:, None] * self.lag3[:, None] * s
        return np.asarray(np.abs(self.gain[:, None]) * zero * np.exp(-s * (self.dead[:, None] + 0.5)) / (first * rest))

    def _tune(self) -> None:
        n, rng = self.n, self.rng
        self.integral = np.where(
            self.integrating,
            4.0 * (self.dead + self.lag2) * rng.uniform(1.0, 2.5, n),
            self.tau * rng.uniform(0.6, 1.5, n),
        )
        self.integral = np.maximum(self.integral, 2.0)
        servo = self.kind == "servo"
        sticking = self.cause == "stiction"
        self.integral[servo & ~sticking & (rng.random(n) < 0.5)] = 1e9  # a position loop without integral action
        self.derivative = np.where((rng.random(n) < 0.3) & self.test, 0.4 * (self.dead + self.lag2), 0.0)
        margin = self.draw("good margin")
        for cause, name in (("too tight", "tight margin"), ("too sluggish", "sluggish margin")):
            margin = np.where(self.cause == cause, self.draw(name), margin)
        if not self.test:  # valves stick behind cautious controllers too: then the log holds few slips
            worn = np.isin(self.cause, ["stiction", "backlash"])
            margin = np.where(worn, margin * np.exp(rng.uniform(0.0, 1.8, n)), margin)
        self.margin = margin
        w = np.geomspace(0.01, np.pi, 600)[None, :] / np.minimum(self.dead, 20.0)[:, None]
        s = 1j * w
        filtered = 1.0 + 0.1 * self.derivative[:, None] * s
        control = 1.0 + 1.0 / (self.integral[:, None] * s) + self.derivative[:, None] * s / filtered
        open_loop = control * self._response(w)
        phase = np.unwrap(np.angle(open_loop), axis=1)
        crossed = np.argmax(phase < -np.pi, axis=1)
        rows = np.arange(n)
        self.crossover = w[rows, crossed]
        self.control = np.sign(self.gain) / (np.abs(open_loop[rows, crossed]) * margin)

    def _draw_signals(self) -> None:
        rng, n = self.rng, self.n
        total = WARM_UP + max(LENGTHS)
        self.length = rng.choice(LENGTHS, n)
        self.r = np.full((n, total), 50.0)
        for lane in range(n):
            moves = self.kind[lane] == "servo" and self.cause[lane] not in ("frozen sensor",)
            if moves:
                self.r[lane] += _trajectory(rng, total, self.crossover[lane])
            elif rng.random() < 0.35:
                for _ in range(rng.integers(1, 4)):
                    self.r[lane, rng.integers(WARM_UP, total) :] += rng.choice([-1, 1]) * rng.uniform(1.0, 6.0)
            elif not self.test and rng.random() < 0.25:  # the inner loop of a cascade
                self.r[lane] += rng.uniform(0.1, 1.0) * _wander(rng, total, rng.uniform(0.5, 20.0))
        self.noise = self.draw("noise")[:, None] * rng.standard_normal((n, total))
        pole = np.exp(-1.0 / (self.tau * rng.uniform(0.3, 3.0, n)))
        load = np.zeros((n, total))
        shock = rng.standard_normal((n, total)) * (self.draw("disturbance") * np.sqrt(1.0 - pole**2))[:, None]
        for k in range(1, total):
            load[:, k] = pole * load[:, k - 1] + shock[:, k]
        self.load = load
        self.size = np.zeros(n)
        self.size[np.isin(self.cause, ["too tight", "too sluggish"])] = self.margin[
            np.isin(self.cause, ["too tight", "too sluggish"])
        ]
        t = np.arange(total)
        amplitude, relative = self.draw("outside amplitude"), self.draw("outside frequency")
        for lane in np.flatnonzero(self.cause == "oscillation from outside"):
            self.load[lane] += amplitude[lane] * self._outside(t, self.crossover[lane] * relative[lane])
            self.size[lane] = amplitude[lane]
        self.stick, self.jump, self.gap = np.zeros(n), np.zeros(n), np.zeros(n)
        of = self.cause == "stiction"
        self.stick[of] = self.draw("stiction")[of]
        self.jump[of] = self.stick[of] * self.draw("jump")[of]
        gap = self.cause == "backlash"
        self.gap[gap] = self.draw("backlash")[gap]
        self.size += self.stick + self.gap
        self.low, self.high = np.full(n, -50.0), np.full(n, 50.0)
        for lane in np.flatnonzero(self.cause == "saturation"):
            # the load asks for more than the actuator has, part of the time
            share = rng.uniform(0.2, 0.9)
            demand = 8.0 * self.load[lane] / self.load[lane].std() * rng.uniform(0.5, 1.0)
            self.load[lane] = demand
            self.high[lane] = -np.quantile(demand, share)
            self.size[lane] = share

    def _outside(self, t: npt.NDArray[np.int64], w: float) -> Floats:
        rng = self.rng
        drift = np.cumsum(rng.standard_normal(t.size)) * 0.02 * np.sqrt(w)
        phase = w * t + rng.uniform(0.0, 6.28) + (drift if self.test else 0.0)
        if self.test and rng.random() < 0.35:  # the limit cycle of another loop, smoothed on its way
            wave, pole = np.sign(np.sin(phase)), np.exp(-w / rng.uniform(0.7, 2.0))
            for k in range(1, t.size):
                wave[k] = pole * wave[k - 1] + (1.0 - pole) * wave[k]
            return np.asarray(wave)
        return np.asarray(np.sin(phase))

    def run(self) -> list[Loop]:
        """Simulate all lanes and return their logs."""
        n, total, h = self.n, self.r.shape[1], 1.0 / STEPS
        u, y = np.zeros((n, total)), np.zeros((n, total))
        x1, x2, x3 = np.zeros(n), np.zeros(n), np.zeros(n)
        delay = np.maximum((self.dead * STEPS).astype(int), 1)
        line, rows = np.zeros((n, delay.max() + 1)), np.arange(n)
        valve = _Friction(self) if self.test else _TwoParameters(self)
        total_error, last_error, filtered, out, at = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), 0
        held, previous = (self.cause == "manual"), np.zeros(n)
        move = (self.rng.random((n, total)) < 0.004) * self.rng.normal(0.0, 2.0, (n, total))
        for k in range(total):
            out = x3 - self.inverse * (x2 - x3)
            y[:, k] = out + self.noise[:, k]
            error = self.r[:, k] - 50.0 - y[:, k]
            alpha = 1.0 / (1.0 + 0.1 * self.derivative)
            filtered = np.where(self.derivative > 0.0, filtered + alpha * (error - last_error - filtered), 0.0)
            wanted = self.control * (error + total_error + self.derivative * filtered)
            limited = np.clip(wanted, self.low, self.high)
            total_error = np.where(wanted == limited, total_error + error / self.integral, total_error)
            last_error = error
            limited = np.where(held & (k >= WARM_UP), previous + move[:, k], limited)
            previous = limited
            u[:, k] = limited
            for _ in range(STEPS):
                travel = valve.advance(limited, h)
                line[rows, at % line.shape[1]] = travel
                late = line[rows, (at - delay) % line.shape[1]]
                at += 1
                feed = self.gain * late + np.abs(self.gain) * self.load[:, k]
                x1 = x1 + h * np.where(self.integrating, feed, feed - x1) / self.tau
                x2 = x2 + np.minimum(h / self.lag2, 1.0) * (x1 - x2)
                x3 = x3 + np.minimum(h / self.lag3, 1.0) * (x2 - x3)
        return [self._log(lane, u[lane], y[lane]) for lane in range(n)]

    def _log(self, lane: int, u: Floats, y: Floats) -> Loop:
        rng, rows = self.rng, slice(WARM_UP, WARM_UP + int(self.length[lane]))
        r, u, y = self.r[lane, rows], 50.0 + u[rows], 50.0 + y[rows]
        size, cause = float(self.size[lane]), str(self.cause[lane])
        if cause == "frozen sensor":
            start = int(rng.uniform(0.0, 0.6) * y.size)
            y = np.where(np.arange(y.size) >= start, y[start], y)
            size = 1.0 - start / y.size
            late = np.arange(y.size) >= start  # the controller goes on against an error that does not move
            drift = np.cumsum(np.where(late, self.control[lane] * (r - y) / self.integral[lane], 0.0))
            u = np.clip(np.where(late, u[start] + drift + self.control[lane] * (r - r[start]), u), 0.0, 100.0)
        if cause == "quantisation":
            low, high = DRAWS["quantum"]
            size = float(rng.uniform(low, high))
            if rng.random() < 0.5:
                quantum = size * float(np.std(y - r))
                y = quantum * np.round(y / quantum)
            else:
                compress = swinging_door if self.test else dead_band
                y = compress(y, size * float(np.std(y - r)))
                u = compress(u, size * float(np.std(u))) if rng.random() < 0.5 else u
        elif not self.test and cause != "frozen sensor":  # converters of few bits spoil the other logs a little
            u, y = (_round(x, rng.uniform(0.1, 0.8)) if rng.random() < 0.3 else x for x in (u, y))
        return Loop(cause, size, r, u, y, str(self.kind[lane]))


class _TwoParameters:
    """Stiction after He et al. (2007) with f_S and f_D, and an ideal gap: what the training family has."""

    def __init__(self, lanes: _Lanes) -> None:
        self.static, self.kinetic = 0.5 * (lanes.stick + lanes.jump), 0.5 * (lanes.stick - lanes.jump)
        self.gap, self.x, self.contact = 0.5 * lanes.gap, np.zeros(lanes.n), np.zeros(lanes.n)
        self.sticks, self.done = lanes.stick > 0.0, 0
        seized = self.sticks & (lanes.rng.random(lanes.n) < 0.35)  # some do not move again
        onset = WARM_UP + lanes.rng.uniform(-0.2, 0.5, lanes.n) * lanes.length
        self.seized_from = np.where(seized, np.maximum(onset, WARM_UP - 100.0) * STEPS, np.inf)

    def advance(self, u: Floats, h: float) -> Floats:
        off, self.done = u - self.x, self.done + 1
        static = np.where(self.done > self.seized_from, np.inf, self.static)
        slipped = np.where(np.abs(off) > static, u - np.sign(off) * self.kinetic, self.x)
        self.x = np.where(self.sticks, slipped, u)
        self.contact = np.clip(self.contact, self.x - self.gap, self.x + self.gap)
        return np.asarray(self.contact)


class _Friction:
    """A stem with mass, spring, viscous and Stribeck friction, and a gap behind it: what the test family has."""

    def __init__(self, lanes: _Lanes) -> None:
        n, rng = lanes.n, lanes.rng
        self.static, self.kinetic = 0.5 * (lanes.stick + lanes.jump), 0.5 * (lanes.stick - lanes.jump)
        self.skew = rng.uniform(0.8, 1.25, n)  # friction differs between the directions
        self.viscous, self.mass = lanes.valve_lag, 0.05 * lanes.valve_lag
        self.stribeck = np.maximum(0.2 * lanes.stick, 0.01)
        self.gap, self.x, self.v = 0.5 * lanes.gap, np.zeros(n), np.zeros(n)
        self.contact = np.zeros(n)
        self.bend = rng.uniform(-0.004, 0.004, n)  # of the characteristic of the valve

    def advance(self, u: Floats, h: float) -> Floats:
        pull = u - self.x
        way = np.where(self.v != 0.0, np.sign(self.v), np.sign(pull))
        skew = np.where(way > 0.0, self.skew, 1.0 / self.skew)
        breakaway = self.static * skew
        friction = (
            self.kinetic * skew + (breakaway - self.kinetic * skew) * np.exp(-np.abs(self.v) / self.stribeck)
        ) * way
        free = (self.v + h / self.mass * (pull - friction)) / (1.0 + h * self.viscous / self.mass)
        rests = (self.v == 0.0) & (np.abs(pull) <= breakaway)
        turns = (self.v != 0.0) & (np.sign(free) != np.sign(self.v))
        self.v = np.where(rests | turns, 0.0, free)
        self.x = self.x + h * self.v
        self.contact = np.clip(self.contact, self.x - self.gap, self.x + self.gap)
        return np.asarray(self.contact + self.bend * self.contact * np.abs(self.contact))


def _trajectory(rng: np.random.Generator, total: int, crossover: float) -> Floats:
    t = np.arange(total)
    period = 2.0 * np.pi / crossover * rng.uniform(8.0, 30.0)
    shape = rng.integers(3)
    if shape == 0:
        return np.asarray(rng.uniform(5.0, 30.0) * np.sin(2.0 * np.pi * t / period))
    if shape == 1:  # ramp, hold, ramp
        corner = np.abs(((t / period) % 1.0) * 4.0 - 2.0) - 1.0
        return np.asarray(rng.uniform(5.0, 30.0) * np.clip(1.6 * corner, -1.0, 1.0))
    waves = sum(np.sin(2.0 * np.pi * t / period * f + rng.uniform(0.0, 6.28)) / f for f in (1.0, 1.7, 2.9))
    return np.asarray(rng.uniform(3.0, 15.0) * waves)


def _round(x: Floats, share: float) -> Floats:
    """Round to a grid of a share of the standard deviation from one sample to the next."""
    grid = max(share * float(np.std(np.diff(x))), 1e-9)
    return np.asarray(grid * np.round(x / grid))


def _wander(rng: np.random.Generator, total: int, memory: float) -> Floats:
    """Return a first-order process of variance 1."""
    x, pole = rng.standard_normal(total), np.exp(-1.0 / memory)
    for k in range(1, total):
        x[k] = pole * x[k - 1] + np.sqrt(1.0 - pole**2) * x[k]
    return x


def dead_band(x: Floats, band: float) -> Floats:
    """Keep a value where it differs from the last one by more than a band, and draw lines between."""
    kept = [0]
    for i in range(1, x.size):
        if abs(x[i] - x[kept[-1]]) > band:
            kept.append(i)
    kept = sorted({*kept, x.size - 1})
    return np.asarray(np.interp(np.arange(x.size), kept, x[kept]))


def swinging_door(x: Floats, band: float) -> Floats:
    """Compress by swinging doors (Bristol, 1990) and draw lines between the values that are left."""
    kept, low, high = [0], -np.inf, np.inf
    for i in range(1, x.size):
        run = i - kept[-1]
        high = min(high, (x[i] + 0.5 * band - x[kept[-1]]) / run)
        low = max(low, (x[i] - 0.5 * band - x[kept[-1]]) / run)
        if low > high:
            kept.append(i - 1) if i - 1 > kept[-1] else kept.append(i)
            run = max(i - kept[-1], 1)
            high, low = (x[i] + 0.5 * band - x[kept[-1]]) / run, (x[i] - 0.5 * band - x[kept[-1]]) / run
    kept = sorted({*kept, x.size - 1})
    return np.asarray(np.interp(np.arange(x.size), kept, x[kept]))
