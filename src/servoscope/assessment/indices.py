"""Textbook indices of one loop's log as plain functions, each with its equation, source and known failure.

All take equidistant samples without gaps, shape (N,), and a period in samples.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import signal

from servoscope.core.arrays import FloatArray

MIN_CYCLES = 2.5  # of an oscillation in a record
MIN_CROSSINGS = 4  # of the autocorrelation, for a regularity
MAX_INTERVALS = 10  # between zero crossings of the autocorrelation, as in the paper
POINTS = 32  # of a half cycle after resampling


class Oscillation(NamedTuple):
    """The strongest oscillation of a signal."""

    period: float  # [samples]
    regularity: float  # r; above 1 the oscillation is regular
    share: float  # of the signal's variance in the band of the oscillation
    band: FloatArray  # the signal in that band, shape (N,)


def find_oscillation(x: FloatArray) -> Oscillation | None:
    """Return the strongest oscillation, or None where nothing moves.

    r = mean(T_i) / (3 std(T_i)), T_i: intervals between zero crossings of the autocorrelation of the signal within an
    octave around the peak of its spectrum (Thornhill, Huang and Zhang, J. Process Control 13, 2003, 91-100). Known
    failure: two oscillations of like strength make each other irregular.
    """
    if not np.ptp(x) > 1e-9 * np.abs(x).max():
        return None
    x = signal.detrend(np.asarray(x, dtype=np.float64))
    n = x.size
    spectrum = np.fft.rfft(x * np.hanning(n))
    frequency = np.fft.rfftfreq(n)
    power = np.abs(spectrum) ** 2
    power[frequency < MIN_CYCLES / n] = 0.0
    smooth = np.convolve(power, [0.25, 0.5, 0.25], "same")
    if not smooth.max() > 0.0:
        return None
    peak = frequency[int(np.argmax(smooth))]
    whole = np.fft.rfft(x)
    band = _octave(whole, frequency / peak, n)
    padded = np.fft.rfft(band, 2 * n)
    rho = np.fft.irfft(np.abs(padded) ** 2)[: n // 2]
    crossings = np.flatnonzero(rho[:-1] * rho[1:] < 0.0)[: MAX_INTERVALS + 1]
    faster = x - np.fft.irfft(np.where(frequency < peak / 3.0, whole, 0.0), n)  # without what is slower
    share = min(float(band.var() / max(faster.var(), 1e-300)), 1.0)
    if crossings.size < MIN_CROSSINGS:
        return Oscillation(1.0 / float(peak), 0.0, share, band)
    at = crossings + rho[crossings] / (rho[crossings] - rho[crossings + 1])
    intervals = np.diff(at)
    regularity = float(intervals.mean() / (3.0 * max(float(intervals.std()), 0.01 * float(intervals.mean()))))
    return Oscillation(2.0 * float(intervals.mean()), regularity, share, band)


def _octave(spectrum: npt.NDArray[np.complex128], relative: npt.NDArray[np.floating[Any]], samples: int) -> FloatArray:
    """Return what a spectrum holds within an octave around its relative frequency 1, as a signal."""
    return np.asarray(np.fft.irfft(np.where((relative > 0.5) & (relative < 2.0), spectrum, 0.0), samples))


def smooth_to(x: FloatArray, period: float, harmonics: float = 7.0) -> FloatArray:
    """Return a signal without what is slower than a third of the oscillation, or faster than its 7th harmonic."""
    spectrum = np.fft.rfft(signal.detrend(x))
    frequency = np.fft.rfftfreq(x.size) * period
    spectrum[(frequency < 1.0 / 3.0) | (frequency > harmonics)] = 0.0
    return np.asarray(np.fft.irfft(spectrum, x.size))


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


def _left_over(cycles: FloatArray, shapes: FloatArray) -> FloatArray:
    """Return what the best of some shapes leaves of each half cycle's square sum, shape (M,)."""
    unit = shapes / np.linalg.norm(shapes, axis=1, keepdims=True)
    return np.asarray(np.square(cycles).sum(axis=1) - np.square((cycles @ unit.T).max(axis=1).clip(0.0)))


def shape_index(x: FloatArray, period: float) -> tuple[float, float]:
    """Return how triangular, and how rectangular, the half cycles are: E_sine / (E_sine + E_shape); 0.5: undecided.

    The mean squared errors of a sine and of a triangle with free peak, fitted to each half cycle (He, Wang, Pottmann
    and Qin, Ind. Eng. Chem. Res. 46, 2007, 4549-4560): triangles in u of a self-regulating loop, or in y of an
    integrating one, are a sign of stiction. The trapezoid for y is the same idea. Known failure: noise in the place of
    an oscillation, and set-point changes.
    """
    cycles = half_cycles(smooth_to(x, period), period)
    if len(cycles) < 3:
        return 0.5, 0.5
    at = np.arange(1, POINTS + 1) / (POINTS + 1.0)
    sine = np.sin(np.pi * at)[None, :]
    peaks = np.linspace(0.15, 0.85, 15)[:, None]
    triangles = np.where(at < peaks, at / peaks, (1.0 - at) / (1.0 - peaks))
    edges = np.array([0.02, 0.08, 0.15, 0.25])[:, None]
    trapezoids = np.clip(np.minimum(at / edges, (1.0 - at) / edges), 0.0, 1.0)
    scale = np.square(cycles).sum(axis=1).clip(1e-300)
    of_sine, of_triangle, of_trapezoid = (
        float(np.median(_left_over(cycles, shapes) / scale)) for shapes in (sine, triangles, trapezoids)
    )
    return of_sine / (of_sine + of_triangle + 1e-12), of_sine / (of_sine + of_trapezoid + 1e-12)


def cross_correlation_index(u: FloatArray, y: FloatArray) -> float:
    """Return how odd the cross-correlation of u and y is: 1 odd (stiction), 0 even (an outside oscillation).

    |tau_l - tau_r| / (tau_l + tau_r) of the zero crossings on both sides of lag zero is 0 for an even and 1 for an odd
    function (Horch, Control Engineering Practice 7, 1999, 1221-1231). Known failure: integrating processes, and PI
    control with strong integral action.
    """
    n = u.size
    c = np.fft.irfft(np.fft.rfft(u, 2 * n) * np.conj(np.fft.rfft(y, 2 * n)))
    c = np.r_[c[-(n // 2) :], c[: n // 2]]
    middle, crossings = n // 2, np.flatnonzero(c[:-1] * c[1:] <= 0.0)
    right, left = crossings[crossings >= middle], crossings[crossings < middle]
    if not right.size or not left.size:
        return 0.0
    after, before = right[0] + 1 - middle, middle - left[-1]
    return float(abs(after - before) / (after + before))


def ellipse_width(u: FloatArray, y: FloatArray, period: float) -> float:
    """Return the apparent stiction in units of u: the width of the ellipse of y over u along u, 2 A_u |sin(phi)|.

    A_u and phi are amplitude and phase of u relative to y at the oscillation's frequency (Choudhury, Shah, Thornhill
    and Shook, Control Engineering Practice 14, 2006, 1395-1412). Known failure: dead time and lag widen the ellipse,
    so it is meaningful only once stiction has been found.
    """
    wave = np.exp(-2j * np.pi * np.arange(u.size) / period) * np.hanning(u.size)
    gain = 2.0 / np.hanning(u.size).sum()
    of_u, of_y = gain * (wave @ u), gain * (wave @ y)
    return float(2.0 * abs(of_u) * abs(np.sin(np.angle(of_u * np.conj(of_y)))))
