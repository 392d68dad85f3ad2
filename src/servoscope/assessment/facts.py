"""What a fact is, and the facts on how a log was recorded: rest, grids, straight lines, constants, limits."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from pydantic import BaseModel, ConfigDict

from servoscope.assessment.log import LogForms, Signals
from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.signals.defects import mask_edges

ROUNDING = 1e-9  # of the range of a signal, below which two numbers are the same
MAX_GRID_ROWS = 100_000  # that a grid is looked for in
MAX_LEVELS = 2.0**17  # of a grid over the range of a signal; finer ones are how numbers are written
GRID_TOLERANCE, MIN_ON_GRID = 0.1, 0.9  # of a quantum, and the share of the steps that has to keep to it
MIN_RUN = 3  # rows, for which a value has to stay
MIN_STRAIGHT_RUNS, MIN_STRAIGHT_SHARE = 8, 0.3
MIN_SATURATED_SHARE, MAX_BESIDE_LIMIT, LIMIT_BAND, MIN_MOVING = 0.01, 0.5, 0.001, 0.4
MAX_FINE_STEP, MIN_QUANTA = (
    0.005,
    3.0,
)  # of a grid, in standard deviations of a signal's differences, at which straight lines show
MIN_CONSTANT_RUN = 20.0  # rows, over what repeats of single rows explain
USUAL_RUNS, MIN_UNUSUAL = 10, 4.0  # the longest runs of a signal, and what an unusual one is over their median
MIN_MOTION, MAX_REPEATS = 1e-6, 0.05  # of a range; of the rows, on a grid that is fine
MIN_UNANSWERED = 0.3  # of the range of the other signal, which moves while this one is constant


class LoopFact(BaseModel):
    """One measured fact.

    Parameters
    ----------
    name, value, unit
        What was measured.
    evidence
        What it was computed from, by name.
    spans
        Where in the log, from and to [s on its clock]; what figures show.
    source
        The textbook or paper that defines it.
    """

    model_config = ConfigDict(frozen=True)

    name: str
    value: float
    unit: str
    evidence: dict[str, float] = {}
    spans: tuple[tuple[float, float], ...] = ()
    source: str = ""


def constant_runs(mask: BoolArray) -> tuple[IntArray, IntArray]:
    """Return where runs of true values begin, and their lengths."""
    starts, stops = mask_edges(mask).T
    return starts, stops - starts


def repeats(x: FloatArray) -> BoolArray:
    """Return which steps of a signal are none, shape (N - 1,)."""
    return np.asarray(np.abs(np.diff(x)) <= ROUNDING * float(np.ptp(x)))


def as_spans(t: FloatArray, starts: IntArray, stops: IntArray) -> tuple[tuple[float, float], ...]:
    """Return at most 100 stretches, the longest, as times; stops: the last rows of each."""
    longest = np.sort(np.argsort(starts - stops, kind="stable")[:100])
    return tuple((float(t[a]), float(t[b])) for a, b in zip(starts[longest], stops[longest], strict=True))


def rest(log: LogForms) -> Iterable[LoopFact]:
    """Yield how much of the log nothing moves in; all other facts leave it out."""
    if log.rest.any():
        starts, lengths = constant_runs(log.rest)
        spans = as_spans(log.recorded.t, starts, starts + lengths - 1)
        yield LoopFact(name="rest", value=100.0 * float(log.rest.mean()), unit="%", spans=spans)


def find_quantum(x: FloatArray) -> float | None:
    """Return the step of the grid that the values of a signal lie on, or None where there is no such grid.

    The steps between neighbouring values are whole multiples of the step of the grid (Widrow and Kollar, Quantization
    Noise, 2008, chapter 1). A grid of more than 2^17 levels over the range is how numbers are stored.
    """
    x = x[:MAX_GRID_ROWS]
    values, counts = np.unique(x, return_counts=True)
    often = counts > 1
    if counts[often].sum() > MIN_ON_GRID * x.size:
        values = values[often]  # without what was interpolated here and there
    steps = np.diff(values)
    steps = steps[steps > ROUNDING * max(float(np.abs(values).max()), float(np.ptp(values)))]
    if steps.size < 2 or (steps.size < MIN_STRAIGHT_RUNS and values.size > x.size / 5.0):
        return None
    # the smallest step may be made by one odd value, and of few values there may be no other
    for least in (float(np.quantile(steps, 0.05, method="lower")), float(steps.min())):
        for divisor in range(1, 7):
            grid = least / divisor
            for largest in (2.5, 10.5, 100.5, np.inf):  # the quantum becomes finer with what it is fitted to
                few = steps[steps <= largest * grid]
                whole = np.maximum(np.round(few / grid), 1.0)
                grid = float(few @ whole / (whole @ whole)) if few.size else grid
            if np.mean(np.abs(steps / grid - np.round(steps / grid)) <= GRID_TOLERANCE) >= MIN_ON_GRID:
                return grid if np.ptp(values) <= MAX_LEVELS * grid else None
    return None


def noise_of(x: FloatArray) -> float:
    """Return the standard deviation of white noise in a signal, by the median of its second differences."""
    return float(np.median(np.abs(np.diff(x, 2))) / (0.6745 * np.sqrt(6.0)))


def quantum(log: LogForms) -> Iterable[LoopFact]:
    """Yield the step of the grid of y and of u, where there is one, with the noise beside it."""
    for name, x in (("y", log.moving.y), ("u", log.moving.u)):
        step = find_quantum(x)
        if step is not None and step > 0.0:
            evidence = {"noise": noise_of(x), "levels": float(np.ptp(x)) / step + 1.0}
            source = "Widrow and Kollar, Quantization Noise, 2008"
            yield LoopFact(name=f"quantum of {name}", value=step, unit=name, evidence=evidence, source=source)


def straight(log: LogForms) -> Iterable[LoopFact]:
    """Yield how much of y and of u lies exactly on straight lines, as in an archive that compresses.

    At least five rows in line, eight lines and more (Thornhill, Choudhury and Shah, J. Process Control 14, 2004,
    389-398). A signal on a coarse grid repeats its values by itself.
    """
    for name, x in (("y", log.moving.y), ("u", log.moving.u)):
        step, span, slope = find_quantum(x) or 0.0, float(np.ptp(x)), np.diff(x)
        coarse = step > MAX_FINE_STEP * np.std(slope)
        bend = np.abs(np.diff(slope)) <= ROUNDING * span + (0.0 if coarse else 2.1 * step)
        starts, lengths = constant_runs(bend)
        long = lengths >= MIN_RUN
        if coarse:  # motion on a grid makes lines of few quanta, and steps of one between rests
            jumps = np.abs(slope[~repeats(x)])
            held = jumps.size > 0 and float(np.median(jumps)) >= MIN_QUANTA * step
            steep = np.abs(slope[starts]) >= MIN_QUANTA * step
            long &= steep | (held & (np.abs(slope[starts]) <= ROUNDING * span))
        starts, lengths = starts[long], lengths[long] + 2
        if lengths.size < MIN_STRAIGHT_RUNS:
            continue
        share = float(lengths.sum() - lengths.max()) / x.size
        if share >= MIN_STRAIGHT_SHARE:
            yield LoopFact(
                name=f"straight lines in {name}",
                value=min(100.0 * share, 100.0),
                unit="%",
                evidence={"rows per line": float(np.median(lengths))},
                spans=as_spans(log.moving.t, starts, starts + lengths - 1),
                source="Thornhill, Choudhury and Shah, J. Process Control 14, 2004, 389",
            )


def unanswered(of: FloatArray, others: tuple[FloatArray, ...], coarse: bool) -> tuple[IntArray, IntArray]:
    """Return start and length of the stretches in which a signal is constant though one of the others moves.

    Repeats of single rows explain a run of L rows with the probability p^L, p: share of repeats outside the longest.
    A run is unusual where it is four times as long as the longest ones in their median. Of a coarse signal, one of the
    others has to cross a large part of its range as well.
    """
    same = repeats(of) if np.ptp(of) > 0.0 else np.ones(of.size - 1, np.bool_)
    starts, lengths = constant_runs(same)
    if not starts.size:
        return starts, lengths
    often = float(same.sum() - lengths.max()) / max(same.size - int(lengths.max()), 1)
    usual = float(np.sort(np.r_[lengths, np.zeros(USUAL_RUNS)])[-USUAL_RUNS // 2])
    kept = (lengths * (1.0 - often) >= MIN_CONSTANT_RUN) & (lengths >= MIN_UNUSUAL * usual)
    starts, lengths = starts[kept], lengths[kept]
    least = MIN_UNANSWERED if coarse else MIN_MOTION
    moves = [
        any(np.ptp(x[a + n // 4 : a + n - n // 4 + 1]) > least * np.ptp(x) for x in others)
        for a, n in zip(starts.tolist(), lengths.tolist(), strict=True)
    ]
    chosen = np.array(moves, dtype=bool)
    return starts[chosen], lengths[chosen]


def is_coarse(x: FloatArray) -> bool:
    """Return whether a signal often repeats its values by itself, its longest rest left out."""
    same = repeats(x)
    longest = int(constant_runs(same)[1].max(initial=0))
    return bool(same.sum() - longest > MAX_REPEATS * (same.size - longest))


def constant_fact(name: str, log: Signals, starts: IntArray, lengths: IntArray, source: str) -> Iterable[LoopFact]:
    """Yield the share of the time in some stretches, with the longest."""
    if starts.size:
        yield LoopFact(
            name=name,
            value=100.0 * float(lengths.sum() + 1) / log.t.size,
            unit="%",
            evidence={"longest [s]": float(lengths.max()) * log.step},
            spans=as_spans(log.t, starts, starts + lengths),
            source=source,
        )


def frozen(log: LogForms) -> Iterable[LoopFact]:
    """Yield how long y is constant though r or u moves: a sensor, or its communication, that has stopped."""
    x = log.recorded
    coarse = is_coarse(x.y)
    if coarse and x.r is None and np.ptp(x.y) > 0.0:
        return  # u moves to hold a load, too
    others = (x.u,) if x.r is None else (x.r,) if coarse else (x.r, x.u)
    starts, lengths = unanswered(x.y, others, coarse)
    yield from constant_fact("frozen y", x, starts, lengths, "Isermann, Fault-Diagnosis Systems, 2006, chapter 7")


def limit_rows(log: Signals, side: int) -> BoolArray:
    """Return which rows are at the highest (side 1) or lowest (-1) value of u, if it is a limit.

    Values pile up there, and the error, from which u comes, moves on.
    """
    u = log.u
    x, span = side * u, float(np.ptp(u))
    below = float(x.max()) - x
    at = below <= ROUNDING * span
    step = 0.0 if at.mean() < MIN_SATURATED_SHARE else find_quantum(u) or 0.0
    beside = (~at) & (below <= max(LIMIT_BAND * span, 1.5 * step))
    _, lengths = constant_runs(at)
    if lengths.max() < MIN_RUN:
        return np.zeros(u.size, np.bool_)
    moves = float(np.mean(~repeats(log.e)[at[1:] & at[:-1]]))
    piled = at.mean() >= MIN_SATURATED_SHARE and beside.sum() <= MAX_BESIDE_LIMIT * at.sum()
    few = np.unique(u[:: max(u.size // 5000, 1)]).size < 20  # a signal that is switched
    pushes = abs(float(np.mean(np.sign(log.e[at]))))  # always the same way, as an error in manual mode does not
    return at if piled and not few and min(moves, pushes) >= MIN_MOVING else np.zeros(u.size, np.bool_)


def saturated(log: LogForms) -> Iterable[LoopFact]:
    """Yield how long u is at a limit, on either side."""
    u = log.moving.u
    if not np.ptp(u) > 0.0:
        return
    for side, name in ((1, "u at its upper limit"), (-1, "u at its lower limit")):
        at = limit_rows(log.moving, side)
        if at.any():
            starts, lengths = constant_runs(at)
            yield LoopFact(
                name=name,
                value=100.0 * float(at.mean()),
                unit="%",
                evidence={"limit": float(u.max() if side > 0 else u.min())},
                spans=as_spans(log.moving.t, starts, starts + lengths - 1),
                source="Astrom and Hagglund, Advanced PID Control, 2006, section 3.5",
            )


def manual(log: LogForms) -> Iterable[LoopFact]:
    """Yield how long u does not react to the error, away from its limits: the loop is open."""
    x = log.recorded
    starts, lengths = unanswered(x.u, (x.e,), is_coarse(x.u))
    if np.ptp(x.u) > 0.0:
        limit = limit_rows(x, 1) | limit_rows(x, -1)
        free = ~limit[starts]
        starts, lengths = starts[free], lengths[free]
    yield from constant_fact("u does not react", x, starts, lengths, "Thornhill and Horch, Control Eng. Practice, 2007")


RECORDING_FACTS: tuple[Callable[[LogForms], Iterable[LoopFact]], ...] = (
    rest,
    quantum,
    straight,
    frozen,
    saturated,
    manual,
)
