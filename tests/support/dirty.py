"""A sound log to spoil, and what is asked of the recording that comes out of it."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from servoscope.core.errors import RecordingError
from servoscope.signals import Defect, Recording, clean

Signals = dict[str, npt.NDArray[np.float64]]
RATE = 100.0


def signals(samples: int = 2000, seed: int = 0) -> Signals:
    """A reference with steps, an output that lags behind it, and a u that kicks at every step."""
    rng = np.random.default_rng(seed)
    t = np.arange(samples) / RATE
    r = 0.03 * np.sin(2 * np.pi * 0.5 * t) + 0.02 * (np.floor(t / 2.0) % 2)
    y = np.zeros(samples)
    for k in range(1, samples):
        y[k] = y[k - 1] + 0.3 * (r[k - 1] - y[k - 1])
    y += 3e-4 * rng.standard_normal(samples)
    return {"t": t, "r": r, "u": 20.0 * (r - y), "y": y}


def cleaned(data: Signals, **settings: Any) -> Recording:
    return clean(data["t"], data["r"], data["u"], data["y"], name="x.csv", **{"sample_rate": RATE} | settings)


def refusal(data: Signals, **settings: Any) -> str:
    with pytest.raises(RecordingError) as caught:
        cleaned(data, **settings)
    text = str(caught.value)
    assert text.startswith("x.csv: ")
    assert "\n" not in text
    return text


def without(data: Signals, rows: Any) -> Signals:
    return {key: np.delete(x, rows) for key, x in data.items()}


def only(recording: Recording, kind: str) -> Defect:
    assert [defect.kind for defect in recording.defects] == [kind]
    return recording.defects[0]
