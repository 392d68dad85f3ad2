"""Whether what an axis drives swings or rattles more from some time on: backlash, a loose belt, a worn bearing.

The load behind a gap or a belt cannot be predicted from the encoder at the motor, so it has no term; what it does to
the motor is left in the innovations, louder in some band than before. How loud a band is depends on the motion, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from servoscope.core.arrays import FloatArray, IntArray
from servoscope.isolation.ml.axis_window import AxisWindow
from servoscope.isolation.posterior import INTERVAL

BLOCK_S = 1.0
BANDS = 5  # octaves below half the sample rate
MIN_BLOCKS = 15  # blocks
MIN_AMPLITUDE_RATIO = 2.0  # times the healthy amplitude: by less than that the noise of a sound machine may wander
EDGE_BLOCKS = 5  # blocks at both ends, in which no onset is looked for
MIN_COUNTED_SHARE = 0.25  # share of a block's samples that have to count
LAGS = 8  # samples of the autocovariance by which a vibration is told from noise
FALSE_ALARMS = 1e-4  # share of healthy recordings that are called changed
MIN_EDGE_SHARE = 0.01  # of a stretch, at its ends, in which no onset is tried
MIN_SQUARES = 1e-9  # of squares left; a simulation without noise leaves none
MIN_NOISE_SHARE = 0.3  # of what was added, that louder noise leaves unexplained at least where it is none


@dataclass(frozen=True)
class AxisVibration:
    """By how much the loudest band has grown, as a ratio of amplitudes, and since when."""

    ratio: float
    interval: tuple[float, float]  # 95 %
    onset: tuple[int, int, int]  # samples of the window: lower end, most likely, upper end of the 95 % interval
    detected: int
    statistic: float  # squared t


@dataclass(frozen=True, eq=False)
class _BandEnergies:
    """Seconds in which the axis moved: where each begins, and what of the logarithms of its energies motion leaves."""

    size: int  # samples of each
    begin: IntArray  # (K,)
    energies: FloatArray  # (K, BANDS)
    motion: FloatArray  # orthonormal, (K, 3)

    @classmethod
    def of(cls, window: AxisWindow, e: FloatArray) -> _BandEnergies:
        rate, counted = window.rate, window.counted
        size = max(round(BLOCK_S * rate), 2 ** (BANDS + 1))  # each band has a line
        speed = window.signals.speed
        acceleration = np.gradient(speed) * rate
        starts = range(0, window.samples - size + 1, size)
        begin = np.array([k for k in starts if counted[k : k + size].sum() >= MIN_COUNTED_SHARE * size], dtype=np.int64)
        rows = begin[:, None] + np.arange(size)
        power = np.abs(np.fft.rfft(e[rows] * np.hanning(size), axis=1)) ** 2
        power /= counted[rows].sum(axis=1)[:, None]
        edges = 0.5 * size / 2.0 ** np.arange(BANDS, -1, -1)
        f = np.arange(power.shape[1])
        bands = [power[:, (f > low) & (f <= high)].mean(axis=1) for low, high in pairwise(edges)]
        size_of = [(x[rows] ** 2).mean(axis=1) for x in (speed, acceleration)]
        logs = np.log(np.maximum(np.array(bands + size_of), 1e-300)).T
        motion, _ = np.linalg.qr(np.column_stack([np.ones(len(begin)), logs[:, BANDS:]]))
        return cls(size, begin, logs[:, :BANDS], motion)

    def steps(self, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return steps of the first `count` blocks' logarithms, their deviations and squares left, (onsets, BANDS)."""
        motion, _ = np.linalg.qr(self.motion[:count])
        energies = self.energies[:count] - motion @ (motion.T @ self.energies[:count])
        at = np.arange(EDGE_BLOCKS, count - EDGE_BLOCKS + 1)
        step = (np.arange(count) >= at[:, None]).astype(np.float64)
        step -= step @ motion @ motion.T
        length = (step**2).sum(axis=1)[:, None]
        size = step @ energies / length
        left = np.maximum((energies**2).sum(axis=0) - size**2 * length, MIN_SQUARES)
        return size, np.sqrt(left / (count - motion.shape[1] - 1) / length), left


