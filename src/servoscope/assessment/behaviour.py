"""The facts on how a loop behaves: oscillation, tracking, signs of a sticking valve, friction, dead band."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable

import numpy as np
from numpy.polynomial import polynomial

from servoscope.assessment import indices
from servoscope.assessment.facts import LoopFact, find_quantum, noise_of
from servoscope.assessment.log import LogForms, Signals, thin
from servoscope.core.arrays import FloatArray

MIN_SAMPLES_PER_PERIOD = 6.0
WINDOWS, WINDOWS_PER_PERIOD = 100, 12  # of a log, and of an oscillation, in which y is looked at for rest
MAX_REST, NOISE_BAND, MIN_ERROR = 0.2, 4.0, 6.0  # of the error; of the noise of a window; of the same
MIN_CORRELATION = 0.3  # of the steps of r and y, for a delay
MAX_LAG_SHARE = 0.1  # of a log
MIN_STEP_SHARE, MIN_HELD = 0.2, 10  # of the range of r; rows after a step
LAGS, INPUTS = 6, 2  # of y and of u in a linear model
MAX_MODEL_ROWS = 5000
MIN_EXPLAINED = 0.9  # of the controller's steps by a PID law
MIN_FRICTION_GAIN = 0.3  # of the variance that y, speed and acceleration leave of u
MIN_SPEED = 0.05  # of the largest speed
MIN_BAND = 3.0  # of a dead band, in standard errors and in quanta


def oscillation(log: LogForms) -> Iterable[LoopFact]:
    """Yield the regular oscillation of the error, and whether it is sampled often enough."""
    cycle, step = log.even.cycle, log.even.step
    if cycle is None:
        return
    shares = {"regularity": min(cycle.regularity, 100.0), "share of the error's variance [%]": 100.0 * cycle.share}
    source = "Thornhill, Huang and Zhang, J. Process Control 13, 2003, 91"
    yield LoopFact(name="oscillation", value=cycle.period * step, unit="s", evidence=shares, source=source)
    if cycle.period < MIN_SAMPLES_PER_PERIOD:
        yield LoopFact(name="samples per period", value=cycle.period, unit="", source=source)
    elif (damping := find_damping(log.even.e, cycle.period)) is not None:
        yield LoopFact(name="damping as seen", value=damping, unit="", source="Soderstrom and Stoica, 1989, chapter 4")


def find_damping(e: FloatArray, period: float, order: int = 8) -> float | None:
    """Return the damping of the pole of an autoregression of the error that is next to the oscillation's frequency."""
    step = max(int(period / 12.0), 1)
    e = thin(e - e.mean(), step)[-MAX_MODEL_ROWS:]
    if e.size < 6 * order:
        return None
    rows = np.stack([e[order - i - 1 : -i - 1] for i in range(order)], axis=1)
    poles = np.roots(np.r_[1.0, -np.linalg.lstsq(rows, e[order:], rcond=None)[0]])
    s = np.log(np.where(np.abs(poles) > 1e-9, poles, 1e-9).astype(complex))
    near = s[np.argmin(np.abs(np.abs(s.imag) - 2.0 * np.pi * step / period) + np.maximum(-s.real, 0.0))]
    return float(np.clip(-near.real / max(abs(near), 1e-9), 0.0, 1.0))


