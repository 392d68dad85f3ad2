"""The band that a recording can be fitted in: up to where the motion explains u, and y is more than its own noise."""

from __future__ import annotations

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.estimation.reference_period import reference_period
from servoscope.learning.inspection import excitation, model_order, signals
from servoscope.learning.inspection.excitation import Spectra, information_edge, windowed_segments
from servoscope.learning.inspection.model_order import Regressors
from servoscope.signals import Recording
from servoscope.signals.quantisation import find_quantum, white_noise_std

MIN_FITTED_SHARE = 0.5  # of the power of u at a frequency, that the fit explains: as much as it leaves
BAND_RATIO = 2.0 ** (1.0 / 6.0)  # of the cutoff: what the filter damps but little lies beyond it, too
SAMPLES_PER_CUTOFF = 10.0  # samples per period of the cutoff at least


def measure_cutoff(recording: Recording, is_speed: bool) -> float:
    """Return the cutoff [Hz] that a recording asks for, as `inspect` suggests it."""
    noise = white_noise_std(recording.y, recording.restart, find_quantum(recording.y))
    return suggest_cutoff(recording, excitation.spectra(recording, reference_period(recording)), noise, is_speed)


def suggest_cutoff(recording: Recording, spectra: Spectra | None, noise: float, is_speed: bool) -> float:
    """Return the cutoff [Hz] that a recording asks for; `noise`: standard deviation of what is white in y.

    Where no reference is logged, nothing brings noise of y into u, and the fit alone decides.
    """
    rate = recording.sample_rate
    highest = rate / SAMPLES_PER_CUTOFF
    if spectra is None:
        return highest
    lowest = 4.0 * float(spectra.f[0])
    edge = highest
    if not np.array_equal(recording.r, recording.u):
        edge = min(edge, information_edge(spectra, noise, rate))
    edge = min(max(edge, lowest), highest)
    return float(f"{min(max(_fitted_edge(recording, spectra, edge, is_speed), lowest), edge):.3g}")


def _fitted_edge(recording: Recording, spectra: Spectra, cutoff: float, is_speed: bool) -> float:
    """Return up to which frequency [Hz] a generic inverse explains u; `cutoff` where it explains u nowhere."""
    g = model_order.form_regressors(recording, model_order.generic_loop(recording.sample_rate, cutoff))
    v = g.phi[:, 0 if is_speed else 1]
    at_rest, _ = signals.detect_rest(recording, v, 0.0)
    used = g.ok & model_order.motion_mask(g, at_rest)
    u, left = np.zeros((2, recording.samples))
    u[used], left[used] = _fit(g, used, v)
    power = np.mean(np.abs(windowed_segments(recording, np.stack([u, left]), spectra.length)) ** 2, axis=0)
    f = spectra.f[spectra.f <= BAND_RATIO * cutoff]
    # what the fit explains more than it leaves, summed up to a frequency: a gap is worth it that more lies beyond
    of_u, of_left = power[:, : f.size]
    gain = np.cumsum((1.0 - MIN_FITTED_SHARE) * of_u - of_left)
    return float(f[int(np.argmax(gain))]) if gain.max() > 0.0 else cutoff


def _fit(g: Regressors, used: BoolArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the filtered u and what the generic inverse, with a speed by direction, leaves of it, where used."""
    X = np.column_stack([g.phi[used], np.abs(v[used]), np.sign(v[used])])
    X, eta = X - X.mean(axis=0), g.eta[used] - g.eta[used].mean()
    size = np.sqrt((X**2).mean(axis=0))
    X = X[:, size > 0.0] / size[size > 0.0]
    return eta, eta - X @ np.linalg.lstsq(X, eta, rcond=1e-10)[0]
