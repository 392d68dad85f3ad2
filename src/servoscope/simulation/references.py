"""References to drive a loop with: the paper's three kinds of motion, steps, a chirp, or a file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import RecordingError, SimulationError
from servoscope.signals.readers.formats import open_file
from servoscope.signals.readers.table import number_column

PERIOD_S = 10.0
_STROKE = 0.05  # m
_SEED = 5
_LINES = 199


def reference(
    kind: str | Path, duration_s: float, sample_rate: float, *, amplitude: float = 1.0, seed: int = 0
) -> FloatArray:
    """Return a reference, shape (duration_s sample_rate,), in units of the output.

    Parameters
    ----------
    kind
        ``profile``, half motion and half rest; ``multisine``, 199 lines from 0.1 to 19.9 Hz that fall with
        1/(1 + f/1 Hz); ``trapezoid``, ramps between rests; ``steps``; ``chirp``, 0.1 to 10.1 Hz; each
        repeats after 10 s and stays within 0.065 m. Or the path of a CSV or Parquet file with columns t and
        r, or one column at the sample rate: it is read between its rows by straight lines, and repeats when
        it ends.
    duration_s
        Length [s].
    sample_rate
        Samples per second [Hz].
    amplitude
        Factor on the whole reference.
    seed
        Other phases of the multisine, other heights of the steps.

    Raises SimulationError if the kind is unknown, the file cannot be used, or there is no sample in the duration.
    """
    samples = round(duration_s * sample_rate) if np.isfinite(duration_s * sample_rate) else 0
    if samples < 1 or sample_rate <= 0.0:
        raise SimulationError(f"a reference of {duration_s:g} s at {sample_rate:g} Hz has no samples")
    t = np.arange(samples) / sample_rate
    if isinstance(kind, str) and kind in REFERENCE_KINDS:
        period = PERIOD_S * sample_rate
        whole = bool(np.isclose(period, round(period), rtol=0.0, atol=1e-6))
        # Where a period is a whole number of samples it is laid end to end, so that it repeats exactly.
        phase = np.mod(np.arange(min(samples, round(period)) if whole else samples), period) / sample_rate
        return np.resize(amplitude * REFERENCE_KINDS[kind](phase, sample_rate, seed), samples)
    path = Path(kind)
    if not path.suffix and not path.exists():
        raise SimulationError(f"reference {kind}: unknown, choose from {', '.join(REFERENCE_KINDS)}, or name a file")
    return amplitude * _load_reference(path, t, sample_rate)


def _profile(t: FloatArray, sample_rate: float, seed: int) -> FloatArray:
    moving = _STROKE * np.sin(np.pi * t) + 0.015 * np.sin(2.0 * np.pi * (0.2 * t + 0.8 * t**2))
    return np.where(t < 0.5 * PERIOD_S, moving, 0.03)


def _multisine(t: FloatArray, sample_rate: float, seed: int) -> FloatArray:
    phases = np.random.default_rng(_SEED + seed).uniform(0.0, 2.0 * np.pi, _LINES)
    frequencies = np.arange(1, _LINES + 1) / PERIOD_S

    def lines(times: FloatArray, keep: int) -> FloatArray:
        value = np.zeros_like(times)
        for f, phase in zip(frequencies[:keep], phases[:keep], strict=True):
            value += np.cos(2.0 * np.pi * f * times + phase) / (1.0 + f)
        return value

    # Scaled where the test data are, so that the same motion comes out at every sample rate.
    peak = np.max(np.abs(lines(np.arange(0.0, PERIOD_S, 0.01), _LINES)))
    return lines(t, int(np.sum(frequencies < 0.5 * sample_rate))) * float(_STROKE / peak)


def _trapezoid(t: FloatArray, sample_rate: float, seed: int) -> FloatArray:
    corners = [0.0, 1.0, 1.3, 3.0, 3.6, 5.0, 5.2, 7.0, 8.0, PERIOD_S]
    heights = [0.0, 0.0, 0.05, 0.05, 0.01, 0.01, 0.035, 0.035, 0.0, 0.0]
    return np.interp(t, corners, heights)


def _steps(t: FloatArray, sample_rate: float, seed: int) -> FloatArray:
    heights = np.random.default_rng(_SEED + seed).uniform(-_STROKE, _STROKE, 5)
    heights[0] = 0.0
    return np.asarray(heights[np.minimum((t / 2.0).astype(np.int64), 4)], dtype=np.float64)


def _chirp(t: FloatArray, sample_rate: float, seed: int) -> FloatArray:
    return 0.4 * _STROKE * np.sin(2.0 * np.pi * (0.1 * t + 0.5 * t**2))


REFERENCE_KINDS: dict[str, Callable[[FloatArray, float, int], FloatArray]] = {
    "profile": _profile,
    "multisine": _multisine,
    "trapezoid": _trapezoid,
    "steps": _steps,
    "chirp": _chirp,
}


def _load_reference(path: Path, t: FloatArray, sample_rate: float) -> FloatArray:
    try:
        opened = open_file(path)
        wanted = ["t", "r"] if len(opened.columns) > 1 else list(opened.columns)
        if not set(wanted) <= set(opened.columns):
            names = ", ".join(opened.columns)
            raise SimulationError(f"reference {path}: needs columns t and r, or a single column; it has {names}")
        chunks = [[number_column(table, name, "reference") for name in wanted] for table in opened.iter_chunks(wanted)]
    except RecordingError as error:
        detail = str(error).removeprefix(f"{path}: ")
        raise SimulationError(f"reference {path}: cannot be read as a table of numbers ({detail})") from error
    *clock, r = (np.concatenate(parts) for parts in zip(*chunks, strict=True))
    times = clock[0] if clock else np.arange(r.size) / sample_rate
    if r.size < 2 or not (np.all(np.isfinite(r)) and np.all(np.isfinite(times))):
        raise SimulationError(f"reference {path}: needs two or more rows, all of them numbers")
    if np.any(np.diff(times) <= 0.0):
        row = int(np.argmax(np.diff(times) <= 0.0)) + 1
        raise SimulationError(f"reference {path}: t does not increase at row {row}; sort it and drop repeats")
    times = times - times[0]
    # The last row lasts as long as the one before it; its way back to the first is part of the period.
    length = times[-1] + (times[-1] - times[-2])
    whole = np.interp(np.mod(t, length), np.append(times, length), np.append(r, r[0]))
    return np.asarray(whole, dtype=np.float64)
