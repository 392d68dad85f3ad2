"""The facts on how a loop behaves: oscillation, tracking, signs of a sticking valve, friction, dead band."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from scipy import signal

from servoscope.assessment import indices
from servoscope.assessment.facts import LoopFact
from servoscope.assessment.log import LogForms, Signals, thin
from servoscope.core.arrays import FloatArray
from servoscope.signals.quantisation import white_noise_std

MIN_SAMPLES_PER_PERIOD = 6.0
WINDOWS, WINDOWS_PER_PERIOD = 100, 12  # of a log, and of an oscillation, in which y is looked at for rest
MAX_REST, NOISE_BAND, MIN_ERROR = 0.2, 4.0, 6.0  # of the error; of the noise of a window; of the same
MIN_CORRELATION = 0.3  # of the steps of r and y, for a delay
MAX_LAG_SHARE = 0.1  # of a log
MIN_STEP_SHARE, MIN_HELD, MAX_STEPS = 0.2, 10, 1000  # of the range of r; rows after a step; steps that are looked at
POLES, LAGS, INPUTS = 8, 6, 2  # of an autoregression; of y and of u in a linear model
MAX_MODEL_ROWS, SPEED_ROWS = 5000, 4000
MIN_EXPLAINED = 0.9  # of the controller's steps by a PID law
MIN_FRICTION_GAIN = 0.3  # of the variance that y, speed and acceleration leave of u
MIN_SPEED, MIN_MOVING = 0.05, 20  # of the largest speed; rows in either direction
MIN_BAND = 3.0  # of a dead band, in standard errors and in quanta


def regress(target: FloatArray, *columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the weights of columns by least squares, and what they leave of the target, shape (N,)."""
    rows = np.stack(columns, axis=1)
    weights = np.asarray(np.linalg.lstsq(rows, target, rcond=None)[0], dtype=np.float64)
    return weights, target - rows @ weights


def lagged(x: FloatArray, lags: int, skip: int) -> list[FloatArray]:
    """Return x(k - 1), x(k - 2), ... for the samples k from `skip` on."""
    return [x[skip - i : x.size - i] for i in range(1, lags + 1)]


def oscillation(log: LogForms) -> Iterator[LoopFact]:
    """Yield the regular oscillation of the error, its damping, or that it is sampled too seldom to say more.

    The damping is that of the pole of an autoregression of the error that is next to the oscillation's frequency.
    """
    cycle, step = log.even.cycle, log.even.step
    if cycle is None:
        return
    shares = {"regularity": min(cycle.regularity, 100.0), "share of the error's variance [%]": 100.0 * cycle.share}
    source = "Thornhill, Huang and Zhang, J. Process Control 13, 2003, 91"
    yield LoopFact(name="oscillation", value=cycle.period * step, unit="s", evidence=shares, source=source)
    if cycle.period < MIN_SAMPLES_PER_PERIOD:
        yield LoopFact(name="samples per period", value=cycle.period, unit="", source=source)
        return
    factor = max(int(cycle.period / WINDOWS_PER_PERIOD), 1)
    e = thin(log.even.e - log.even.e.mean(), factor)[-MAX_MODEL_ROWS:]
    if e.size >= 6 * POLES:
        poles = np.roots(np.r_[1.0, -regress(e[POLES:], *lagged(e, POLES, POLES))[0]]).astype(complex)
        s = np.log(poles[np.abs(poles) > 1e-9])
        near = s[np.argmin(np.abs(np.abs(s.imag) - 2.0 * np.pi * factor / cycle.period) + np.maximum(-s.real, 0.0))]
        damping, source = (
            float(np.clip(-near.real / max(abs(near), 1e-9), 0.0, 1.0)),
            "Soderstrom and Stoica, 1989, chapter 4",
        )
        yield LoopFact(name="damping as seen", value=damping, unit="", source=source)


