"""What a loop shows besides its coefficients: levels and band powers of u and of the tracking error, window by window.

Each sample belongs to a motion by the reference (forward, backward, rest) and, where the motion repeats, to a time
since that motion began. Over a window, u and e = r - y are averaged in each of these bins, and the powers of their
frequency bands in each motion. Longer windows are sums of the shortest. One pass, a state of plain numbers: a recording
or stream may be cut anywhere.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict

from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.estimation.window_kernel import HEADER, ROW_HEADER, accumulate_windows

MOTIONS = ("forward", "backward", "rest")
SIGNALS = ("u", "e")
SPEED_TIME = 0.02  # s: time constant behind the speed of the reference
MIN_POSITIVE = np.finfo(np.float64).tiny
MIN_MOTION_SAMPLES = 3  # samples of a motion from which a window speaks for it


class FeatureLayout(BaseModel):
    """How a recording is cut and binned; part of the baseline."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    sample_rate: float  # Hz
    window: int  # samples of the shortest window
    levels: int  # windows of 1, 2, 4 ... times the shortest
    span: int  # shortest windows after which all features are compared with healthy ones
    settling: int  # samples of a recording before its first window
    rest_speed: float  # speed of the reference up to which it rests [output per s]
    edges_s: tuple[float, ...]  # times since a motion began that separate its bins [s]
    bands_hz: tuple[float, ...]  # edges of the frequency bands [Hz]
    floors: tuple[float, float]  # powers of u and e below which a band is silent

    @property
    def bins(self) -> int:
        """Number of bins of a level: motions times times since they began."""
        return len(MOTIONS) * (len(self.edges_s) + 1)

    @property
    def bands(self) -> int:
        """Number of frequency bands."""
        return len(self.bands_hz) - 1

    @property
    def sums(self) -> int:
        """Size of what is added up over a window: counts, u, e, powers of both, squared speed."""
        return 3 * self.bins + len(MOTIONS) * (2 * self.bands + 1)

    @property
    def groups(self) -> tuple[slice, ...]:
        """Which features belong together: levels of u and of e, band powers of u and of e."""
        a, b = self.bins, len(MOTIONS) * self.bands
        ends = itertools.accumulate((a, a, b, b), initial=0)
        return tuple(slice(begin, end) for begin, end in itertools.pairwise(ends))

    @property
    def size(self) -> int:
        """Number of features d."""
        return 2 * (self.bins + len(MOTIONS) * self.bands)

    @property
    def span_s(self) -> float:
        """Duration of a span [s]."""
        return self.span * self.window / self.sample_rate


class Window(NamedTuple):
    """One window: the sample after its last, its level, its span, its features (NaN: not seen), and its motion."""

    end: int
    level: int
    span: int
    features: FloatArray  # shape (d,)
    motion: FloatArray  # shares of the three motions, logarithms of the rms speed forward and backward, shape (5,)


def _bands(layout: FeatureLayout) -> tuple[FloatArray, FloatArray]:
    """Return second-order band-passes bw s/(s^2 + bw s + w0^2) by the bilinear transform, prewarped at their edges.

    Each is passed twice: the motion is far louder than what is looked for, and lies a decade or two below.
    """
    edges = np.tan(np.pi * np.array(layout.bands_hz) / layout.sample_rate)
    bw, w2 = np.diff(edges), edges[:-1] * edges[1:]
    a0 = 1.0 + bw + w2
    return bw / a0, np.column_stack([2.0 * (w2 - 1.0), 1.0 - bw + w2]) / a0[:, None]


