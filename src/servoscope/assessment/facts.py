"""What a fact is, and the facts on how a log was recorded: rest, grids, straight lines, constants, limits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from pydantic import BaseModel, ConfigDict

from servoscope.assessment.log import LogForms, Signals
from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.signals.defects import mask_edges
from servoscope.signals.quantisation import ROUNDING, white_noise_std

MIN_LINE, MIN_LINES, MIN_STRAIGHT = 5, 8, 0.3  # rows of a straight line; lines of a signal; share of the rows in them
MAX_FINE_STEP, MIN_QUANTA = 0.005, 3.0  # of a grid: in standard deviations of the steps of a signal; of a line's steps
MIN_AT_LIMIT, MAX_BESIDE, LIMIT_BAND = 0.01, 0.5, 0.001  # of the rows; of the rows at the limit; of the range of u
MIN_MOVING, MIN_PUSHING = 0.4, 0.55  # of the steps of e at a limit; of e there, its mean over its mean size
MIN_LEVELS = 20  # of a signal that is not switched
MIN_CONSTANT = 20.0  # rows, over what repeats of single rows explain
USUAL_RUNS, MIN_UNUSUAL = 10, 4.0  # the longest runs of a signal, and what an unusual one is over their median
MIN_MOTION, MIN_WIDE_MOTION = 1e-6, 0.3  # of the range of another signal, which moves while this one is constant
MAX_REPEATS = 0.05  # of the rows, on a grid that is fine


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


def share_fact(name: str, log: Signals, runs: IntArray, source: str = "", **evidence: float) -> Iterator[LoopFact]:
    """Yield the share of the time in some runs of rows, first and after the last, with the longest hundred."""
    if runs.size:
        lengths = np.diff(runs)[:, 0]
        longest = runs[np.sort(np.argsort(-lengths, kind="stable")[:100])]
        yield LoopFact(
            name=name,
            value=min(100.0 * float(lengths.sum()) / log.t.size, 100.0),
            unit="%",
            evidence={"longest [s]": float(lengths.max()) * log.step, **evidence},
            spans=tuple((float(log.t[a]), float(log.t[b - 1])) for a, b in longest),
            source=source,
        )


def repeats(x: FloatArray) -> BoolArray:
    """Return which steps of a signal are none, shape (N - 1,)."""
    return np.asarray(np.abs(np.diff(x)) <= ROUNDING * float(np.ptp(x)))


def rest(log: LogForms) -> Iterator[LoopFact]:
    """Yield how much of the log nothing moves in; all other facts leave it out."""
    yield from share_fact("rest", log.recorded, mask_edges(log.rest))


def quantum(log: LogForms) -> Iterator[LoopFact]:
    """Yield the step of the grid of y and of u, where there is one, with the noise beside it."""
    for name, step in log.moving.quantum.items():
        if step is not None:
            x = getattr(log.moving, name)
            evidence = {"noise": white_noise_std(x), "levels": float(np.ptp(x)) / step + 1.0}
            source = "Widrow and Kollar, Quantization Noise, 2008"
            yield LoopFact(name=f"quantum of {name}", value=step, unit=name, evidence=evidence, source=source)


def straight(log: LogForms) -> Iterator[LoopFact]:
    """Yield how much of y and of u lies exactly on straight lines, as in an archive that compresses.

    At least five rows in line, eight lines and more (Thornhill, Choudhury and Shah, J. Process Control 14, 2004,
    389-398). A signal on a coarse grid repeats its values by itself.
    """
    for name, quantum in log.moving.quantum.items():
        x = getattr(log.moving, name)
        step, slope, noise = quantum or 0.0, np.diff(x), ROUNDING * float(np.ptp(x))
        coarse = step > MAX_FINE_STEP * np.std(slope)
        runs = mask_edges(np.abs(np.diff(slope)) <= noise + (0.0 if coarse else 2.1 * step)) + np.array([0, 2])
        runs = runs[np.diff(runs)[:, 0] >= MIN_LINE]
        if coarse:  # motion on a grid makes lines of few quanta, and steps of one between rests
            jumps, steep = np.abs(slope[np.abs(slope) > noise]), np.abs(slope[runs[:, 0]])
            held = jumps.size > 0 and float(np.median(jumps)) >= MIN_QUANTA * step
            runs = runs[(steep >= MIN_QUANTA * step) | (held & (steep <= noise))]
        lengths = np.diff(runs)[:, 0]
        if lengths.size >= MIN_LINES and lengths.sum() - lengths.max() >= MIN_STRAIGHT * x.size:
            source = "Thornhill, Choudhury and Shah, J. Process Control 14, 2004, 389"
            yield from share_fact(f"straight lines in {name}", log.moving, runs, source)


def is_coarse(same: BoolArray) -> bool:
    """Return whether a signal often repeats its values by itself, its longest rest left out."""
    longest = np.diff(mask_edges(same)).max(initial=0)
    return bool(same.sum() - longest > MAX_REPEATS * (same.size - longest))


def unanswered(same: BoolArray, others: Sequence[FloatArray], coarse: bool) -> IntArray:
    """Return the runs of rows in which a signal is constant though one of the others moves; same: steps that are none.

    Repeats of single rows explain a run of L rows with the probability p^L, p: share of repeats outside the longest.
    A run is unusual where it is four times as long as the longest ones in their median. Of a coarse signal, one of the
    others has to cross a large part of its range as well.
    """
    runs = mask_edges(same)
    lengths = np.diff(runs)[:, 0]
    often = (same.sum() - lengths.max(initial=0)) / max(same.size - lengths.max(initial=0), 1)
    usual = np.sort(np.r_[lengths, np.zeros(USUAL_RUNS)])[-USUAL_RUNS // 2]
    runs = runs[(lengths * (1.0 - often) >= MIN_CONSTANT) & (lengths >= MIN_UNUSUAL * usual)] + np.array([0, 1])
    least = MIN_WIDE_MOTION if coarse else MIN_MOTION
    inner = [slice(a + (b - a) // 4, b - (b - a) // 4) for a, b in runs]
    moves = [any(np.ptp(x[rows]) > least * np.ptp(x) for x in others) for rows in inner]
    return np.asarray(runs[np.array(moves, np.bool_)])


def frozen(log: LogForms) -> Iterator[LoopFact]:
    """Yield how long y is constant though r or u moves: a sensor, or its communication, that has stopped."""
    x = log.moving
    same = repeats(x.y)
    coarse = is_coarse(same)
    others = [s for s in (x.r, None if coarse else x.u) if s is not None]  # u moves to hold a load, too
    source = "Isermann, Fault-Diagnosis Systems, 2006, chapter 7"
    yield from share_fact("frozen y", x, unanswered(same, others, coarse), source)


def limit_rows(log: Signals, side: int) -> BoolArray:
    """Return which rows are at the highest (side 1) or lowest (-1) value of u, if it is a limit.

    Values pile up there, and the error, from which u comes, moves on.
    """
    below = float((side * log.u).max()) - side * log.u
    span = float(np.ptp(log.u))
    at = below <= ROUNDING * span
    beside = ~at & (below <= max(LIMIT_BAND * span, 1.5 * (log.quantum["u"] or 0.0)))
    piled = at.mean() >= MIN_AT_LIMIT and beside.sum() <= MAX_BESIDE * at.sum()
    switched = np.unique(log.u[:: max(log.u.size // 5000, 1)]).size < MIN_LEVELS
    if not piled or switched or np.diff(mask_edges(at)).max() < 3:
        return np.zeros(at.size, np.bool_)
    moves = float(np.mean(~repeats(log.e)[at[1:] & at[:-1]]))
    e = log.e[at]
    pushes = abs(float(e.mean())) / max(float(np.abs(e).mean()), 1e-300)  # one way, as an error in manual mode does not
    return at & (moves >= MIN_MOVING) & (pushes >= MIN_PUSHING)


def saturated(log: LogForms) -> Iterator[LoopFact]:
    """Yield how long u is at a limit, on either side."""
    u = log.moving.u
    source = "Astrom and Hagglund, Advanced PID Control, 2006, section 3.5"
    for side, name, limit in ((1, "upper", u.max()), (-1, "lower", u.min())):
        runs = mask_edges(limit_rows(log.moving, side))
        yield from share_fact(f"u at its {name} limit", log.moving, runs, source, limit=float(limit))


def manual(log: LogForms) -> Iterator[LoopFact]:
    """Yield how long u does not react to the error, away from its limits: the loop is open."""
    x = log.moving
    same = repeats(x.u)
    runs = unanswered(same, (x.e,), is_coarse(same))
    free = ~(limit_rows(x, 1) | limit_rows(x, -1))[runs[:, 0]]
    yield from share_fact("u does not react", x, runs[free], "Thornhill and Horch, Control Eng. Practice, 2007")
