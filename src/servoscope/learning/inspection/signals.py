"""What r, u and y look like sample by sample: sampling, quantisation, limits, rest and dead zone."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from servoscope.core import outofcore
from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.messages import Message, message
from servoscope.models.loop import Loop
from servoscope.signals import Recording
from servoscope.signals.cleanup import rows_at_limits
from servoscope.signals.defects import mask_spans, split_consecutive
from servoscope.signals.quantisation import find_quantum

REST_SPEED_SHARE = 0.02  # share of the fast speeds (99th percentile) below which the output rests
MIN_REST_S = 0.25  # s: turning round is not rest
BINS = 40  # of |u|, to look for a dead zone
MAX_SHARE_INSIDE_DEAD_ZONE, MIN_SHARE_OUTSIDE_DEAD_ZONE = (
    0.1,
    0.5,
)  # shares of moving samples inside a dead zone and just outside it


class InspectionModel(BaseModel):
    """Base of all that an inspection says: frozen, and nothing that is not declared."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Sampling(InspectionModel):
    """How the signals were sampled; a stretch lies between gaps or run ends, jitter is a standard deviation."""

    sample_rate_hz: float
    samples: int
    duration_s: float
    runs: int
    stretches: int
    longest_stretch_s: float
    jitter_percent: float
    missing_percent: float


class DefectCount(InspectionModel):
    """How often one kind of defect occurred, and the first of them in words."""

    kind: str
    events: int
    rows: int
    first: str


class Quantisation(InspectionModel):
    """Resolution of one signal: smallest step, log2 of range over step, share of samples that repeat.

    `step` and `effective_bits` are None where no grid is visible.
    """

    signal: Literal["r", "u", "y"]
    step: float | None
    effective_bits: float | None
    repeated: float
    values: int


class Saturation(InspectionModel):
    """Shares of time that u is at its limits; `source` says whether the loop names them or u shows them."""

    low: float | None
    high: float | None
    share_low: float
    share_high: float
    longest_s: float
    source: Literal["loop", "seen", "none"]


class DeadZone(InspectionModel):
    """Range of u in which the output does not move, and how many samples say so."""

    low: float
    high: float
    samples: int


class Rest(InspectionModel):
    """Share of time at rest, and the speed [output per s] below which that is."""

    share: float
    speed: float


def sampling(recording: Recording) -> Sampling:
    """Describe the time axis."""
    rate, t, restart = recording.sample_rate, recording.t, recording.restart
    spread = outofcore.sample_chunks(t.size)
    steps = np.concatenate([np.diff(t[rows])[~restart[rows][1:]] for rows in spread]) * rate
    starts = outofcore.find_rows(lambda rows: restart[rows], restart)
    longest = int(np.diff(np.append(starts, t.size)).max()) if starts.size else t.size
    expected = max(round(recording.duration_s * rate), 1)
    return Sampling(
        sample_rate_hz=rate,
        samples=recording.samples,
        duration_s=recording.duration_s,
        runs=int(np.unique(recording.run[np.append(0, starts)]).size),
        stretches=max(int(starts.size), 1),
        longest_stretch_s=longest / rate,
        jitter_percent=100.0 * float(np.std(steps)) if steps.size else 0.0,
        missing_percent=100.0 * max(0.0, 1.0 - recording.samples / expected),
    )


def defect_counts(recording: Recording) -> tuple[DefectCount, ...]:
    """Sum up the recording's defects, kind by kind."""
    kinds = dict.fromkeys(defect.kind for defect in recording.defects)
    counts = []
    for kind in kinds:
        those = [defect for defect in recording.defects if defect.kind == kind]
        rows = sum(defect.count for defect in those)
        counts.append(DefectCount(kind=kind, events=len(those), rows=rows, first=those[0].message))
    return tuple(counts)


def quantisation(signal: Literal["r", "u", "y"], x: FloatArray) -> Quantisation:
    """Look for a grid on which the values of a signal, shape (N,), stand."""
    repeated = float(np.mean(np.diff(x) == 0.0)) if x.size > 1 else 0.0
    values = np.unique(x)
    step = find_quantum(x)
    return Quantisation(
        signal=signal,
        step=step,
        effective_bits=math.log2(float(values[-1] - values[0]) / step) if step else None,
        repeated=repeated,
        values=int(values.size),
    )