def tracking(log: LogForms) -> Iterable[LoopFact]:
    """Yield how far y is from r, how much later, and how far it overshoots after steps of r."""
    x = log.even
    span = float(max(np.ptp(x.y), 0.0 if x.r is None else np.ptp(x.r)))
    if x.r is None or not span > 0.0:
        return
    rms = float(np.sqrt(np.mean(np.square(x.e))))
    yield LoopFact(name="tracking error", value=100.0 * rms / span, unit="%", evidence={"rms [y]": rms})
    if not np.ptp(x.r) > 0.1 * np.ptp(x.y):
        return
    moves, answers = (np.diff(thin(s, -(-s.size // 20_000))) for s in (x.r, x.y))
    size, lags = 2 * moves.size, max(int(MAX_LAG_SHARE * moves.size), 2)
    together = np.fft.irfft(np.conj(np.fft.rfft(moves, size)) * np.fft.rfft(answers, size), size)[:lags]
    together /= max(float(np.linalg.norm(moves) * np.linalg.norm(answers)), 1e-300)
    if together.max() >= MIN_CORRELATION:
        late = float(np.argmax(together)) * x.step * -(-x.r.size // 20_000)
        yield LoopFact(
            name="delay of y behind r", value=late, unit="s", evidence={"correlation": float(together.max())}
        )
    steps = np.flatnonzero(np.abs(np.diff(x.r)) > MIN_STEP_SHARE * np.ptp(x.r))
    held = [(a, b) for a, b in itertools.pairwise([*steps.tolist(), x.r.size - 1]) if b - a >= MIN_HELD]
    over = [
        100.0 * float(np.max((x.y[a + 1 : b] - x.r[a + 1]) / (x.r[a + 1] - x.r[a]), initial=0.0))
        for a, b in held[:1000]
    ]
    if over:
        yield LoopFact(name="overshoot", value=float(np.median(over)), unit="%", evidence={"steps": float(len(over))})


def gain_margin(log: LogForms) -> Iterable[LoopFact]:
    """Yield the gain margin of the loop as the log shows it, where u follows a PID law of the error.

    y(k) = a_1 y(k-1) + ... + b_1 u(k-1) + b_2 u(k-2) and u(k) - u(k-1) = c_0 e(k) + c_1 e(k-1) + c_2 e(k-2), both by
    least squares (Ljung, System Identification, 1999, sections 4.2 and 13.5).
    """
    x = log.even.rows(slice(-MAX_MODEL_ROWS, None))
    steps = np.diff(x.u)[1:]
    if x.r is None or x.y.size < 20 * LAGS or not steps.var() > 0.0 or not np.ptp(x.y) > 0.0:
        return
    errors = np.stack([x.e[2:], x.e[1:-1], x.e[:-2]], axis=1)
    law = np.linalg.lstsq(errors, steps, rcond=None)[0]
    if 1.0 - np.var(steps - errors @ law) / steps.var() < MIN_EXPLAINED:
        return
    y, u = x.y - x.y.mean(), x.u - x.u.mean()
    past = [y[LAGS - i : y.size - i] for i in range(1, LAGS + 1)]
    past += [u[LAGS - i : u.size - i] for i in range(1, INPUTS + 1)]
    weights = np.linalg.lstsq(np.stack(past, axis=1), y[LAGS:], rcond=None)[0]
    back = np.exp(-1j * np.geomspace(0.003, np.pi, 400))
    plant = back * polynomial.polyval(back, weights[LAGS:]) / (1.0 - back * polynomial.polyval(back, weights[:LAGS]))
    loop = plant * polynomial.polyval(back, law) / (1.0 - back)
    crosses = np.flatnonzero((loop.imag[:-1] * loop.imag[1:] < 0.0) & (loop.real[:-1] < 0.0))
    strongest = max(float(np.max(-loop.real[crosses], initial=0.01)), -float(loop.real[-1]))
    if strongest > 0.01:
        yield LoopFact(
            name="gain margin as seen", value=1.0 / strongest, unit="", source="Ljung, System Identification, 1999"
        )


def rest_while_driven(log: Signals) -> tuple[float, list[tuple[int, int]]]:
    """Return the share of the travel of u during which y rests though it is away from r, and where (rows).

    Windows are averaged. While the error keeps its sign, the longest stretch counts in which neither y nor the error
    changes by more than a fifth of the error. What u travels there, into the direction of the error, is summed. The
    integrator winds up against a valve that sticks (Yamashita, Control Eng. Practice 14, 2006, 503-510); in a linear
    loop, however slow, a stretch ends after a fifth of the way that u has to go.
    """
    e, cycle = log.e, log.cycle
    width = max(e.size // WINDOWS, 1)
    if cycle is not None:
        width = int(np.clip(cycle.period / WINDOWS_PER_PERIOD, 1, width))
    u, y, e = (thin(x, width) for x in (log.u, log.y, e))
    noise = float(np.std(np.diff(log.y))) / np.sqrt(2.0 * width)
    sign = np.where(np.abs(e) > MIN_ERROR * noise, np.sign(e), 0.0)
    edges = np.r_[0, np.flatnonzero(np.diff(sign)) + 1, sign.size]
    net, where = 0.0, []
    for first, stop in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        begin, best, rows = first, 0.0, (0, 0)
        for end in range(first + 1, stop if sign[first] else first):
            while True:
                part = slice(begin, end + 1)
                band = max(MAX_REST * float(np.mean(np.abs(e[part]))), NOISE_BAND * noise)
                if max(np.ptp(y[part]), np.ptp(e[part])) <= band:
                    break
                begin += 1
            way = float(u[end] - u[begin]) * sign[first]
            if end - begin >= 2 and abs(way) > abs(best):
                best, rows = way, (begin * width, (end + 1) * width - 1)
        net += best
        if best:
            where.append(rows)
    return abs(net) / max(float(np.abs(np.diff(u)).sum()), 1e-300), where


def valve_signs(log: LogForms) -> Iterable[LoopFact]:
    """Yield the textbook signs of a sticking valve; `assess` has the rule that is drawn from them."""
    x = log.even
    if x.r is not None and np.ptp(x.u) > 0.0:
        share, where = rest_while_driven(x)
        yield LoopFact(
            name="y rests while u moves on",
            value=100.0 * share,
            unit="%",
            spans=tuple((float(x.t[a]), float(x.t[b])) for a, b in where[:100]),
            source="Yamashita, Control Eng. Practice 14, 2006, 503",
        )
    cycle = x.cycle
    if cycle is None or cycle.period < MIN_SAMPLES_PER_PERIOD or not np.ptp(x.u) > 0.0:
        return
    u, y = (indices.smooth_to(s, cycle.period) for s in (x.u, x.e))
    odd = indices.cross_correlation_index(u, y)
    yield LoopFact(
        name="odd cross-correlation", value=odd, unit="", source="Horch, Control Eng. Practice 7, 1999, 1221"
    )
    shapes = {"y rectangular": indices.shape_index(y, cycle.period)[1]}
    triangular = indices.shape_index(u, cycle.period)[0]
    source = "He, Wang, Pottmann and Qin, Ind. Eng. Chem. Res. 46, 2007, 4549"
    yield LoopFact(name="triangular half cycles of u", value=triangular, unit="", evidence=shapes, source=source)
    width = indices.ellipse_width(u, y, cycle.period) / float(np.ptp(u))
    source = "Choudhury et al., Control Eng. Practice 14, 2006, 1395"
    yield LoopFact(name="width of the ellipse of y over u", value=100.0 * width, unit="%", source=source)


def friction(log: LogForms) -> Iterable[LoopFact]:
    """Yield the step of u at reversals of y: what the direction of motion adds to y, speed and acceleration.

    u = c_0 + c_1 y + c_2 v + c_3 a + F sign(v) by least squares (Armstrong, Control of Machines with Friction, 1991).
    """
    x = log.even
    width = max(int(x.y.size / 4000), 2)
    u, y = thin(x.u, width), thin(x.y, width)
    v = np.gradient(y) if y.size >= 50 else np.zeros(y.size)
    fast = np.abs(v) > max(
        MIN_SPEED * float(np.abs(v).max()), 3.0 * noise_of(x.y) / np.sqrt(width) if y.size >= 50 else 0
    )
    if not fast.sum() >= 20 or min((v[fast] > 0.0).sum(), (v[fast] < 0.0).sum()) < 10:
        return
    rows = np.stack([np.ones(y.size), y - y.mean(), v, np.gradient(v), np.sign(v)], axis=1)[fast]
    weights = np.linalg.lstsq(rows, u[fast], rcond=None)[0]
    without = np.linalg.lstsq(rows[:, :-1], u[fast], rcond=None)[0]
    left, before = np.var(u[fast] - rows @ weights), np.var(u[fast] - rows[:, :-1] @ without)
    if before - left >= MIN_FRICTION_GAIN * before:
        size = abs(float(weights[-1]))
        source = "Armstrong, Control of Machines with Friction, 1991"
        share = 100.0 * size / max(float(np.abs(log.moving.u).max()), 1e-300)
        yield LoopFact(name="friction at reversals", value=share, unit="%", evidence={"[u]": size}, source=source)


def dead_band(log: LogForms) -> Iterable[LoopFact]:
    """Yield the dead band of y at reversals of r: how far y differs at one r, reached from below and from above.

    e = c_0 + c_1 r' + B/2 sign(r') by least squares; lag is in c_1.
    """
    x = log.even
    if x.r is None or x.r.size < 100:
        return
    speed = np.gradient(x.r)
    moves = np.abs(speed) > MIN_SPEED * float(np.abs(speed).max())
    up, down = moves & (speed > 0.0), moves & (speed < 0.0)
    if min(up.sum(), down.sum()) < 20:
        return
    rows = np.stack([np.ones(x.r.size), speed, np.gradient(speed), np.sign(speed)], axis=1)[moves]
    weights = np.linalg.lstsq(rows, x.e[moves], rcond=None)[0]
    reversals = int((np.diff(np.sign(speed[moves])) != 0.0).sum())
    spread = float(np.std(x.e[moves] - rows @ weights)) / np.sqrt(max(reversals, 1))
    band, sides = 2.0 * float(weights[-1]), {"from below": float(x.e[up].mean()), "from above": float(x.e[down].mean())}
    if reversals >= 2 and band > MIN_BAND * max(2.0 * spread, find_quantum(log.moving.y) or 0.0):
        yield LoopFact(name="dead band at reversals", value=band, unit="y", evidence=sides, source="Hagglund, 2007")


LOOP_FACTS: tuple[Callable[[LogForms], Iterable[LoopFact]], ...] = (
    oscillation,
    tracking,
    gain_margin,
    valve_signs,
)
AXIS_FACTS: tuple[Callable[[LogForms], Iterable[LoopFact]], ...] = (friction, dead_band)
