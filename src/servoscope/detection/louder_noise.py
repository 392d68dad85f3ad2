"""Since when a signal is noisier than before: the variance of what changes from sample to sample, and its onset."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.messages import Message, message
from servoscope.estimation.pipeline import Estimates, Pipeline
from servoscope.signals import Recording

MIN_MEMORIES = 3.0  # memories of the estimator before and after: either side is judged by itself
ORDER = 4  # of the differences, which leave nothing of a motion that is slow against the sampling
WHITE_RATIO = 252.0 / 70.0  # of white noise: variance of the differences of order 5 over that of order 4
MIN_WHITE_SHARE = 0.8  # of that ratio, which a motion or a vibration does not have
MIN_GROWTH = 2.0  # of the variance: less moves no estimate by as much as it scatters
MIN_LOG_LIKELIHOOD_GAIN = 100.0  # of two variances against one; differences of white noise hang together for four
MIN_NOISE_GROWTH = 1.5  # of the variance of the residual; below it counts as none
MIN_OWN_GROWTH = 1.5  # of that of the whole signal: one that is scaled is another unit or gain
MAX_SAMPLES = 2_000_000  # of a recording, which is looked at as a whole
MAX_STDS = 4.0  # by which a step of u or an outlier counts


class LouderNoise(NamedTuple):
    """White noise of one signal that grew within a recording."""

    signal: str  # ``u`` or ``y``
    onset: int  # sample
    growth: float  # of the standard deviation

    @property
    def last_quiet(self) -> int:
        """Sample up to which no difference holds any of the noise, were the onset late by as much as they span."""
        return self.onset - 2 * ORDER

    def describe(self, t: FloatArray) -> Message:
        """Return it as a sentence; t (N,): time of the samples."""
        return message("warning.noise_since", signal=self.signal, factor=self.growth, t=float(t[self.onset]))


def find_louder_noise(recording: Recording, memory_s: float) -> LouderNoise | None:
    """Return the signal whose white noise grew most, long enough before the end; None where none grew."""
    shortest = max(round(MIN_MEMORIES * memory_s * recording.sample_rate), ORDER)
    if not 2 * shortest + ORDER < recording.samples <= MAX_SAMPLES:
        return None
    noises = [_growth(name, getattr(recording, name), recording, shortest) for name in ("u", "y")]
    return max(filter(None, noises), key=lambda noise: noise.growth, default=None)


def _growth(name: str, x: FloatArray, recording: Recording, shortest: int) -> LouderNoise | None:
    d = np.diff(x, ORDER)
    N = len(d)
    whole = np.convolve(recording.restart[1:], np.ones(ORDER), "valid") == 0.0  # differences within one run
    squares = whole * np.minimum(d**2, MAX_STDS**2 * np.quantile(d**2, 0.7))
    k = np.arange(shortest, N - shortest)
    sums = np.cumsum(squares)
    before, after = sums[k - 1] / k, (sums[-1] - sums[k - 1]) / (N - k)
    grown = (before > 0.0) & (after > MIN_GROWTH * before)
    if not grown.any():
        return None
    with np.errstate(divide="ignore"):
        cost = np.where(grown, k * np.log(before) + (N - k) * np.log(after), np.inf)
    at = int(np.argmin(cost))
    if at in (0, len(k) - 1):
        return None  # it began before, or after, where either side can be judged
    onset = int(k[at])
    steps, spread = np.diff(x, ORDER + 1), float(x[:onset].std())
    added = [float(np.mean(part[onset:] ** 2) - np.mean(part[:onset] ** 2)) for part in (d, steps)]
    if (
        N * np.log(sums[-1] / N) - cost[at] < MIN_LOG_LIKELIHOOD_GAIN
        or after[at] * spread**2 < MIN_OWN_GROWTH**2 * before[at] * float(x[onset:].std()) ** 2
        or added[1] < MIN_WHITE_SHARE * WHITE_RATIO * added[0]
    ):
        return None
    return LouderNoise(name, onset + ORDER // 2, float(np.sqrt(after[at] / before[at])))


def grows_innovations(pipeline: Pipeline, recording: Recording, noise: LouderNoise) -> bool:
    """Return whether the regression leaves more of u, too, each side with coefficients of its own.

    A fault that makes a signal louder, or what a loop does of it, leaves as much as before.
    """
    g = pipeline.regression(recording.r, recording.u, recording.y, recording.restart)
    rows, variances = np.flatnonzero(g.ok), list[float]()
    for side in (rows[rows < noise.last_quiet], rows[rows >= noise.onset]):
        if len(side) <= g.phi.shape[1]:
            return True
        theta = np.linalg.lstsq(g.phi[side], g.eta[side], rcond=None)[0]
        variances.append(float(np.mean((g.eta[side] - g.phi[side] @ theta) ** 2)))
    return variances[1] > MIN_NOISE_GROWTH * variances[0]


def noise_growth(pipeline: Pipeline, estimates: Estimates) -> float:
    """Return the growth of the noise's variance against the baseline's, 1 where it has not grown.

    Noise shifts the expected estimate (errors in variables), so a failing sensor would look like a faulty plant. A low
    quantile over time tells it from a fault, whose residual is large only until the estimate has followed.
    """
    settled = estimates.power[estimates.updates > 3.0 * pipeline.memory]
    growth = float(np.quantile(settled, 0.1)) if len(settled) else 1.0
    return growth if growth > MIN_NOISE_GROWTH else 1.0
