"""How long a detector runs until it speaks: measured, exact for the CUSUM, and the shortest that anybody can reach."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.scoring.dummies import Detector
from servoscope.scoring.intervals import Measured

OVERSHOOT = 1.166
"""By how much a Gaussian walk overshoots two limits, -2 zeta(1/2)/sqrt(2 pi) (Siegmund, 1985, section X.2)."""


@dataclass(frozen=True, eq=False)
class RunLengths:
    """Samples up to and including the first alarm of each run.

    Parameters
    ----------
    samples
        Shape (runs,).
    ended
        Whether the run ended in an alarm, shape (runs,); otherwise it was longer than could be seen.
    """

    samples: FloatArray
    ended: BoolArray

    @property
    def average(self) -> Measured:
        """Average run length with a normal 95 % interval: all samples over all alarms.

        Runs that ended early without alarm count with what was seen of them, which is right for run lengths without
        memory (Epstein and Sobel, 1953), as false alarms are. Without any alarm it is infinite.
        """
        alarms = int(self.ended.sum())
        if not alarms:
            return Measured(np.inf, np.nan, np.inf)
        value = float(self.samples.sum()) / alarms
        error = 1.959964 * float(np.sqrt(((self.samples - value * self.ended) ** 2).sum())) / alarms
        return Measured(value, value - error, value + error)


def run_lengths(detector: Detector, draw: Callable[[int], FloatArray], seeds: Iterable[int]) -> RunLengths:
    """Run a detector over many sequences until its first alarm in each.

    Parameters
    ----------
    detector
        Residuals (N,) to alarms (N,).
    draw
        Makes the residuals (N,) of a seed: healthy ones for ARL0, changed from the first sample on for ARL1.
    seeds
        One per sequence.
    """
    samples, ended = [], []
    for seed in seeds:
        alarm = detector(draw(seed))
        ended.append(bool(alarm.any()))
        samples.append(float(np.argmax(alarm) + 1 if ended[-1] else alarm.size))
    return RunLengths(np.array(samples), np.array(ended, dtype=np.bool_))


def siegmund(shift: float, k: float = 0.5, h: float = 5.0) -> float:
    """Approximate the average run length of the one-sided CUSUM by a diffusion with a corrected limit.

    ``ARL = (exp(-2 D b) + 2 D b - 1)/(2 D^2)``, D = shift - k, b = h + 1.166, and b^2 for D = 0 (Siegmund, 1985).

    Parameters
    ----------
    shift
        Of the mean, in standard deviations, positive in the direction that is watched.
    k, h
        Reference value and decision interval.
    """
    D, b = shift - k, h + OVERSHOOT
    if abs(D * b) < 1e-4:  # the series, where the formula would lose its digits
        return b * b * (1.0 - 2.0 * D * b / 3.0)
    return float((np.expm1(-2.0 * D * b) + 2.0 * D * b) / (2.0 * D * D))


def brook_evans(shift: float, k: float = 0.5, h: float = 5.0, states: int = 401) -> float:
    """Return the average run length of the one-sided CUSUM, started at 0, from a Markov chain.

    The sum is cut into cells of width w = 2 h/(2 states - 1), the lowest one reaching from -inf to w/2:
    ``P_ij = Phi((j - i) w + w/2 + k - shift) - Phi((j - i) w - w/2 + k - shift)``, ``ARL = (I - P)^-1 1``
    (Brook and Evans, 1972). The error falls with the square of `states`; 401 leave 3e-5 of the result at shift 0.

    Parameters
    ----------
    shift, k, h
        As for `siegmund`.
    states
        Number of cells.
    """
    from scipy.special import ndtr

    w = 2.0 * h / (2 * states - 1)
    i = np.arange(states)
    upper = ndtr((i[None, :] - i[:, None] + 0.5) * w + k - shift)  # probability of at most cell j
    P = np.diff(upper, axis=1, prepend=0.0)
    return float(np.linalg.solve(np.eye(states) - P, np.ones(states))[0])


def two_sided(one_sided: Callable[[float], float], shift: float) -> float:
    """Return the average run length of two one-sided CUSUMs of which the first to speak counts.

    ``1/ARL = 1/ARL+ + 1/ARL-`` (Kemp, 1961).

    Parameters
    ----------
    one_sided
        Shift to average run length, for example `brook_evans`.
    shift
        Of the mean, in standard deviations.
    """
    return 1.0 / (1.0 / one_sided(shift) + 1.0 / one_sided(-shift))


def lorden_bound(arl0: float, information: float) -> float:
    """Return the shortest worst-case mean delay [samples] of any detector with a given false-alarm interval.

    ``log(ARL0)/I`` (Lorden, 1971), to first order for long intervals; the CUSUM of the true likelihood ratio reaches
    it. Where I is small, even the best detector is faster than this by up to (1 - log I)/I samples: the exact optimum
    is `needed_information` divided by I.

    Parameters
    ----------
    arl0
        Mean number of samples between false alarms.
    information
        I, Kullback-Leibler divergence of the changed from the healthy samples [nat per sample].
    """
    return float(np.log(arl0) / information)


def needed_information(arl0: float, information: float) -> float:
    """Return the mean information [nat] that the fastest detector needs; divided by I it is the delay.

    Lorden's criterion has an exact optimum for a drift that begins in a Brownian motion (Shiryaev, 1996; Moustakides,
    2004), the CUSUM with limit b::

        ARL0 = (exp(b) - b - 1)/I,   needed = exp(-b) + b - 1

    Samples of that motion cannot be detected faster, but for the sample that the change falls into.

    Parameters
    ----------
    arl0, information
        As for `lorden_bound`.
    """
    from scipy.optimize import brentq

    b = brentq(lambda b: b - np.log(arl0 * information + b + 1.0), 0.0, 2.0 + 2.0 * np.log1p(arl0 * information))
    return float(np.expm1(-b) + b)


def shortest_delay(needed: float, information: npt.ArrayLike) -> float:
    """Return the samples after a change by which enough information has come in, where it comes in unevenly.

    The first n with ``I(1) + ... + I(n) >= needed``; with log(ARL0) for `needed` it is Lorden's bound over time (Lai,
    1998, for observations that are neither independent nor alike). It is inf where the array ends before.

    Parameters
    ----------
    needed
        log(ARL0), or `needed_information` [nat].
    information
        Of each sample from the change on [nat], shape (N,).
    """
    gathered = np.cumsum(np.asarray(information, dtype=np.float64))
    n = int(np.searchsorted(gathered, needed))
    return float(n + 1) if n < gathered.size else np.inf