class WindowFeatures:
    """Cuts signals into windows; `run` changes its state in place and yields the windows that ended."""

    def __init__(self, layout: FeatureLayout) -> None:
        self.layout = layout
        b, a = _bands(layout)
        smoothing = 1.0 - np.exp(-1.0 / (SPEED_TIME * layout.sample_rate))
        edges = np.array(layout.edges_s, dtype=np.float64) * layout.sample_rate
        counts = [layout.window, layout.levels, layout.span, layout.settling, edges.size, b.size]
        numbers = [layout.rest_speed, layout.sample_rate, float(smoothing)]
        # as `accumulate_windows` takes them
        self.constants = np.concatenate([counts, numbers, edges, b, a[:, 0], a[:, 1]])
        bins, powers = 3 * layout.bins, 3 * layout.bins + 2 * len(MOTIONS) * layout.bands
        self._parts = slice(layout.bins), slice(layout.bins, bins), slice(bins, powers), slice(powers, None)
        self._floors = np.array(layout.floors)[:, None, None]
        self._fewest_heard = max(MIN_MOTION_SAMPLES, layout.sample_rate / layout.bands_hz[0] / 4.0)
        self.size = HEADER + 8 * layout.bands + layout.levels * (1 + layout.sums)

    def start(self) -> FloatArray:
        """Return the state before the first sample, shape (size,)."""
        return np.zeros(self.size)

    def run(
        self, state: FloatArray, r: FloatArray, u: FloatArray, y: FloatArray, restart: BoolArray
    ) -> Iterator[Window]:
        """Feed a block of samples, each of shape (N,); NaN in any of the three is a gap, which ends a window early."""
        lane = WindowLanes([self], np.zeros(1, dtype=np.int64))
        for _, window in lane.run(state[None], r[None], u[None], y[None], restart[None]):
            yield window

    def window(self, row: FloatArray) -> Window:
        """Return the window of a row that `accumulate_windows` has written."""
        end, level, span = (int(x) for x in row[:ROW_HEADER])
        return Window(end, level, span, *self._features(row[ROW_HEADER : ROW_HEADER + self.layout.sums]))

    def _features(self, sums: FloatArray) -> tuple[FloatArray, FloatArray]:
        motions = len(MOTIONS)
        counts, levels, powers, speeds = (sums[part] for part in self._parts)
        with np.errstate(divide="ignore", invalid="ignore"):
            means = np.where(counts >= MIN_MOTION_SAMPLES, levels.reshape(2, -1) / counts, np.nan)
            of_motion = counts.reshape(motions, -1).sum(axis=1)
            power = np.maximum(powers.reshape(2, motions, -1) / of_motion[:, None], self._floors)
            heard = of_motion >= self._fewest_heard
            logs = np.where(heard[:, None], 0.5 * np.log(power), np.nan)
            speed = 0.5 * np.log(np.maximum(speeds[:2] / of_motion[:2], MIN_POSITIVE))
        motion = np.concatenate(
            [of_motion / of_motion.sum(), np.where(of_motion[:2] >= MIN_MOTION_SAMPLES, speed, np.nan)]
        )
        return np.concatenate([means.ravel(), logs.ravel()]), motion


class WindowLanes:
    """Cuts the signals of several assets into windows, each by its own layout, to the same bits as alone."""

    def __init__(self, assets: Sequence[WindowFeatures | None], begins: IntArray) -> None:
        """`begins`: where in its row the state of each asset begins, shape (assets,); None: it has no windows."""
        self._assets, self._begins = tuple(assets), begins
        known = [asset for asset in assets if asset is not None]
        self._table = np.zeros((len(assets), max(features.constants.size for features in known)))
        for row, asset in zip(self._table, assets, strict=True):
            if asset is not None:
                row[: asset.constants.size] = asset.constants
        self._bands = sorted({features.layout.bands for features in known})
        self._shortest = min(features.layout.window for features in known)
        self._levels, self._sums = (
            max(getattr(features.layout, name) for features in known) for name in ("levels", "sums")
        )

    def run(
        self, rows: FloatArray, r: FloatArray, u: FloatArray, y: FloatArray, restart: BoolArray
    ) -> Iterator[tuple[int, Window]]:
        """Feed a block, each of shape (assets, N); change the rows; yield asset and window, asset by asset."""
        most = len(rows) * self._levels * (r.shape[1] // self._shortest + 1)
        out, lane = np.empty((most, ROW_HEADER + self._sums)), np.empty(most, dtype=np.int64)
        count = 0
        for bands in self._bands:
            count = accumulate_windows(self._table, rows, self._begins, r, u, y, restart, out, lane, count, bands=bands)
        for asset, row in zip(lane[:count].tolist(), out, strict=False):
            if (features := self._assets[asset]) is not None:
                yield asset, features.window(row)
