"""Textbook indices of one loop's log as plain functions, each with its equation, source and known failure.

All take equidistant samples without gaps, shape (N,), and a period in samples.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from scipy import signal

from servoscope.core.arrays import FloatArray

MIN_CYCLES = 2.5  # of an oscillation in a record
MIN_CROSSINGS, MAX_INTERVALS = 4, 10  # zero crossings of the autocorrelation, and what lies between them
MIN_REGULARITY = 1.0
POINTS = 32  # of a half cycle after resampling


class Oscillation(NamedTuple):
    """The strongest oscillation of a signal."""

    period: float  # [samples]
    regularity: float  # r, above 1
    share: float  # of the signal's variance in the band of the oscillation


def find_oscillation(x: FloatArray) -> Oscillation | None:
    """Return the strongest oscillation where it is regular.

    r = mean(T_i) / (3 std(T_i)), T_i: intervals between zero crossings of the autocorrelation of the signal within an
    octave around the peak of its spectrum (Thornhill, Huang and Zhang, J. Process Control 13, 2003, 91-100). Known
    failure: two oscillations of like strength make each other irregular.
    """
    f, power = signal.periodogram(signal.detrend(x), window="hann")
    smooth = np.convolve(np.where(f < MIN_CYCLES / x.size, 0.0, power), [0.25, 0.5, 0.25], "same")
    peak = float(f[np.argmax(smooth)])
    if not np.ptp(x) > 1e-9 * np.abs(x).max() or not peak > 0.0:
        return None
    band, faster = band_pass(x, 0.5 * peak, 2.0 * peak), band_pass(x, peak / 3.0, 1.0)  # without what is slower
    rho = signal.correlate(band, band)[x.size - 1 :][: x.size // 2]
    before = np.flatnonzero(np.sign(rho[:-1]) * np.sign(rho[1:]) < 0.0)[: MAX_INTERVALS + 1]
    intervals = np.diff(before + rho[before] / (rho[before] - rho[before + 1]))
    if before.size < MIN_CROSSINGS:
        return None
    mean = float(intervals.mean())
    regularity = mean / (3.0 * max(float(intervals.std()), 0.01 * mean))
    oscillation = Oscillation(2.0 * mean, regularity, min(float(band.var() / max(faster.var(), 1e-300)), 1.0))
    return oscillation if regularity > MIN_REGULARITY else None


def band_pass(x: FloatArray, low: float, high: float) -> FloatArray:
    """Return what a signal holds between two frequencies [1 / samples], its line through the ends of the log apart."""
    f, spectrum = np.fft.rfftfreq(x.size), np.fft.rfft(signal.detrend(x))
    return np.asarray(np.fft.irfft(np.where((f > low) & (f < high), spectrum, 0.0), x.size))


def half_cycles(x: FloatArray, period: float) -> FloatArray:
    """Return the half cycles of a signal that oscillates about zero, each upwards and on 32 points, shape (M, 32)."""
    crossings = np.flatnonzero(x[:-1] * x[1:] <= 0.0) + 1
    cycles = [
        np.interp(np.linspace(0.0, stop - start, POINTS + 2)[1:-1], np.arange(stop - start + 1), x[start - 1 : stop])
        * np.sign(x[(start + stop) // 2])
        for start, stop in itertools.pairwise(crossings)
        if 0.25 * period < stop - start < period and stop - start >= 3
    ]
    return np.array(cycles).reshape(-1, POINTS)


def shape_index(x: FloatArray, period: float) -> float:
    """Return how triangular the half cycles are: E_sine / (E_sine + E_triangle); 0.5: undecided.

    The mean squared errors of a sine and of a triangle with free peak, fitted to each half cycle (He, Wang, Pottmann
    and Qin, Ind. Eng. Chem. Res. 46, 2007, 4549-4560): triangles in u of a self-regulating loop, or in y of an
    integrating one, are a sign of stiction. Known failure: noise in the place of an oscillation, and set-point changes.
    """
    cycles = half_cycles(x, period)
    if len(cycles) < 3:
        return 0.5
    at, peaks = np.arange(1, POINTS + 1) / (POINTS + 1.0), np.linspace(0.15, 0.85, 15)[:, None]
    cycles /= np.linalg.norm(cycles, axis=1, keepdims=True)
    left = []
    for shapes in (np.sin(np.pi * at)[None], np.where(at < peaks, at / peaks, (1.0 - at) / (1.0 - peaks))):
        fitted = cycles @ (shapes / np.linalg.norm(shapes, axis=1, keepdims=True)).T
        left.append(float(np.median(1.0 - np.square(fitted.max(axis=1).clip(0.0)))))
    return left[0] / max(sum(left), 1e-12)


def cross_correlation_index(u: FloatArray, y: FloatArray) -> float:
    """Return how odd the cross-correlation of u and y is: 1 odd (stiction), 0 even (an outside oscillation).

    |tau_l - tau_r| / (tau_l + tau_r) of the zero crossings on both sides of lag zero is 0 for an even and 1 for an odd
    function (Horch, Control Engineering Practice 7, 1999, 1221-1231). Known failure: integrating processes, and PI
    control with strong integral action.
    """
    c = signal.correlate(u, y)
    lags = np.flatnonzero(c[:-1] * c[1:] <= 0.0) - u.size + 1
    after, before = lags[lags >= 0], lags[lags < 0]
    if not after.size or not before.size:
        return 0.0
    return float(abs(after[0] + 1 + before[-1]) / (after[0] + 1 - before[-1]))


def ellipse_width(u: FloatArray, y: FloatArray, period: float) -> float:
    """Return the apparent stiction in units of u: the width of the ellipse of y over u along u, 2 A_u |sin(phi)|.

    A_u and phi are amplitude and phase of u relative to y at the oscillation's frequency (Choudhury, Shah, Thornhill
    and Shook, Control Engineering Practice 14, 2006, 1395-1412). Known failure: dead time and lag widen the ellipse,
    so it is meaningful only once stiction has been found.
    """
    window = np.hanning(u.size)
    wave = 2.0 / window.sum() * window * np.exp(-2j * np.pi * np.arange(u.size) / period)
    return float(2.0 * abs(wave @ u) * abs(np.sin(np.angle((wave @ u) * np.conj(wave @ y)))))