def tracking(log: LogForms) -> Iterator[LoopFact]:
    """Yield how far y is from r, how much later, and how far it overshoots after steps of r."""
    x = log.even
    if x.r is None or not (span := float(max(np.ptp(x.y), np.ptp(x.r)))) > 0.0:
        return
    rms = float(np.sqrt(np.mean(np.square(x.e))))
    yield LoopFact(name="tracking error", value=100.0 * rms / span, unit="%", evidence={"rms [y]": rms})
    if not np.ptp(x.r) > 0.1 * np.ptp(x.y):
        return
    moves, answers = np.diff(x.r), np.diff(x.y)
    together = signal.correlate(answers, moves)[moves.size - 1 :][: max(int(MAX_LAG_SHARE * moves.size), 2)]
    together /= max(float(np.linalg.norm(moves) * np.linalg.norm(answers)), 1e-300)
    if together.max() >= MIN_CORRELATION:
        late, likeness = float(np.argmax(together)) * x.step, {"correlation": float(together.max())}
        yield LoopFact(name="delay of y behind r", value=late, unit="s", evidence=likeness)
    steps = np.flatnonzero(np.abs(moves) > MIN_STEP_SHARE * np.ptp(x.r))
    held = [(a, b) for a, b in itertools.pairwise([*steps.tolist(), moves.size]) if b - a >= MIN_HELD]
    over = [float(np.max((x.y[a + 1 : b] - x.r[a + 1]) / moves[a], initial=0.0)) for a, b in held[:MAX_STEPS]]
    if over:
        counted = {"steps": float(len(over))}
        yield LoopFact(name="overshoot", value=100.0 * float(np.median(over)), unit="%", evidence=counted)


def gain_margin(log: LogForms) -> Iterator[LoopFact]:
    """Yield the gain margin of the loop as the log shows it, where u follows a PID law of the error.

    y(k) = a_1 y(k-1) + ... + b_1 u(k-1) + b_2 u(k-2) and u(k) - u(k-1) = c_0 e(k) + c_1 e(k-1) + c_2 e(k-2), both by
    least squares (Ljung, System Identification, 1999, sections 4.2 and 13.5).
    """
    x = log.even.rows(slice(-MAX_MODEL_ROWS, None))
    steps = np.diff(x.u)[1:]
    if x.r is None or x.y.size < 20 * LAGS or not steps.var() > 0.0 or not np.ptp(x.y) > 0.0:
        return
    law, left = regress(steps, x.e[2:], x.e[1:-1], x.e[:-2])
    if 1.0 - left.var() / steps.var() < MIN_EXPLAINED:
        return
    y, u = x.y - x.y.mean(), x.u - x.u.mean()
    weights, _ = regress(y[LAGS:], *lagged(y, LAGS, LAGS), *lagged(u, INPUTS, LAGS))
    w = np.geomspace(0.003, np.pi, 400)
    _, plant = signal.freqz(np.r_[0.0, weights[LAGS:]], np.r_[1.0, -weights[:LAGS]], w)
    loop = plant * signal.freqz(law, [1.0, -1.0], w)[1]
    crosses = np.flatnonzero((loop.imag[:-1] * loop.imag[1:] < 0.0) & (loop.real[:-1] < 0.0))
    strongest = max(float(np.max(-loop.real[crosses], initial=0.01)), -float(loop.real[-1]))
    if strongest > 0.01:
        source = "Ljung, System Identification, 1999"
        yield LoopFact(name="gain margin as seen", value=1.0 / strongest, unit="", source=source)


