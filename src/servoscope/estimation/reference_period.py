"""After how many samples a reference repeats, in recordings with gaps."""

from __future__ import annotations

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.signals import Recording

REPEATS = 0.002  # relative structure function of r at its period
MIN_AUTOCORRELATION = 0.2  # and what it must have exceeded before
MAX_PAUSE_S = 60.0  # s


def to_uniform_grid(recording: Recording, x: FloatArray, mask: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Put x, shape (N,), on the uniform grid of sample times; what is missing or masked is 0 and False.

    A pause counts as `MAX_PAUSE_S` at most: nothing repeats across a longer one, and a night would fill the memory.
    """
    steps = np.round(np.diff(recording.t) * recording.sample_rate)
    slots = np.concatenate([[0], np.cumsum(np.clip(steps, 1, MAX_PAUSE_S * recording.sample_rate))]).astype(np.int64)
    values = np.zeros(int(slots[-1]) + 1)
    there = np.zeros(values.size, dtype=bool)
    values[slots[mask]] = x[mask]
    there[slots[mask]] = True
    return values, there


def autocovariance_with_gaps(x: FloatArray, there: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the autocovariance of x at all lags and the number of pairs behind each, both shape (N,)."""
    length = 1 << (2 * x.size - 1).bit_length()
    spectrum, presence = (np.fft.rfft(np.where(there, x, 0.0), length), np.fft.rfft(there.astype(np.float64), length))
    sums = np.fft.irfft(np.abs(spectrum) ** 2, length)[: x.size]
    pairs = np.round(np.fft.irfft(np.abs(presence) ** 2, length)[: x.size])
    return sums / np.maximum(pairs, 1.0), pairs


def reference_period(recording: Recording, tolerance: float = REPEATS) -> int | None:
    """Return the period of r in samples; None if it does not repeat, twice at least.

    The smallest lag at which the structure function E[(r(k+p) - r(k))^2] / (2 var r) comes back below a tolerance.
    """
    every = np.ones(recording.samples, dtype=bool)
    r, there = to_uniform_grid(recording, recording.r - recording.r.mean(), every)
    spread = float(np.var(recording.r))
    if not spread > 0.0:
        return None
    length = 1 << (2 * r.size - 1).bit_length()
    masks = np.fft.rfft(there.astype(np.float64), length)
    squares = np.fft.irfft(np.fft.rfft(r**2, length) * np.conj(masks), length)[: r.size]
    before = np.fft.irfft(np.conj(np.fft.rfft(r**2, length)) * masks, length)[: r.size]
    products, pairs = autocovariance_with_gaps(r, there)
    pairs = np.maximum(pairs, 1.0)
    half = r.size // 2 + 1
    S = ((squares + before) / pairs / 2.0 - products)[:half] / spread
    left = np.flatnonzero(S > MIN_AUTOCORRELATION)
    if not left.size:
        return None
    back = np.flatnonzero(S[left[0] :] < tolerance)
    if not back.size:
        return None
    first = int(left[0] + back[0])
    out = np.flatnonzero(S[first:] >= tolerance)
    last = first + int(out[0]) if out.size else S.size
    return first + int(np.argmin(S[first:last]))
