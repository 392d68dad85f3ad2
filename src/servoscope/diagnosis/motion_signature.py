"""What a valve or drive engineer looks at first: u over position and over speed, forward against backward."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.learning.inspection.model_order import fit_regression
from servoscope.models.loop import Loop
from servoscope.signals import Recording

BINS = 40  # of position and of speed
MIN_SAMPLES_PER_BIN = 5  # samples that a bin needs
SLOW_SPEED_SHARE = 0.02  # of the fast speeds (99th percentile), below which direction means nothing
MAX_MEMORIES = 100.0  # of the estimator, the newest, that are looked at: minutes, whatever the rate
WINDOW = 0.5  # periods of the cutoff over which a parabola is fitted to the signals
MIN_MOTION_PERIODS = 20.0  # periods of the cutoff in motion


class SignatureWidth(NamedTuple):
    """How far apart forward and backward are at rest, with its standard deviation."""

    value: float
    std: float


class MotionSignature(NamedTuple):
    """Mean u by direction, shape (B,) each, NaN where nothing was measured.

    `friction_band`: how much more u takes forward than backward as the speed goes to 0, that is twice the dry friction;
    `lost_motion`: by how much r is further ahead of y forward than backward there, that is backlash; None without r.
    """

    position: FloatArray
    forward: FloatArray
    backward: FloatArray
    speed: FloatArray
    by_speed: FloatArray
    friction_band: SignatureWidth
    lost_motion: SignatureWidth | None


def motion_signature(recording: Recording, loop: Loop, from_s: float, to_s: float) -> MotionSignature | None:
    """Return the signature of the rows with from_s <= t < to_s; None if they hold too little motion both ways."""
    first, end = np.searchsorted(recording.t, [from_s, to_s])
    newest = int(end) - round(MAX_MEMORIES * loop.monitor.memory * loop.sample_rate)
    rows = recording[max(int(first), newest) : int(end)]
    window = 2 * max(2, round(0.5 * WINDOW * loop.sample_rate / loop.cutoff)) + 1
    if rows.samples < 2 * window:
        return None
    # of a speed, the way since the beginning
    way = np.cumsum(rows.y) / loop.sample_rate if loop.plant.derivative else rows.y
    y, v, a = _smoothed(way, rows.restart, window, loop.sample_rate)
    u, _, _ = _smoothed(rows.u, rows.restart, window, loop.sample_rate)
    ahead, _, _ = _smoothed(rows.r - rows.y, rows.restart, window, loop.sample_rate)
    known = np.isfinite(v)
    if not known.any():
        return None
    fast = float(np.quantile(np.abs(v[known]), 0.99))
    moving = known & (np.abs(v) > SLOW_SPEED_SHARE * fast)
    least = 0.5 * MIN_MOTION_PERIODS * loop.sample_rate / loop.cutoff
    if min((moving & (v > 0.0)).sum(), (moving & (v < 0.0)).sum()) < least:
        return None
    position = _bin_edges(y[moving])
    speeds = np.linspace(-fast, fast, BINS + 1)
    block = max(round(loop.monitor.memory * loop.sample_rate), window)
    band = _width_at_rest(u, y, v, a, moving, block)
    if band is None:
        return None
    lost = (
        None
        if np.array_equal(rows.r, rows.u) or loop.plant.derivative
        else _width_at_rest(ahead, y, v, a, moving, block)
    )
    return MotionSignature(
        0.5 * (position[1:] + position[:-1]),
        _bin_means(y, u, moving & (v > 0.0), position),
        _bin_means(y, u, moving & (v < 0.0), position),
        0.5 * (speeds[1:] + speeds[:-1]),
        _bin_means(v, u, moving, speeds),
        band,
        lost,
    )


def compare_signatures(
    recording: Recording, loop: Loop, onset_s: float | None
) -> tuple[MotionSignature | None, MotionSignature | None]:
    """Return the signatures before and from an onset on; without an onset that of the whole recording is the second."""
    start, end = float(recording.t[0]), math.inf
    if onset_s is None or onset_s <= start:
        return None, motion_signature(recording, loop, start, end)
    return motion_signature(recording, loop, start, onset_s), motion_signature(recording, loop, onset_s, end)


def signature_columns(recording: Recording, loop: Loop, onset_s: float | None) -> list[dict[str, Any]]:
    """Return the signatures before and after an onset as plain values: null where nothing was measured.

    `words`: ``before`` and ``after``, or ``measured`` where there is one alone; the widths with their standard
    deviations.
    """
    before, after = compare_signatures(recording, loop, onset_s)
    stretches = []
    for words, signature in (("before", before), ("after" if before else "measured", after)):
        if signature is not None:
            widths = {"friction_band": signature.friction_band, "lost_motion": signature.lost_motion}
            curves = {
                name: getattr(signature, name) for name in ("position", "forward", "backward", "speed", "by_speed")
            }
            plain = {
                name: [None if math.isnan(x) else float(f"{x:.6g}") for x in curve] for name, curve in curves.items()
            }
            stretches.append(
                {"words": words, **plain, **{name: list(width) for name, width in widths.items() if width}}
            )
    return stretches


def _smoothed(x: FloatArray, restart: BoolArray, window: int, rate: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a signal, its first and its second derivative by a moving parabola (Savitzky and Golay, 1964), (N,) each.

    NaN where the window does not fit between two gaps.
    """
    from scipy.signal import savgol_coeffs

    derivatives = np.full((3, x.size), np.nan)
    half = window // 2
    starts = np.flatnonzero(np.append(restart, True))
    weights = [savgol_coeffs(window, 2, deriv=k, delta=1.0 / rate, use="dot") for k in range(3)]
    for start, stop in zip(np.append(0, starts[starts > 0])[:-1], starts[starts > 0], strict=True):
        if stop - start >= window:
            for row, weight in zip(derivatives, weights, strict=True):
                row[start + half : stop - half] = np.correlate(x[start:stop], weight, mode="valid")
    return derivatives[0], derivatives[1], derivatives[2]


def _width_at_rest(
    x: FloatArray, y: FloatArray, v: FloatArray, a: FloatArray, moving: BoolArray, block: int
) -> SignatureWidth | None:
    """Return how far a signal's values forward and backward are apart as the speed goes to 0.

    From least squares on the sign of the speed, the speed by direction, acceleration, position and a constant.
    """
    columns = (np.sign(v), np.maximum(v, 0.0), np.minimum(v, 0.0), a, y, np.ones_like(v))
    phi = np.nan_to_num(np.stack(columns, axis=1))
    fit = fit_regression(("sign", "forward", "backward", "acceleration", "position", "one"), x, phi, moving, block)
    if fit is None:
        return None
    return SignatureWidth(2.0 * float(fit.theta[0]), 2.0 * math.sqrt(max(float(fit.covariance[0, 0]), 0.0)))


def _bin_edges(x: FloatArray) -> FloatArray:
    low, high = np.quantile(x, [0.005, 0.995])
    return np.linspace(float(low), float(high), BINS + 1)


def _bin_means(at: FloatArray, x: FloatArray, used: BoolArray, edges: FloatArray) -> FloatArray:
    """Return the mean of x in bins of another signal, shape (B,), NaN where there are too few samples."""
    which = np.digitize(at[used], edges) - 1
    inside = (which >= 0) & (which < BINS)
    counts = np.bincount(which[inside], minlength=BINS)
    sums = np.bincount(which[inside], weights=x[used][inside], minlength=BINS)
    return np.where(counts >= MIN_SAMPLES_PER_BIN, sums / np.maximum(counts, 1), np.nan)