def rest_while_driven(log: Signals) -> tuple[float, list[tuple[int, int]]]:
    """Return the share of the travel of u during which y rests though it is away from r, and where (rows).

    Windows are averaged. While the error keeps its sign, the longest stretch counts in which neither y nor the error
    changes by more than a fifth of the error. What u travels there, into the direction of the error, is summed. The
    integrator winds up against a valve that sticks (Yamashita, Control Eng. Practice 14, 2006, 503-510); in a linear
    loop, however slow, a stretch ends after a fifth of the way that u has to go.
    """
    width = max(log.e.size // WINDOWS, 1)
    if log.cycle is not None:
        width = int(np.clip(log.cycle.period / WINDOWS_PER_PERIOD, 1, width))
    u, y, e = (thin(x, width) for x in (log.u, log.y, log.e))
    noise = float(np.std(np.diff(log.y))) / np.sqrt(2.0 * width)
    sign = np.where(np.abs(e) > MIN_ERROR * noise, np.sign(e), 0.0)
    net, where = 0.0, []
    for first, stop in itertools.pairwise([0, *(np.flatnonzero(np.diff(sign)) + 1).tolist(), sign.size]):
        begin, best, rows = first, 0.0, (0, 0)
        for end in range(first + 2, stop if sign[first] else first):
            while max(np.ptp(y[begin : end + 1]), np.ptp(e[begin : end + 1])) > max(
                MAX_REST * float(np.mean(np.abs(e[begin : end + 1]))), NOISE_BAND * noise
            ):
                begin += 1
            way = float(u[end] - u[begin]) * sign[first]
            if end - begin >= 2 and abs(way) > abs(best):
                best, rows = way, (begin * width, (end + 1) * width - 1)
        net += best
        where += [rows] if best else []
    return abs(net) / max(float(np.abs(np.diff(u)).sum()), 1e-300), where


def sticking(log: LogForms) -> Iterator[LoopFact]:
    """Yield how long y rests while u moves on; `assess` has the rule that is drawn from it."""
    x = log.even
    if x.r is not None and np.ptp(x.u) > 0.0:
        share, where = rest_while_driven(x)
        spans = tuple((float(x.t[a]), float(x.t[b])) for a, b in where[:100])
        source = "Yamashita, Control Eng. Practice 14, 2006, 503"
        yield LoopFact(name="y rests while u moves on", value=100.0 * share, unit="%", spans=spans, source=source)


def valve_signs(log: LogForms) -> Iterator[LoopFact]:
    """Yield the textbook signs of a sticking valve in a regular oscillation."""
    x, cycle = log.even, log.even.cycle
    if cycle is None or cycle.period < MIN_SAMPLES_PER_PERIOD or not np.ptp(x.u) > 0.0:
        return
    # without what is slower than a third of the oscillation, or faster than its 7th harmonic
    u, e = (indices.band_pass(s, 1.0 / 3.0 / cycle.period, 7.0 / cycle.period) for s in (x.u, x.e))
    width = 100.0 * indices.ellipse_width(u, e, cycle.period) / float(np.ptp(u))
    for name, value, unit, source in (
        (
            "odd cross-correlation",
            indices.cross_correlation_index(u, e),
            "",
            "Horch, Control Eng. Practice 7, 1999, 1221",
        ),
        (
            "triangular half cycles of u",
            indices.shape_index(u, cycle.period),
            "",
            "He, Wang, Pottmann and Qin, Ind. Eng. Chem. Res. 46, 2007, 4549",
        ),
        ("width of the ellipse of y over u", width, "%", "Choudhury et al., Control Eng. Practice 14, 2006, 1395"),
    ):
        yield LoopFact(name=name, value=value, unit=unit, source=source)


def friction(log: LogForms) -> Iterator[LoopFact]:
    """Yield the step of u at reversals of y: what the direction of motion adds to y, speed and acceleration.

    u = c_0 + c_1 y + c_2 v + c_3 a + F sign(v) by least squares (Armstrong, Control of Machines with Friction, 1991).
    """
    width = max(log.even.y.size // SPEED_ROWS, 2)
    u, y = thin(log.even.u, width), thin(log.even.y, width)
    v = np.gradient(y)
    fast = np.abs(v) > max(MIN_SPEED * np.abs(v).max(), 3.0 * white_noise_std(log.even.y) / np.sqrt(width))
    if min((fast & (v > 0.0)).sum(), (fast & (v < 0.0)).sum()) < MIN_MOVING:
        return
    columns = [c[fast] for c in (np.ones(y.size), y - y.mean(), v, np.gradient(v), np.sign(v))]
    (*_, size), left = regress(u[fast], *columns)
    _, before = regress(u[fast], *columns[:-1])
    if before.var() - left.var() >= MIN_FRICTION_GAIN * before.var():
        share, source = (
            100.0 * abs(size) / max(np.abs(log.moving.u).max(), 1e-300),
            "Armstrong, Control of Machines with Friction, 1991",
        )
        yield LoopFact(name="friction at reversals", value=share, unit="%", evidence={"[u]": abs(size)}, source=source)


def dead_band(log: LogForms) -> Iterator[LoopFact]:
    """Yield the dead band of y at reversals of r: how far y differs at one r, reached from below and from above.

    e = c_0 + c_1 r' + c_2 r'' + B/2 sign(r') by least squares; lag is in c_1.
    """
    x = log.even
    if x.r is None:
        return
    speed = np.gradient(x.r)
    moves = np.abs(speed) > MIN_SPEED * np.abs(speed).max()
    up, down = moves & (speed > 0.0), moves & (speed < 0.0)
    if min(up.sum(), down.sum()) < MIN_MOVING:
        return
    columns = (np.ones(speed.size), speed, np.gradient(speed), np.sign(speed))
    (*_, half), left = regress(x.e[moves], *(c[moves] for c in columns))
    reversals = int((np.diff(np.sign(speed[moves])) != 0.0).sum())
    error = 2.0 * float(left.std()) / np.sqrt(max(reversals, 1))
    if reversals >= 2 and 2.0 * half > MIN_BAND * max(error, log.moving.quantum["y"] or 0.0):
        sides = {"from below": float(x.e[up].mean()), "from above": float(x.e[down].mean())}
        yield LoopFact(
            name="dead band at reversals", value=2.0 * half, unit="y", evidence=sides, source="Hagglund, 2007"
        )
