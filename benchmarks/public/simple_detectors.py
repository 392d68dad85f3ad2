"""Three simple detectors that a user might try instead of servoscope: windows of the same recordings, the same rules.

Each learns from healthy recordings and scores a recording; the larger, the less like them. Its limit is `MARGIN` times
the largest score that any of the healthy recordings has when it is left out of learning.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from scipy.signal import butter, sosfiltfilt

import servoscope as ss
from servoscope.core.arrays import FloatArray

MARGIN = 1.5
MOVING = 0.05  # share of the largest speed from which the axis moves
RIDGE = 0.1  # added to the diagonal of the features' correlation matrix
TANH_SPEED = 0.02  # share of the largest speed within which tanh friction changes its sign
BLOCK = 0.25  # of a window: the blocks whose residuals the CUSUM adds up
DRIFT = 0.5  # standard deviations that the CUSUM forgives per block


class Scores(NamedTuple):
    """What a detector says: its limit, and the largest score of each recording that was judged."""

    limit: float
    largest: tuple[float, ...]
    # what recordings are ranked by, where a detector has several scores; otherwise the largest
    order: tuple[float, ...] | None = None
    # 1.5 times the largest score of a healthy recording that is left out, where the limit is another
    common: float | None = None
    # the causes named with certainty, joined by plus signs, where a detector names any
    names: tuple[str, ...] = ()


class Detector(Protocol):
    """Learns from healthy recordings; scores one, window by window."""

    name: str

    def learn(self, healthy: Sequence[ss.Recording]) -> None:
        """Learn what healthy recordings look like."""

    def scores(self, recording: ss.Recording) -> FloatArray:
        """Return one score per window, shape (K,)."""


def windows(recording: ss.Recording, window_s: float) -> Iterator[slice]:
    """Yield windows that overlap by half; one of all samples where the recording is shorter."""
    size = int(min(window_s * recording.sample_rate, recording.samples))
    for begin in range(0, recording.samples - size + 1, max(size // 2, 1)):
        yield slice(begin, begin + size)


class RmsInput:
    """The rms of u per window, in standard deviations of the healthy windows."""

    name = "rms of u"

    def __init__(self, window_s: float) -> None:
        self.window_s = window_s

    def _rms(self, recording: ss.Recording) -> FloatArray:
        return np.array([np.sqrt(np.mean(recording.u[at] ** 2)) for at in windows(recording, self.window_s)])

    def learn(self, healthy: Sequence[ss.Recording]) -> None:
        """Take mean and standard deviation of the healthy windows."""
        rms = np.concatenate([self._rms(one) for one in healthy])
        self.mean, self.std = rms.mean(), rms.std() + 1e-12

    def scores(self, recording: ss.Recording) -> FloatArray:
        """Return the distance of each window from the healthy mean."""
        return np.asarray(np.abs(self._rms(recording) - self.mean) / self.std)


class FeatureT2:
    """Hotelling's T^2 of nine features per window, with a regularised correlation matrix."""

    name = "T^2 of features"

    def __init__(self, window_s: float) -> None:
        self.window_s = window_s

    def _features(self, recording: ss.Recording) -> FloatArray:
        rows = []
        for at in windows(recording, self.window_s):
            u, error = recording.u[at], recording.r[at] - recording.y[at]
            speed = np.gradient(recording.y[at]) * recording.sample_rate
            moves = np.abs(speed) > MOVING * np.abs(speed).max()
            forward, backward = u[moves & (speed > 0.0)], u[moves & (speed < 0.0)]
            means = [part.mean() if part.size else 0.0 for part in (forward, backward)]
            of_u, of_error = [(x.mean(), x.std(), np.abs(x).max()) for x in (u, error)]
            rows.append([*of_u, *of_error, speed.std(), *means])
        return np.array(rows)

    def learn(self, healthy: Sequence[ss.Recording]) -> None:
        """Take mean, scale and correlation of the healthy windows' features."""
        features = np.concatenate([self._features(one) for one in healthy])
        self.mean = features.mean(axis=0)
        self.std = features.std(axis=0) + 1e-9 * (1.0 + np.abs(self.mean))
        scaled = (features - self.mean) / self.std
        self.precision = np.linalg.inv(np.cov(scaled.T) + RIDGE * np.eye(scaled.shape[1]))

    def scores(self, recording: ss.Recording) -> FloatArray:
        """Return T^2 of each window."""
        scaled = (self._features(recording) - self.mean) / self.std
        return np.asarray(np.einsum("ij,jk,ik->i", scaled, self.precision, scaled))