def saturation(recording: Recording, loop: Loop | None) -> Saturation:
    """Count the samples at the loop's limits, or, where it names none, on plateaus at the extremes of u."""
    given = loop.input_limits if loop is not None else None
    (high, at_high), (low, at_low) = rows_at_limits(recording.u, given, 1e-6)
    stretches = [*split_consecutive(at_low), *split_consecutive(at_high)]
    return Saturation(
        low=low if given is not None or at_low.size else None,
        high=high if given is not None or at_high.size else None,
        share_low=at_low.size / recording.samples,
        share_high=at_high.size / recording.samples,
        longest_s=max((rows.size for rows in stretches), default=0) / recording.sample_rate,
        source="loop" if given is not None else "seen" if stretches else "none",
    )


def detect_rest(recording: Recording, v: FloatArray, noise: float) -> tuple[BoolArray, Rest]:
    """Find where the output rests."""
    speed = max(REST_SPEED_SHARE * float(np.quantile(np.abs(v), 0.99)), 3.0 * noise)
    shortest = max(round(MIN_REST_S * recording.sample_rate), 5)
    slow = np.abs(v) <= speed
    at_rest = np.zeros_like(slow)
    for start, stop in mask_spans(slow):
        at_rest[start:stop] = stop - start >= shortest
    return at_rest, Rest(share=float(at_rest.mean()), speed=speed)


def dead_zone(u: FloatArray, v: FloatArray, speed: float) -> DeadZone | None:
    """Find the range of u around 0 in which the output does not move, though u of that size should move it.

    None where u has not been on both sides, or where the output moves there too, as that of a mass or spring does.
    """
    moving = np.abs(v) > speed
    if not moving.any() or not np.any(u[moving]):
        return None
    per_u = float(np.median(np.abs(v[moving]) / np.maximum(np.abs(u[moving]), 1e-12 * np.abs(u).max())))
    edges = [_edge(side * u[side * u > 0.0], moving[side * u > 0.0], speed / per_u) for side in (-1.0, 1.0)]
    if edges[0] is None or edges[1] is None:
        return None
    inside = (u >= -edges[0]) & (u <= edges[1])
    if moving[inside].mean() > MAX_SHARE_INSIDE_DEAD_ZONE:
        return None
    return DeadZone(low=-edges[0], high=edges[1], samples=int(inside.sum()))


def _edge(u: FloatArray, moving: BoolArray, expected: float) -> float | None:
    """Return up to which u the output does not move; `expected` is the u that would move it barely."""
    if u.size < 100:
        return None
    top = float(np.quantile(u, 0.995))
    bins = np.minimum((u / top * BINS).astype(np.int64), BINS)
    counts = np.bincount(bins, minlength=BINS + 1)
    moved = np.bincount(bins, weights=moving, minlength=BINS + 1)
    share = moved / np.maximum(counts, 1)
    reach = 0
    while reach < BINS and counts[reach] >= 10 and share[reach] <= MAX_SHARE_INSIDE_DEAD_ZONE:
        reach += 1
    edge = reach * top / BINS
    # Between the two lies what starts to move: friction at rest is not sharp.
    outside = share[reach : reach + 10][counts[reach : reach + 10] > 0]
    if reach < 2 or edge < 3.0 * expected or not outside.size or outside.mean() < MIN_SHARE_OUTSIDE_DEAD_ZONE:
        return None
    return edge


def detect_swapped_channels(recording: Recording) -> Message | None:
    """Return why u and y seem to be swapped; None if they do not."""
    if np.array_equal(recording.r, recording.u):
        return None  # the command is u itself, which it follows of course
    r, u, y = recording.r, recording.u, recording.y
    scale = float(np.std(r))
    if not scale > 0.0:
        return None
    of_u, of_y = float(np.std(u - r)), float(np.std(y - r))
    if of_u < 0.5 * scale and of_u < 0.5 * of_y:
        return message("inspection.u_in_units_of_r")
    if np.std(u) == 0.0 or np.std(y) == 0.0:
        return None
    follows_u, follows_y = (abs(float(np.corrcoef(r, x)[0, 1])) for x in (u, y))
    rough_u, rough_y = (float(np.std(np.diff(x)) / np.std(x)) for x in (u, y))
    if follows_u > 0.9 and follows_y < 0.7 and rough_u < 0.5 * rough_y:
        return message("inspection.u_correlates_with_r", of_u=follows_u, of_y=follows_y)
    return None
