"""What r excites: spectra and coherence of r, u and y, the usable band, signal to noise at a frequency."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import FloatArray
from servoscope.learning.inspection.signals import InspectionModel
from servoscope.signals import Recording

MIN_COHERENCE = 0.8
MIN_SEGMENTS = 4
MIN_PERIODS = 3.5  # of the reference; with fewer, segments differ by what part of the motion they hold
MAX_PERIODS_PER_SEGMENT = 2  # of more, the lines of a reference lie so far apart that no band holds them
MIN_SEGMENT_SAMPLES = 512  # unless that many periods are shorter
SILENT_POWER_SHARE = 1e-12  # share of the largest power below which r is said to have none


@dataclass(frozen=True, eq=False)
class Spectra:
    """Averaged periodograms (Welch 1967: Hann window, half overlapping) and what of u and y follows r."""

    f: FloatArray  # frequencies [Hz], shape (F,)
    R: FloatArray  # R, U, Y: one-sided power densities [signal^2/Hz], shape (F,)
    U: FloatArray
    Y: FloatArray
    # coherence_u, coherence_y: squared coherence of r -> u and r -> y, freed of the bias of few segments, 0 to 1,
    # shape (F,)
    coherence_u: FloatArray
    coherence_y: FloatArray
    length: int  # of the segments [samples]


class Band(InspectionModel):
    """Frequencies [Hz] at which both u and y follow r."""

    low_hz: float
    high_hz: float


class FrequencyExcitation(InspectionModel):
    """One monitored frequency, with the coherences of r -> u and r -> y around it.

    `snr` is the power that follows r over the power that does not, the smaller of u and y; `relative_std`
    that of the iFRF after the whole recording, `relative_std_memory` that after the estimator's memory, both None
    where the regression failed. Coherences and `snr` are None where the reference has too few periods in the
    recording to judge them.
    """

    frequency_hz: float
    coherence_u: float | None
    coherence_y: float | None
    snr: float | None
    relative_std: float | None
    relative_std_memory: float | None


def spectra(recording: Recording, period: int | None = None) -> Spectra | None:
    """Estimate spectra within the stretches between gaps; None where too little is left of them.

    `period`: of the reference, in samples: segments of that length keep the power of its lines from leaking between
    them, where it would look like noise.
    """
    sizes = np.array([stop - start for start, stop in _stretches(recording)])
    length = _length(sizes, recording.samples)
    few = max(MAX_PERIODS_PER_SEGMENT, MIN_SEGMENT_SAMPLES // (period or 1))
    whole = (period or 0) * max(1, min(length // (period or 1), few))
    if whole >= 16 and sum(max(0, 2 * (size // whole) - 1) for size in sizes) >= MIN_SEGMENTS:
        length = whole
    if length < 16:
        return None
    X = windowed_segments(recording, np.stack([recording.r, recording.u, recording.y]), length)
    if len(X) < MIN_SEGMENTS:
        return None
    window = np.hanning(length + 1)[:-1]
    scale = 2.0 / (recording.sample_rate * float(window @ window))
    power = scale * np.mean(np.abs(X) ** 2, axis=0)
    cross = scale * np.mean(np.conj(X[:, :1]) * X[:, 1:], axis=0)
    floor = SILENT_POWER_SHARE * power.max(axis=1, keepdims=True) + 1e-150
    raw = np.abs(cross) ** 2 / (np.maximum(power[:1], floor[:1]) * np.maximum(power[1:], floor[1:]))
    # Half-overlapping Hann segments hold about 0.9 independent ones each; noise alone shows 1/K.
    K = max(0.9 * len(X), 2.0)
    coherence = np.clip((K * raw - 1.0) / (K - 1.0), 0.0, 1.0)
    coherence[:, power[0] <= floor[0]] = 0.0
    f = np.arange(1, length // 2 + 1) * recording.sample_rate / length
    R, U, Y = power
    return Spectra(f, R, U, Y, coherence[0], coherence[1], length)


def windowed_segments(recording: Recording, signals: FloatArray, length: int) -> npt.NDArray[np.complex128]:
    """Return the Fourier transforms of half overlapping segments of signals (S, N) without their means, (K, S, F)."""
    window = np.hanning(length + 1)[:-1]
    rows = []
    for start, stop in _stretches(recording):
        for begin in range(start, stop - length + 1, length // 2):
            part = signals[:, begin : begin + length]
            rows.append(np.fft.rfft((part - part.mean(axis=1, keepdims=True)) * window, axis=1)[:, 1:])
    return np.stack(rows) if rows else np.zeros((0, len(signals), length // 2), dtype=np.complex128)


def _stretches(recording: Recording) -> list[tuple[int, int]]:
    """Return the first row of each stretch between gaps, and the one after its last."""
    starts = np.flatnonzero(recording.restart).tolist()
    return list(zip(starts, [*starts[1:], recording.samples], strict=True))


def _length(sizes: np.ndarray[tuple[int], np.dtype[np.int64]], samples: int) -> int:
    """Return the segments' length: about a dozen of them, and most rows in stretches that hold one."""
    length = samples // 6
    while length >= 16 and sizes[sizes >= length].sum() < 0.8 * samples:
        length = int(0.8 * length)
    return length


def usable_band(s: Spectra) -> Band | None:
    """Return the widest band, on a logarithmic scale, in which u and y follow r; None if there is none."""
    both = np.minimum(s.coherence_u, s.coherence_y)
    # A line here and there that fails does not end a band, nor does one that passes by chance make one.
    padded = np.pad(both, 2, mode="edge")
    smooth = np.median(np.stack([padded[i : i + both.size] for i in range(5)]), axis=0)
    good = np.concatenate([[False], smooth >= MIN_COHERENCE, [False]])
    edges = np.flatnonzero(good[1:] != good[:-1]).reshape(-1, 2)
    if not edges.size:
        return None
    resolution = float(s.f[0])
    # The lowest line stands for all below it, down to the length of the recording.
    widths = [(s.f[stop - 1] + 0.5 * resolution) / (s.f[start] - 0.5 * resolution) for start, stop in edges]
    start, stop = edges[int(np.argmax(widths))]
    return Band(low_hz=float(s.f[start]), high_hz=float(s.f[stop - 1]))


def information_edge(s: Spectra, noise: float, sample_rate: float) -> float:
    """Return up to which frequency [Hz] y stands out of its own white noise by a factor of ten in power."""
    clear = 10.0 * 2.0 * noise**2 / sample_rate < s.Y
    # a sine fills three lines of these windows, noise rarely does; what lies between the sines does not end the band
    good = 1 + np.flatnonzero(clear[:-2] & clear[1:-1] & clear[2:])
    return float(s.f[good[-1] + 1]) if good.size else float(s.f[0])


def coherence_and_snr(s: Spectra, frequency: float) -> tuple[float, float, float]:
    """Return the coherences r -> u and r -> y around a frequency [Hz], and signal over noise (power)."""
    near = np.abs(s.f - frequency) <= max(0.05 * frequency, 1.01 * float(s.f[0]))
    if not near.any():
        return 0.0, 0.0, 0.0
    weight = s.R[near] / max(float(s.R[near].sum()), np.finfo(np.float64).tiny)
    of_u, of_y = float(weight @ s.coherence_u[near]), float(weight @ s.coherence_y[near])
    least = min(of_u, of_y, 1.0 - 1e-9)
    return of_u, of_y, least / (1.0 - least)
