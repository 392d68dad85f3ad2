"""Learned instruments: a noise-free output y_a from a clean u through the plant, or from r through Laguerre functions.

Noise in y makes phi noisy, and least squares biased. Refined instrumental variables for continuous-time models
(Young and Jakeman, 1980; Gonzalez, Rojas, Pan and Welsh, 2024) form z from an output that a model produces from a
signal without that noise, and fit the model anew with what z tells. In a loop whose u does not depend on y the source
is u; in a loop closed over y it is r, and the model is that of the whole loop (Wahlberg, 1991).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from servoscope.core.arrays import FloatArray, IndexArray
from servoscope.estimation.filter_bank import InstrumentModel, instrument_system
from servoscope.estimation.two_stage import laguerre_functions
from servoscope.models.lfilter import lfilter
from servoscope.models.loop import Loop
from servoscope.models.lti import LinearSystem, sample_system, tapped_delay_line
from servoscope.signals import Recording

FUNCTIONS = 8  # Laguerre functions of r
POLES = (0.5, 0.8, 0.9, 0.95, 0.98, 0.99)  # of theirs, per sample, out of which the one that explains y best is taken
FOLDS = 4  # parts of the samples, in each of which the instrument comes from a model that has not seen it
MIN_POLE_DAMPING = 1e-3  # real part of a pole of the model over its magnitude, below which it would hardly settle

Source = Literal["input", "reference"]


@dataclass(frozen=True)
class InstrumentTuning:
    """The model behind a learned instrument."""

    source: Source
    weights: tuple[float, ...]  # coefficients of the powers of s of the inverse, or weights of the Laguerre functions
    pole: float = 0.0  # of the Laguerre functions, per sample


def instrument_model(loop: Loop, tuning: InstrumentTuning | None) -> InstrumentModel:
    """Return the learned model, or without one that of the nominal closed loop.

    Raises LoopError if there is neither.
    """
    if tuning is None:
        return InstrumentModel(instrument_system(loop))
    if tuning.source == "reference":
        functions = laguerre_functions(len(tuning.weights), tuning.pole)
        return InstrumentModel(functions.output(np.array([tuning.weights])))
    powers = loop.plant.powers
    polynomial = np.zeros(powers[-1] - powers[0] + 1)
    polynomial[np.array(powers) - powers[0]] = tuning.weights
    return InstrumentModel(_plant_model(loop, _stable(polynomial)), from_input=True, derivative=powers[0])


def fit_reference_model(recordings: Sequence[Recording], fold: int | None = None) -> InstrumentTuning | None:
    """Fit r -> y by Laguerre functions, whose noise is that of y alone; None where r explains nothing.

    The samples of a fold are left out of the fit.
    """
    best, least = None, np.inf
    parts = [part for rec in recordings for part in unbroken(rec)]
    y = np.concatenate([part.y - part.y.mean() for part in parts])
    seen = np.ones(len(y), np.bool_) if fold is None else fold_of(len(y)) != fold
    for pole in POLES:
        phi = np.vstack([_functions_of(part.r, pole) for part in parts])
        weights = np.linalg.lstsq(phi[seen], y[seen], rcond=1e-10)[0]
        left = float(np.mean((y - phi @ weights)[seen] ** 2))
        if left < least and weights.any():
            best, least = InstrumentTuning("reference", tuple(weights.tolist()), pole), left
    return best


def fold_of(samples: int) -> IndexArray:
    """Return the fold of each sample of all recordings one after the other, shape (samples,)."""
    return np.arange(samples) * FOLDS // samples


def unbroken(recording: Recording) -> list[Recording]:
    """Return the stretches of a recording without a gap."""
    begins = np.flatnonzero(recording.restart).tolist()
    ends = [*begins[1:], recording.samples]
    return [recording.rows(slice(begin, end)) for begin, end in zip(begins, ends, strict=True)]


def _functions_of(r: FloatArray, pole: float) -> FloatArray:
    """Return the Laguerre functions of r without their means, shape (N, FUNCTIONS), from a steady state."""
    value, columns = lfilter(np.array([np.sqrt(1.0 - pole * pole)]), np.array([1.0, -pole]), r - r[0]), []
    for _ in range(FUNCTIONS):
        columns.append(value - value.mean())
        value = lfilter(np.array([-pole, 1.0]), np.array([1.0, -pole]), value)
    return np.column_stack(columns)


def _stable(polynomial: FloatArray) -> FloatArray:
    """Return a polynomial with the same magnitudes on the imaginary axis, whose roots all lie left of it."""
    from numpy.polynomial import polynomial as P

    if len(polynomial) == 1:
        return polynomial
    roots = P.polyroots(polynomial)
    real = -np.maximum(np.abs(roots.real), MIN_POLE_DAMPING * np.abs(roots))
    return np.asarray(P.polyfromroots(real + 1j * roots.imag).real * polynomial[-1])


def _plant_model(loop: Loop, polynomial: FloatArray) -> LinearSystem:
    """Return u -> y_a of ``sum polynomial_i s^i y_a = input_gain u``, exact for u between the samples."""
    order, gain = len(polynomial) - 1, loop.plant.input_gain
    if not order:
        late = round(loop.delay * loop.sample_rate)
        return tapped_delay_line(np.eye(1, late + 1, late) * gain / polynomial[0])
    A = np.vstack([np.eye(order, k=1)[:-1], -polynomial[:-1] / polynomial[-1]])
    B = np.append(np.zeros(order - 1), gain / polynomial[-1])[:, None]
    return sample_system((A, B, np.eye(1, order)), loop.sample_rate, loop.hold, loop.delay)