def find_vibration(
    window: AxisWindow, residual: FloatArray, limit: float, least: float = MIN_AMPLITUDE_RATIO
) -> AxisVibration | None:
    """Return since when a band of the innovations is louder than the motion explains, None where none is.

    `residual`: of the healthy axis, shape (N + m,); `limit`: of the squared t statistic of the best onset and band;
    `least`: of the ratio of amplitudes.
    """
    e = residual[: window.samples]
    blocks = _BandEnergies.of(window, e)
    count = len(blocks.begin)
    if count < MIN_BLOCKS:
        return None
    sizes, stds, left = blocks.steps(count)
    t = sizes / stds
    k, band = np.unravel_index(int(np.argmax(t)), t.shape)
    begin = blocks.begin[EDGE_BLOCKS + int(k)]
    size, std = float(sizes[k, band]), float(stds[k, band])
    ratio, low, high = (float(np.exp(0.5 * (size + way * std))) for way in (0.0, -1.96, 1.96))
    if ratio < least or t[k, band] ** 2 <= limit or _is_noise(window, e, int(begin)):
        return None
    told = next(n for n in range(MIN_BLOCKS, count + 1) if n == count or _largest(blocks, n) ** 2 > limit)
    likelihood = (left[:, band] / left[:, band].min()) ** (-0.5 * count)
    share = np.cumsum(likelihood) / likelihood.sum()
    first, last = (int(blocks.begin[EDGE_BLOCKS + int(np.searchsorted(share, q))]) for q in INTERVAL)
    # a change may come anywhere within a block
    onset = (max(first - blocks.size, 0), int(begin), min(last + blocks.size, window.samples - 1))
    detected = max(int(blocks.begin[told - 1]) + blocks.size - 1, int(begin))
    return AxisVibration(ratio, (low, high), onset, detected, float(t[k, band] ** 2))


def scan_limit(tests: int, false_alarms: float = FALSE_ALARMS) -> float:
    """Return what the largest likelihood ratio of all onsets exceeds in a share of healthy stretches.

    ``P(sup > x) = sqrt(x/(2 pi)) exp(-x/2) (2 log((1 - t)/t) (1 - 1/x) + 2/x)`` for one parameter, onsets from t to
    1 - t (James, James and Siegmund, 1987), times the number of tests.
    """
    x = np.linspace(5.0, 60.0, 2000)
    range_ = 2.0 * np.log((1.0 - MIN_EDGE_SHARE) / MIN_EDGE_SHARE)
    probability = tests * np.sqrt(x / (2.0 * np.pi)) * np.exp(-x / 2.0) * (range_ * (1.0 - 1.0 / x) + 2.0 / x)
    return float(x[np.argmax(probability <= false_alarms)])


def _largest(blocks: _BandEnergies, count: int) -> float:
    sizes, stds, _ = blocks.steps(count)
    return max(float((sizes / stds).max()), 0.0)


def _is_noise(window: AxisWindow, e: FloatArray, begin: int) -> bool:
    """Return whether louder noise of y and of u explains what was added from a sample on."""
    from scipy.optimize import nnls
    from scipy.signal import lfilter

    def autocovariance(x: FloatArray) -> FloatArray:
        return np.array([x[lag:] @ x[: len(x) - lag] for lag in range(LAGS)])

    before, after = (
        autocovariance(e[part]) / max(int(window.counted[part].sum()), 1) for part in (slice(begin), slice(begin, None))
    )
    impulse, f = np.eye(1, 10 * window.filter.settling)[0], window.filter
    shapes = [autocovariance(lfilter(b, f.poles, impulse)) for b in (f.to_y, f.to_acceleration)]
    columns = np.array([shape / shape[0] for shape in shapes]).T
    _, missed = nnls(columns, after - before)
    return bool(missed < MIN_NOISE_SHARE * np.linalg.norm(after - before))