class InverseCusum:
    """Least-squares inverse with tanh friction by direction, and a CUSUM over its block residuals."""

    name = "inverse + CUSUM"

    def __init__(self, window_s: float, cutoff_hz: float) -> None:
        self.window_s, self.cutoff_hz = window_s, cutoff_hz

    def _regressors(self, recording: ss.Recording) -> tuple[FloatArray, FloatArray]:
        rate = recording.sample_rate
        sections = butter(2, min(2.0 * self.cutoff_hz / rate, 0.9), output="sos")
        pad = min(recording.samples - 1, int(3.0 * rate / self.cutoff_hz))
        y, u = (sosfiltfilt(sections, signal, padlen=pad) for signal in (recording.y, recording.u))
        speed = np.gradient(y) * rate
        sign = np.tanh(speed / self.speed)
        return np.column_stack([np.gradient(speed) * rate, speed, sign, np.ones_like(speed), np.abs(sign)]), u

    def _blocks(self, recording: ss.Recording) -> FloatArray:
        """Return mean, mean by direction and log rms of the residual of each block, shape (blocks, 3)."""
        regressors, u = self._regressors(recording)
        residual = u - regressors @ self.theta
        size = max(int(BLOCK * self.window_s * recording.sample_rate), 2)
        count = len(residual) // size
        each = residual[: count * size].reshape(count, size)
        sign = regressors[: count * size, 2].reshape(count, size)
        rms = np.sqrt((each**2).mean(axis=1))
        return np.column_stack([each.mean(axis=1), (each * sign).mean(axis=1), np.log(rms + 1e-12)])

    def learn(self, healthy: Sequence[ss.Recording]) -> None:
        """Fit the inverse to all healthy recordings; take mean and scale of their block residuals."""
        fastest = [np.abs(np.gradient(one.y) * one.sample_rate).max() for one in healthy]
        self.speed = TANH_SPEED * float(np.median(fastest))
        regressors, inputs = zip(*(self._regressors(one) for one in healthy), strict=True)
        self.theta = np.linalg.lstsq(np.concatenate(regressors), np.concatenate(inputs), rcond=None)[0]
        blocks = np.concatenate([self._blocks(one) for one in healthy])
        self.mean, self.std = blocks.mean(axis=0), blocks.std(axis=0) + 1e-12

    def scores(self, recording: ss.Recording) -> FloatArray:
        """Return the largest of the CUSUMs, both ways, after each block."""
        scaled = (self._blocks(recording) - self.mean) / self.std
        up, down, out = np.zeros(3), np.zeros(3), np.zeros(len(scaled))
        for k, block in enumerate(scaled):
            up, down = np.maximum(0.0, up + block - DRIFT), np.maximum(0.0, down - block - DRIFT)
            out[k] = max(up.max(), down.max())
        return out


def detectors(window_s: float, cutoff_hz: float) -> tuple[Detector, ...]:
    """Return the three, for windows of `window_s` seconds and an inverse up to `cutoff_hz`."""
    return RmsInput(window_s), FeatureT2(window_s), InverseCusum(window_s, cutoff_hz)


def judge(detector: Detector, healthy: Sequence[ss.Recording], judged: Sequence[ss.Recording]) -> Scores:
    """Learn from healthy recordings and judge others; a single healthy recording is cut into halves for the limit."""
    parts = list(healthy) if len(healthy) > 1 else halves(healthy[0])
    left_out = []
    for i, part in enumerate(parts):
        detector.learn([one for j, one in enumerate(parts) if j != i])
        left_out.append(float(detector.scores(part).max()))
    detector.learn(healthy)
    return Scores(MARGIN * max(left_out), tuple(float(detector.scores(one).max()) for one in judged))


def halves(recording: ss.Recording) -> list[ss.Recording]:
    """Cut a recording in the middle."""
    begin, end = float(recording.t[0]), float(recording.t[-1])
    middle = begin + recording.duration_s / 2.0
    return [recording.part(begin, middle), recording.part(middle, end + 1.0)]
