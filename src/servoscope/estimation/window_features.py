"""What a loop shows besides its coefficients: levels and band powers of u and of the tracking error, window by window.

Each sample belongs to a motion by the reference (forward, backward, rest) and, where the motion repeats, to a time
since that motion began. Over a window, u and e = r - y are averaged in each of these bins, and the powers of their
frequency bands in each motion. Longer windows are sums of the shortest. One pass, a state of plain numbers: a recording
or stream may be cut anywhere.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict

from servoscope.core.arrays import BoolArray, FloatArray

MOTIONS = ("forward", "backward", "rest")
SIGNALS = ("u", "e")
MAX_PHYSICAL = 1e100  # as in the recursion: no physical signal, and it would stay in the filters for ever
SPEED_TIME = 0.02  # s: time constant behind the speed of the reference
FEWEST = 3  # samples of a motion from which a window speaks for it
HEADER = 8  # numbers of the state before those of the filters; see `_accumulate`
ROW_HEADER = 3  # numbers of a row before the sums: sample, level, span


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


class _Constants(NamedTuple):
    window: int
    levels: int
    span: int
    settling: int
    rest: float
    rate: float
    smoothing: float
    edges: FloatArray  # in samples
    b: FloatArray  # of the band-pass filters, shape (bands,)
    a: FloatArray  # shape (bands, 2)


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
        self._constants = _Constants(
            window=layout.window,
            levels=layout.levels,
            span=layout.span,
            settling=layout.settling,
            rest=layout.rest_speed,
            rate=layout.sample_rate,
            smoothing=float(smoothing),
            edges=np.array(layout.edges_s, dtype=np.float64) * layout.sample_rate,
            b=np.ascontiguousarray(b),
            a=np.ascontiguousarray(a),
        )
        self.size = HEADER + 8 * layout.bands + layout.levels * (1 + layout.sums)
        self._run = _compile()

    def start(self) -> FloatArray:
        """Return the state before the first sample, shape (size,)."""
        return np.zeros(self.size)

    def run(
        self, state: FloatArray, r: FloatArray, u: FloatArray, y: FloatArray, restart: BoolArray
    ) -> Iterator[Window]:
        """Feed a block of samples, each of shape (N,); NaN in any of the three is a gap, which ends a window early."""
        out = np.empty((self._constants.levels * (len(r) // self._constants.window + 1), ROW_HEADER + self.layout.sums))
        for row in out[: self._run(self._constants, state, r, u, y, restart, out)]:
            end, level, span = (int(x) for x in row[:ROW_HEADER])
            yield Window(end, level, span, *self._features(row[ROW_HEADER:]))

    def _features(self, sums: FloatArray) -> tuple[FloatArray, FloatArray]:
        layout, motions = self.layout, len(MOTIONS)
        counts, levels, powers, speeds = np.split(
            sums, np.cumsum([layout.bins, 2 * layout.bins, 2 * motions * layout.bands])
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            means = np.where(counts >= FEWEST, levels.reshape(2, -1) / counts, np.nan)
            of_motion = counts.reshape(motions, -1).sum(axis=1)
            power = powers.reshape(2, motions, layout.bands) / of_motion[:, None]
            power = np.maximum(power, np.array(layout.floors)[:, None, None])
            heard = of_motion >= max(FEWEST, layout.sample_rate / layout.bands_hz[0] / 4.0)
            logs = np.where(heard[:, None], 0.5 * np.log(power), np.nan)
            speed = 0.5 * np.log(np.maximum(speeds[:2] / of_motion[:2], np.finfo(float).tiny))
        motion = np.concatenate([of_motion / of_motion.sum(), np.where(of_motion[:2] >= FEWEST, speed, np.nan)])
        return np.concatenate([means.ravel(), logs.ravel()]), motion


def _accumulate(
    c: _Constants, s: FloatArray, r: FloatArray, u: FloatArray, y: FloatArray, restart: BoolArray, out: FloatArray
) -> int:
    # state: armed, sample, samples of the window, windows of the span, span, reference before, speed, time since the
    # motion began (positive) with its sign in the motion; then filters and first values, then sums level by level
    bands, edges = len(c.b), len(c.edges)
    bins = 3 * (edges + 1)
    sums = 3 * bins + 3 * (2 * bands + 1)
    filters = s[HEADER : HEADER + 8 * bands]
    rows = 0
    for k in range(len(r)):
        s[1] += 1.0
        if not (abs(r[k]) < MAX_PHYSICAL and abs(u[k]) < MAX_PHYSICAL and abs(y[k]) < MAX_PHYSICAL):
            s[0] = 0.0
            continue
        if restart[k] or s[0] == 0.0:
            s[0], s[2], s[5], s[6], s[7] = 1.0, 0.0, r[k], 0.0, 0.0
            # a band-pass has forgotten a constant: it starts where a signal has always been what it is now
            for band in range(bands):
                for j in range(2):
                    value = u[k] if j == 0 else r[k] - y[k]
                    at = 4 * (2 * band + j)
                    filters[at] = -c.b[band] * value
                    filters[at + 1] = -c.b[band] * value
                    filters[at + 2] = 0.0
                    filters[at + 3] = 0.0
            s[HEADER + 8 * bands :] = 0.0
        s[6] += c.smoothing * ((r[k] - s[5]) * c.rate - s[6])
        s[5] = r[k]
        motion = 2
        if s[6] > c.rest:
            motion = 0
        elif s[6] < -c.rest:
            motion = 1
        # time since the motion began, and the motion itself, in one number: 4 (samples) + motion
        if int(s[7]) % 4 == motion:
            s[7] += 4.0
        else:
            s[7] = float(motion)
        since = s[7] // 4.0
        place = motion * (edges + 1)
        for edge in range(edges):
            if since >= c.edges[edge]:
                place += 1
        settled = s[1] > c.settling
        begin = HEADER + 8 * bands
        for j in range(2):
            value = u[k] if j == 0 else r[k] - y[k]
            if settled:
                s[begin + 1 + (1 + j) * bins + place] += value
            for band in range(bands):
                at = 4 * (2 * band + j)
                passed = value
                for _ in range(2):
                    before, passed = passed, c.b[band] * passed + filters[at]
                    filters[at] = filters[at + 1] - c.a[band, 0] * passed
                    filters[at + 1] = -c.b[band] * before - c.a[band, 1] * passed
                    at += 2
                if settled:
                    s[begin + 1 + 3 * bins + (3 * j + motion) * bands + band] += passed * passed
        if not settled:
            continue
        s[begin + 1 + place] += 1.0
        s[begin + 1 + 3 * bins + 6 * bands + motion] += s[6] * s[6]
        s[2] += 1.0
        if s[2] < c.window:
            continue
        s[2] = 0.0
        s[3] += 1.0
        for level in range(c.levels):
            at = begin + level * (1 + sums)
            if level:
                for i in range(sums):
                    s[at + 1 + i] += s[begin + 1 + i]
            s[at] += 1.0
            if s[at] >= 2**level:
                out[rows, 0], out[rows, 1], out[rows, 2] = s[1], level, s[4]
                for i in range(sums):
                    out[rows, ROW_HEADER + i] = s[at + 1 + i]
                rows += 1
                if level:
                    for i in range(sums + 1):
                        s[at + i] = 0.0
        for i in range(sums + 1):
            s[begin + i] = 0.0
        if s[3] >= c.span:
            s[3] = 0.0
            s[4] += 1.0
            s[begin:] = 0.0
    return rows


@functools.cache
def _compile() -> Callable[..., int]:
    from servoscope.core.jit import kernel  # late: it imports Numba

    return kernel(_accumulate)
